/* Which index each coefficient gets: the one that costs least, in squared error and in bits (docs/mathematics.md,
 * "Quantised for one error").
 *
 * What an index costs is known by the class of its coefficient, that is by the size of what is around it. The indices
 * of a row of blocks depend on each other by the trellis; Viterbi's algorithm takes the cheapest of all ways through
 * it.
 */
#include <stdbool.h>

#include "band_fields.h"
#include "lodestream.h"
#include "logarithm.h"
#include "trellis.h"

enum {
    BLOCK = 8,       /* rows and columns of the blocks in whose order a band is coded */
    FIRST_CLASS = 8, /* of coefficients of about a step */
    BRANCHES = 4,    /* of a coefficient: for either quantiser the best even and the best odd index */
};

/* What leads into each state: a state before it and the parity of an index; the lower state first. */
static const uint8_t ARRIVALS[TRELLIS_STATES][2][2] = {
    {{0, 0}, {4, 1}}, {{2, 0}, {6, 1}}, {{0, 1}, {4, 0}}, {{2, 1}, {6, 0}},
    {{3, 1}, {5, 0}}, {{1, 0}, {7, 1}}, {{3, 0}, {5, 1}}, {{1, 1}, {7, 0}},
};

static int64_t least(int64_t a, int64_t b) {
    return a < b ? a : b;
}

static double magnitude(double value) {
    return __builtin_fabs(value);
}

/* Whether rows x columns elements from `place` on, rows `stride` apart and none in another, lie within `size`. */
static bool holds(int64_t size, int64_t place, int64_t stride, int64_t rows, int64_t columns) {
    if (place < 0 || place > size || rows < 1 || columns < 1 || columns > size - place)
        return false;
    return rows == 1 || (stride >= columns && rows - 1 <= (size - place - columns) / stride);
}

/* Whether a band lies within `size` elements. */
static bool is_band(const int64_t *band, int64_t size) {
    return band[BAND_ROWS] <= INT32_MAX && band[BAND_COLUMNS] <= INT32_MAX &&
           holds(size, band[BAND_OFFSET], band[BAND_STRIDE], band[BAND_ROWS], band[BAND_COLUMNS]);
}

/* Whether what is around a band and its parents lie within `size` elements, too. */
static bool has_surroundings(const int64_t *band, int64_t size) {
    int64_t down = band[BAND_ROW_SHIFT], right = band[BAND_COLUMN_SHIFT];
    if (band[BAND_STRIDE] < 0 || band[BAND_STRIDE] >= band[BAND_OFFSET] || down < 0 || down > 31 || right < 0 ||
        right > 31)
        return false;
    return holds(size, band[BAND_OFFSET] - band[BAND_STRIDE] - 1, band[BAND_STRIDE], band[BAND_ROWS] + 2,
                 band[BAND_COLUMNS] + 2) &&
           holds(size, band[BAND_PARENT], band[BAND_PARENT_STRIDE], ((band[BAND_ROWS] - 1) >> down) + 1,
                 ((band[BAND_COLUMNS] - 1) >> right) + 1);
}

static void divide(const int64_t *band, int64_t step, const int32_t *coefficients, double *relative) {
    double scale = 1.0 / (double)step;
    for (int64_t i = 0; i < band[BAND_ROWS]; i++) {
        int64_t start = band[BAND_OFFSET] + i * band[BAND_STRIDE];
        for (int64_t j = 0; j < band[BAND_COLUMNS]; j++)
            relative[start + j] = coefficients[start + j] * scale;
    }
}

/* Half octaves: 2 log2(size) + FIRST_CLASS rounded down, from the exponent, and whether the rest is sqrt(2) or more. */
static int8_t class_of(double size) {
    const uint64_t root = 0x6A09E667F3BCD; /* the fraction of sqrt(2) */
    size += 1e-3;
    uint64_t bits;
    memcpy(&bits, &size, sizeof bits);
    int64_t exponent = (int64_t)(bits >> 52 & 2047) - 1023;
    int64_t found = 2 * exponent + ((bits & ((UINT64_C(1) << 52) - 1)) >= root) + FIRST_CLASS;
    return (int8_t)(found < 0 ? 0 : least(found, LODE_CLASSES - 1));
}

/* Classes of a band's coefficients, by their eight neighbours and their parent. */
static void classify(const int64_t *band, const double *relative, int8_t *classes) {
    int64_t stride = band[BAND_STRIDE];
    for (int64_t i = 0; i < band[BAND_ROWS]; i++) {
        int64_t start = band[BAND_OFFSET] + i * stride;
        const double *parents = relative + band[BAND_PARENT] + (i >> band[BAND_ROW_SHIFT]) * band[BAND_PARENT_STRIDE];
        for (int64_t j = 0; j < band[BAND_COLUMNS]; j++) {
            const double *at = relative + start + j;
            double near = magnitude(at[-1]) + magnitude(at[1]) + magnitude(at[-stride]) + magnitude(at[stride]);
            double corners = magnitude(at[-stride - 1]) + magnitude(at[-stride + 1]) + magnitude(at[stride - 1]) +
                             magnitude(at[stride + 1]);
            double above = magnitude(parents[j >> band[BAND_COLUMN_SHIFT]]);
            classes[start + j] = class_of((2.0 * near + corners + 2.0 * above) / 14.0);
        }
    }
}

int64_t lode_classify(const int64_t *bands, int64_t bands_count, const int64_t *steps, int64_t steps_count,
                      const int32_t *coefficients, int64_t coefficients_count, double *relative, int64_t relative_count,
                      int8_t *classes, int64_t classes_count) {
    if (relative_count != coefficients_count || classes_count != coefficients_count || bands_count % BAND_FIELDS ||
        steps_count != bands_count / BAND_FIELDS)
        return LODE_REFUSED;
    for (int64_t number = 0; number < steps_count; number++) {
        const int64_t *band = bands + number * BAND_FIELDS;
        if (steps[number] < 1 || !is_band(band, coefficients_count) || !has_surroundings(band, coefficients_count))
            return LODE_REFUSED;
        divide(band, steps[number], coefficients, relative);
        classify(band, relative, classes);
    }
    return 0;
}

/* What it takes to give a coefficient an index: squared error and bits. */
struct branch {
    double cost;
    int32_t index;
};

static double cost_of(double size, int64_t index, double half, const double *bits, double worth) {
    double error = index ? size - ((double)index - half) : size;
    double rate = bits[least(index, LODE_INDICES - 1)];
    if (index)
        rate += 1.0; /* the sign */
    if (index >= LODE_INDICES - 1)
        rate += 2.0 * log2_of((double)(index - LODE_INDICES + 3));
    return error * error + worth * rate;
}

/* The best even and the best odd index of a quantiser: the nearest below, the nearest above, and none. */
static void find_branches(double size, double half, const double *bits, double worth, struct branch *found) {
    int64_t nearest = size < INT32_MAX - 1 ? (int64_t)(size + half) : INT32_MAX - 1;
    for (int64_t index = nearest; index < nearest + 2; index++) {
        found[index & 1].cost = cost_of(size, index, half, bits, worth);
        found[index & 1].index = (int32_t)index;
    }
    double none = cost_of(size, 0, half, bits, worth);
    if (none < found[0].cost) {
        found[0].cost = none;
        found[0].index = 0;
    }
}

/* One coefficient further: the least cost of each state, and in the bits of what is returned which of the two ways
 * into it. */
static uint8_t advance(double *cost, const struct branch *branches) {
    double next[TRELLIS_STATES];
    unsigned ways = 0;
    for (unsigned state = 0; state < TRELLIS_STATES; state++) {
        const uint8_t (*from)[2] = ARRIVALS[state];
        double first = cost[from[0][0]] + branches[2 * ODD[from[0][0]] + from[0][1]].cost;
        double second = cost[from[1][0]] + branches[2 * ODD[from[1][0]] + from[1][1]].cost;
        bool other = second < first;
        next[state] = other ? second : first;
        ways |= (unsigned)other << state;
    }
    memcpy(cost, next, sizeof next);
    return (uint8_t)ways;
}

struct choice {
    const double *relative;
    const int8_t *classes;
    const double *bits;
    double worth;
    int32_t *chosen;
    double *counts;
    int32_t *indices;
    uint8_t *ways;
};

static int64_t class_at(const struct choice *c, int64_t at) {
    return c->classes[at] < 0 ? 0 : least(c->classes[at], LODE_CLASSES - 1);
}

static void add_coefficient(const struct choice *c, int64_t at, int64_t number, double *cost) {
    struct branch branches[BRANCHES];
    double size = magnitude(c->relative[at]);
    for (int odd = 0; odd < 2; odd++) {
        const double *bits = c->bits + (odd * LODE_CLASSES + class_at(c, at)) * LODE_INDICES;
        find_branches(size, 0.5 * odd, bits, c->worth, branches + 2 * odd);
    }
    for (int branch = 0; branch < BRANCHES; branch++)
        c->indices[BRANCHES * number + branch] = branches[branch].index;
    c->ways[number] = advance(cost, branches);
}

/* Take the index of the way into a state; returns the state before. */
static int take(const struct choice *c, int64_t at, int64_t number, int state) {
    const uint8_t *way = ARRIVALS[state][c->ways[number] >> state & 1];
    int odd = ODD[way[0]];
    int32_t index = c->indices[BRANCHES * number + 2 * odd + way[1]];
    c->chosen[at] = c->relative[at] >= 0 ? index : -index;
    c->counts[(odd * LODE_CLASSES + class_at(c, at)) * LODE_INDICES + least(index, LODE_INDICES - 1)] += 1.0;
    return way[0];
}

/* Choose the indices of a row of blocks. */
static void choose(const int64_t *band, int64_t top, const struct choice *c) {
    int64_t end = least(top + BLOCK, band[BAND_ROWS]), columns = band[BAND_COLUMNS], number = 0;
    double cost[TRELLIS_STATES];
    for (int state = 0; state < TRELLIS_STATES; state++)
        cost[state] = state ? __builtin_inf() : 0.0;
    for (int64_t left = 0; left < columns; left += BLOCK)
        for (int64_t i = top; i < end; i++)
            for (int64_t j = left; j < least(left + BLOCK, columns); j++, number++)
                add_coefficient(c, band[BAND_OFFSET] + i * band[BAND_STRIDE] + j, number, cost);
    int state = 0;
    for (int other = 1; other < TRELLIS_STATES; other++)
        state = cost[other] < cost[state] ? other : state;
    for (int64_t left = (columns - 1) / BLOCK * BLOCK; left >= 0; left -= BLOCK)
        for (int64_t i = end - 1; i >= top; i--)
            for (int64_t j = least(left + BLOCK, columns) - 1; j >= left; j--)
                state = take(c, band[BAND_OFFSET] + i * band[BAND_STRIDE] + j, --number, state);
}

int64_t lode_choose(const int64_t *bands, int64_t bands_count, const double *relative, int64_t relative_count,
                    const int8_t *classes, int64_t classes_count, const double *bits, int64_t bits_count, double worth,
                    int32_t *chosen, int64_t chosen_count, double *counts, int64_t counts_count, int32_t *indices,
                    int64_t indices_count, uint8_t *ways, int64_t ways_count) {
    if (classes_count != relative_count || chosen_count != relative_count ||
        bits_count != 2 * LODE_CLASSES * LODE_INDICES || counts_count != bits_count || bands_count % BAND_FIELDS)
        return LODE_REFUSED;
    struct choice choice = {relative, classes, bits, worth, chosen, counts, indices, ways};
    for (int64_t at = 0; at < bands_count; at += BAND_FIELDS) {
        const int64_t *band = bands + at;
        if (!is_band(band, relative_count))
            return LODE_REFUSED;
        int64_t size = band[BAND_ROWS] * band[BAND_COLUMNS];
        if (size > ways_count || size > indices_count / BRANCHES)
            return LODE_REFUSED;
        for (int64_t top = 0; top < band[BAND_ROWS]; top += BLOCK)
            choose(band, top, &choice);
    }
    return 0;
}
