/* Which index each coefficient gets: the one that costs least, in squared error and in bits (docs/mathematics.md,
 * "Quantised for one error").
 *
 * What an index costs is known by the class of its coefficient, that is by the size of what is around it. The indices
 * of a row of blocks depend on each other by the trellis; Viterbi's algorithm takes the cheapest of all ways through
 * it. Errors of coefficients close to each other add up in the surface: what counts is the error of each coefficient
 * and what a filter feeds back of those before it, above and to the left. So each survivor of the algorithm keeps its
 * errors.
 */
#include <stdbool.h>

#include "band_fields.h"
#include "copying.h"
#include "lodestream.h"
#include "trellis.h"

enum {
    BLOCK = 8,                     /* rows and columns of the blocks in whose order a band is coded */
    FIRST_CLASS = 8,               /* of coefficients of about a step */
    BRANCHES = 2 * TRELLIS_STATES, /* the best even index of each state, then the best odd one of each */
    RULE = 6,                      /* numbers that a band's rule has */
    SMALL = 32,                    /* below it, coefficients are worked on as they are */
    MOST = 61,                     /* in the search for an index: two above it have a rate, too */
    LARGEST = (1 << 28) - 2 * LODE_RATES,
};

/* The two branches into each state, by the state that they come from, plus TRELLIS_STATES where the index is odd; the
 * lower state first. */
static const uint8_t ARRIVALS[TRELLIS_STATES][2] = {
    {0, 8 + 4}, {2, 8 + 6}, {8 + 0, 4}, {8 + 2, 6}, {8 + 3, 5}, {1, 8 + 7}, {3, 8 + 5}, {8 + 1, 7},
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

/* A band whose indices are chosen. Errors are in steps. */
struct choice {
    const int64_t *band;
    const double *relative;
    const int8_t *classes;
    const float *rates;
    float half;    /* how far below an index its point lies in the odd quantiser */
    float weight;  /* of a squared error */
    float up[2];   /* what is fed back of errors one and two rows above, */
    float left[2]; /* and one and two columns to the left */
    float *above;  /* errors of the two rows above the row of blocks, the upper one first, filtered along the rows */
    int32_t *chosen;
    double *counts;
    int32_t *indices;
    uint8_t *from;
};

/* The ways through a row of a block, by the state that they lead to. */
struct survivors {
    float cost[TRELLIS_STATES];
    float last[TRELLIS_STATES], second[TRELLIS_STATES]; /* errors one and two columns before, in the row */
    uint8_t root[TRELLIS_STATES];                       /* the state at the row's begin */
};

/* What a way has left behind, for the rows to come. */
struct trail {
    float edges[BLOCK]
               [2]; /* the last two errors of each row, in this block where that is done, else in the one before */
    float above[2][BLOCK]; /* errors two rows and one row above, filtered along the row */
};

/* What it takes to give a coefficient an index. */
struct branches {
    float cost[BRANCHES];
    float error[BRANCHES];
    int32_t index[BRANCHES];
};

/* A coefficient without an even number that all its indices have in common: float32 then has enough places. */
struct part {
    float rest;
    int32_t common;
};

static struct part part_of(double value) {
    double size = magnitude(value);
    if (size < SMALL)
        return (struct part){(float)value, 0};
    size = size < LARGEST ? size : LARGEST;
    int32_t common = ((int32_t)size & -2) - SMALL / 2;
    float rest = (float)(size - common);
    return value < 0 ? (struct part){-rest, -common} : (struct part){rest, common};
}

/* Of each survivor the best even and the best odd index: the nearest below, the nearest above, and none. */
static void find_branches(const struct choice *c, const struct survivors *ways, float rest, const float *fed,
                          const float *rates, struct branches *found) {
    for (int state = 0; state < TRELLIS_STATES; state++) {
        const float *own = rates + ODD[state] * (LODE_CLASSES * LODE_RATES);
        float half = ODD[state] ? c->half : 0.0f;
        float wanted =
            rest + fed[ways->root[state] * BLOCK] + c->left[0] * ways->last[state] + c->left[1] * ways->second[state];
        float size = __builtin_fabsf(wanted), sign = __builtin_copysignf(1.0f, wanted);
        size = size < MOST ? size : MOST;
        int32_t below = (int32_t)(size + half), flip = wanted < 0 ? -1 : 1;
        float low = below ? (float)below - half : 0.0f, high = (float)(below + 1) - half;
        float none = c->weight * (size * size) + own[0];
        float low_cost = c->weight * ((size - low) * (size - low)) + own[below];
        float high_cost = c->weight * ((high - size) * (high - size)) + own[below + 1];
        bool odd = below & 1;
        float even_cost = odd ? high_cost : low_cost;
        bool zero = none < even_cost;
        found->cost[state] = ways->cost[state] + (zero ? none : even_cost);
        found->error[state] = rest - sign * (zero ? 0.0f : odd ? high : low);
        found->index[state] = flip * (zero ? 0 : odd ? below + 1 : below);
        found->cost[TRELLIS_STATES + state] = ways->cost[state] + (odd ? low_cost : high_cost);
        found->error[TRELLIS_STATES + state] = rest - sign * (odd ? low : high);
        found->index[TRELLIS_STATES + state] = flip * (odd ? below : below + 1);
    }
}

/* One coefficient further: of the two branches into each state the cheaper one. */
static void advance(struct survivors *ways, const struct branches *found, int32_t common, float *errors, uint8_t *from,
                    int32_t *indices) {
    struct survivors next;
    for (int state = 0; state < TRELLIS_STATES; state++) {
        int first = ARRIVALS[state][0], second = ARRIVALS[state][1];
        int branch = found->cost[second] < found->cost[first] ? second : first, before = branch % TRELLIS_STATES;
        next.cost[state] = found->cost[branch];
        next.last[state] = errors[state] = found->error[branch];
        next.second[state] = ways->last[before];
        next.root[state] = ways->root[before];
        from[state] = (uint8_t)before;
        indices[state] = common + found->index[branch];
    }
    *ways = next;
}

/* After row i of a block: hand the trails on to the survivors, each with the row's errors. */
static void follow(const struct choice *c, int64_t i, int64_t columns, float (*errors)[TRELLIS_STATES],
                   const uint8_t *from, struct trail *trails) {
    struct trail next[TRELLIS_STATES];
    for (int end = 0; end < TRELLIS_STATES; end++) {
        float own[2 + BLOCK];
        int state = end;
        for (int64_t j = columns - 1; j >= 0; j--) {
            own[2 + j] = errors[j][state];
            state = from[j * TRELLIS_STATES + state];
        }
        struct trail *trail = next + end;
        *trail = trails[state];
        memcpy(own, trail->edges[i], sizeof trail->edges[i]);
        memcpy(trail->edges[i], own + columns, sizeof trail->edges[i]);
        memcpy(trail->above[0], trail->above[1], sizeof trail->above[0]);
        for (int64_t j = 0; j < columns; j++)
            trail->above[1][j] = own[2 + j] + c->left[0] * own[1 + j] + c->left[1] * own[j];
    }
    memcpy(trails, next, sizeof next);
}

static int64_t class_at(const struct choice *c, int64_t at) {
    return c->classes[at] < 0 ? 0 : least(c->classes[at], LODE_CLASSES - 1);
}

/* Row i of a block, whose first coefficient is number `number` of the row of blocks. */
static void choose_row(const struct choice *c, int64_t i, int64_t at, int64_t columns, int64_t number,
                       struct survivors *ways, struct trail *trails) {
    float fed[TRELLIS_STATES][BLOCK], errors[BLOCK][TRELLIS_STATES];
    for (int state = 0; state < TRELLIS_STATES; state++) {
        const struct trail *trail = trails + state;
        for (int j = 0; j < BLOCK; j++)
            fed[state][j] = c->up[0] * trail->above[1][j] + c->up[1] * trail->above[0][j];
        ways->second[state] = trail->edges[i][0], ways->last[state] = trail->edges[i][1];
        ways->root[state] = (uint8_t)state;
    }
    for (int64_t j = 0; j < columns; j++) {
        struct part part = part_of(c->relative[at + j]);
        struct branches found;
        find_branches(c, ways, part.rest, fed[0] + j, c->rates + class_at(c, at + j) * LODE_RATES, &found);
        int64_t place = (number + j) * TRELLIS_STATES;
        advance(ways, &found, part.common, errors[j], c->from + place, c->indices + place);
    }
    follow(c, i, columns, errors, c->from + number * TRELLIS_STATES, trails);
}

/* Survivors and trails at the begin of a block: costs count from the least, so that they stay small. */
static void begin_block(const struct choice *c, int64_t left, struct survivors *ways, struct trail *trails) {
    int64_t across = c->band[BAND_COLUMNS];
    float lowest = ways->cost[0];
    for (int state = 1; state < TRELLIS_STATES; state++)
        lowest = ways->cost[state] < lowest ? ways->cost[state] : lowest;
    for (int state = 0; state < TRELLIS_STATES; state++) {
        ways->cost[state] -= lowest;
        for (int64_t j = 0; j < least(BLOCK, across - left); j++)
            for (int row = 0; row < 2; row++)
                trails[state].above[row][j] = c->above[row * across + left + j];
    }
}

/* Take the way that leads into a state at the end of a row of blocks, and keep the errors of its last two rows. */
static void take(const struct choice *c, int64_t top, int64_t end, int64_t number, int state) {
    int64_t columns = c->band[BAND_COLUMNS];
    for (int64_t left = (columns - 1) / BLOCK * BLOCK; left >= 0; left -= BLOCK)
        for (int64_t i = end - 1; i >= top; i--)
            for (int64_t j = least(left + BLOCK, columns) - 1; j >= left; j--) {
                int64_t at = c->band[BAND_OFFSET] + i * c->band[BAND_STRIDE] + j;
                int32_t index = c->indices[--number * TRELLIS_STATES + state], size = index < 0 ? -index : index;
                state = c->from[number * TRELLIS_STATES + state];
                c->chosen[at] = index;
                c->counts[(ODD[state] * LODE_CLASSES + class_at(c, at)) * LODE_INDICES +
                          least(size, LODE_INDICES - 1)] += 1.0;
                double point = size ? (double)size - (ODD[state] ? (double)c->half : 0.0) : 0.0;
                if (i >= end - 2)
                    c->above[(i - end + 2) * columns + j] = (float)(c->relative[at] - (index < 0 ? -point : point));
            }
}

/* Errors to what is fed back of them along each of two rows, from the end on, as those to the left are still wanted. */
static void filter_rows(const struct choice *c) {
    int64_t columns = c->band[BAND_COLUMNS];
    for (int row = 0; row < 2; row++) {
        float *errors = c->above + row * columns;
        for (int64_t j = columns - 1; j >= 2; j--)
            errors[j] += c->left[0] * errors[j - 1] + c->left[1] * errors[j - 2];
        if (columns > 1)
            errors[1] += c->left[0] * errors[0];
    }
}

/* Choose the indices of a row of blocks. */
static void choose(const struct choice *c, int64_t top) {
    const int64_t *band = c->band;
    int64_t end = least(top + BLOCK, band[BAND_ROWS]), columns = band[BAND_COLUMNS], number = 0;
    struct survivors ways;
    struct trail trails[TRELLIS_STATES];
    memset(trails, 0, sizeof trails);
    for (int state = 0; state < TRELLIS_STATES; state++)
        ways.cost[state] = state ? __builtin_inff() : 0.0f;
    for (int64_t left = 0; left < columns; left += BLOCK) {
        int64_t width = least(BLOCK, columns - left);
        begin_block(c, left, &ways, trails);
        for (int64_t i = top; i < end; i++, number += width)
            choose_row(c, i - top, band[BAND_OFFSET] + i * band[BAND_STRIDE] + left, width, number, &ways, trails);
    }
    int state = 0;
    for (int other = 1; other < TRELLIS_STATES; other++)
        state = ways.cost[other] < ways.cost[state] ? other : state;
    take(c, top, end, number, state);
    filter_rows(c);
}

int64_t lode_choose(const int64_t *bands, int64_t bands_count, const float *rules, int64_t rules_count,
                    const double *relative, int64_t relative_count, const int8_t *classes, int64_t classes_count,
                    const float *rates, int64_t rates_count, int32_t *chosen, int64_t chosen_count, double *counts,
                    int64_t counts_count, int32_t *indices, int64_t indices_count, uint8_t *from, int64_t from_count,
                    float *above, int64_t above_count) {
    if (classes_count != relative_count || chosen_count != relative_count || bands_count % BAND_FIELDS ||
        rules_count != bands_count / BAND_FIELDS * RULE || rates_count != 2 * LODE_CLASSES * LODE_RATES ||
        counts_count != 2 * LODE_CLASSES * LODE_INDICES || from_count != indices_count)
        return LODE_REFUSED;
    for (int64_t number = 0; number < bands_count / BAND_FIELDS; number++) {
        const int64_t *band = bands + number * BAND_FIELDS;
        const float *rule = rules + number * RULE;
        int64_t columns = band[BAND_COLUMNS];
        if (!is_band(band, relative_count) || !(rule[0] >= 0.0f && rule[0] <= 1.0f) ||
            columns > indices_count / (BLOCK * TRELLIS_STATES) || columns > above_count / 2)
            return LODE_REFUSED;
        struct choice choice = {
            band,  relative, classes, rates,   rule[0], rule[1], {rule[2], rule[3]}, {rule[4], rule[5]},
            above, chosen,   counts,  indices, from};
        for (int64_t j = 0; j < 2 * columns; j++)
            above[j] = 0.0f;
        for (int64_t top = 0; top < band[BAND_ROWS]; top += BLOCK)
            choose(&choice, top);
    }
    return 0;
}
