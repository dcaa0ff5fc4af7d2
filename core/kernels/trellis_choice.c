/* Which index each coefficient gets: the one that costs least, in squared error and in bits (docs/mathematics.md,
 * "Quantised for one error").
 *
 * What an index costs is known by the class of its coefficient, that is by the size of what is around it. The indices
 * of a row of blocks depend on each other by the trellis; Viterbi's algorithm takes the cheapest of all ways through
 * it. Errors of coefficients close to each other add up in the surface: what counts is the error of each coefficient
 * and what a filter feeds back of those before it, above and to the left. So each survivor of the algorithm keeps its
 * errors.
 */
#include "bands.h"
#include "copying.h"
#include "lodestream.h"
#include "trellis.h"

#define LODE_INLINE static inline __attribute__((always_inline))

enum {
    BLOCK = 8, /* rows and columns of the blocks in whose order a band is coded */
    LANES = TRELLIS_STATES,
    PLACES = LANES / 2, /* of a half */
    RULE = 6,           /* numbers that a band's rule has */
    SMALL = 32,         /* below it, coefficients are worked on as they are */
    MOST = 61,          /* in the search for an index: two above it have a rate, too */
    LARGEST = (1 << 28) - 2 * LODE_RATES,
};

/* States are worked on four at a time, as two halves. What a coefficient leads into comes pairwise from the same place
 * of either half: {0, 2} from 0 and 4, {1, 3} from 2 and 6, {5, 7} from 1 and 7, {6, 4} from 3 and 5. The first of a
 * pair takes an even index from the first half or an odd one from the second half, the other one the reverse. */
static const uint8_t STATES[TRELLIS_STATES] = {0, 2, 1, 3, 4, 6, 7, 5};

typedef float floats_t __attribute__((vector_size(16)));
typedef int32_t ints_t __attribute__((vector_size(16)));

/* Of each place the first where the mask is set, else the second. */
LODE_INLINE ints_t either(ints_t mask, ints_t first, ints_t second) {
    return (mask & first) | (~mask & second);
}

LODE_INLINE floats_t either_float(ints_t mask, floats_t first, floats_t second) {
    return (floats_t)either(mask, (ints_t)first, (ints_t)second);
}

/* The halves after a coefficient, from the first and the second state of each pair. */
LODE_INLINE void arrange(const ints_t *pairs, ints_t *halves) {
    ints_t x = pairs[0], y = pairs[1];
    halves[0] = (ints_t){x[0], y[0], x[1], y[1]};
    halves[1] = (ints_t){y[3], x[3], y[2], x[2]};
}

/* A band whose indices are chosen. Errors are in steps. */
struct choice {
    const int64_t *band;
    const double *relative;
    const int8_t *classes;
    const float *rates;
    floats_t half; /* how far below an index its point lies, by the place of a state */
    float weight;  /* of a squared error */
    float up[2];   /* what is fed back of errors one and two rows above, */
    float left[2]; /* and one and two columns to the left */
    float *above;  /* errors of the two rows above the row of blocks, the upper one first, filtered along the rows */
    int32_t *chosen;
    double *counts;
    int16_t *ways;
};

/* The ways through a row of a block, by the state that they lead to. */
struct survivors {
    floats_t cost[2];
    floats_t last[2], second[2]; /* errors one and two columns before, in the row */
    ints_t root[2];              /* the lane at the row's begin */
};

/* What a way has left behind, for the rows to come. */
struct trail {
    float edges[BLOCK][2]; /* last two errors of each row: of this block where that is done, else of the one before */
    float above[2][BLOCK]; /* errors two rows and one row above, filtered along the row */
};

/* What it takes to give a coefficient an even index and an odd one, for each half. */
struct branches {
    floats_t cost[2][2];
    floats_t error[2][2];
    ints_t index[2][2];
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
LODE_INLINE void find_branches(const struct choice *c, const struct survivors *s, float rest, const float *fed,
                               const float *rates, struct branches *found) {
    const float *even = rates, *odd = rates + LODE_CLASSES * LODE_RATES;
    const floats_t none_rate = {even[0], even[0], odd[0], odd[0]}, zeros = {0};
    for (int h = 0; h < 2; h++) {
        ints_t root = s->root[h] * BLOCK;
        floats_t wanted = {fed[root[0]], fed[root[1]], fed[root[2]], fed[root[3]]};
        wanted += rest + c->left[0] * s->last[h] + c->left[1] * s->second[h];
        ints_t sign = (ints_t)wanted & INT32_MIN;
        floats_t size = (floats_t)((ints_t)wanted ^ sign);
        size = either_float(size < MOST, size, zeros + MOST);
        ints_t below = __builtin_convertvector(size + c->half, ints_t);
        floats_t low = __builtin_convertvector(below, floats_t) - c->half, high = low + 1.0f;
        low = either_float(low > 0.0f, low, zeros); /* index 0 */
        const float *at[PLACES] = {even + below[0], even + below[1], odd + below[2], odd + below[3]};
        floats_t low_cost = {at[0][0], at[1][0], at[2][0], at[3][0]};
        floats_t high_cost = {at[0][1], at[1][1], at[2][1], at[3][1]};
        floats_t none_cost = c->weight * (size * size) + none_rate;
        low_cost += c->weight * ((size - low) * (size - low));
        high_cost += c->weight * ((high - size) * (high - size));
        ints_t is_odd = -(below & 1), flip = sign >> 31;
        floats_t even_cost = either_float(is_odd, high_cost, low_cost);
        floats_t even_point = either_float(is_odd, high, low), odd_point = either_float(is_odd, low, high);
        ints_t even_index = below + (below & 1), odd_index = below | 1;
        ints_t some = ~(none_cost < even_cost);
        found->cost[0][h] = s->cost[h] + either_float(some, even_cost, none_cost);
        found->cost[1][h] = s->cost[h] + either_float(is_odd, low_cost, high_cost);
        found->error[0][h] = rest - (floats_t)((some & (ints_t)even_point) ^ sign);
        found->error[1][h] = rest - (floats_t)((ints_t)odd_point ^ sign);
        found->index[0][h] = ((some & even_index) ^ flip) - flip;
        found->index[1][h] = (odd_index ^ flip) - flip;
    }
}

/* One coefficient further: of the two branches into each state the cheaper one. A way is an index times LANES, plus the
 * lane that it comes from. */
LODE_INLINE void advance(struct survivors *s, const struct branches *found, float *errors, int16_t *ways) {
    const ints_t first = {0, 1, 2, 3}, second = {4, 5, 6, 7};
    floats_t cost[2], error[2], last[2];
    ints_t root[2], way[2];
    for (int other = 0; other < 2; other++) {
        int k = 1 - other; /* whether an index from the second half is odd */
        ints_t takes = found->cost[k][1] < found->cost[other][0];
        cost[other] = either_float(takes, found->cost[k][1], found->cost[other][0]);
        error[other] = either_float(takes, found->error[k][1], found->error[other][0]);
        way[other] = either(takes, found->index[k][1] * LANES + second, found->index[other][0] * LANES + first);
        last[other] = either_float(takes, s->last[1], s->last[0]);
        root[other] = either(takes, s->root[1], s->root[0]);
    }
    arrange((const ints_t *)cost, (ints_t *)s->cost);
    arrange((const ints_t *)error, (ints_t *)s->last);
    arrange((const ints_t *)last, (ints_t *)s->second);
    arrange(root, s->root);
    ints_t arranged[2];
    arrange(way, arranged);
    memcpy(errors, s->last, sizeof s->last);
    for (int lane = 0; lane < LANES; lane++)
        ways[lane] = (int16_t)arranged[lane / PLACES][lane % PLACES];
}

/* After row i of a block: the trails of the survivors, each with the row's errors, from those at the row's begin. */
static void follow(const struct choice *c, int64_t i, int64_t columns, float (*errors)[LANES], const int16_t *ways,
                   const struct trail *before, struct trail *after) {
    for (int end = 0; end < LANES; end++) {
        float own[2 + BLOCK] = {0};
        int lane = end;
        for (int64_t j = columns - 1; j >= 0; j--) {
            own[2 + j] = errors[j][lane];
            lane = ways[j * LANES + lane] & (LANES - 1);
        }
        struct trail *trail = after + end;
        *trail = before[lane];
        memcpy(own, trail->edges[i], sizeof trail->edges[i]);
        memcpy(trail->edges[i], own + columns, sizeof trail->edges[i]);
        memcpy(trail->above[0], before[lane].above[1], sizeof trail->above[0]);
        for (int j = 0; j < BLOCK; j++)
            trail->above[1][j] = own[2 + j] + c->left[0] * own[1 + j] + c->left[1] * own[j];
    }
}

static int64_t class_at(const struct choice *c, int64_t at) {
    return c->classes[at] < 0 ? 0 : least(c->classes[at], LODE_CLASSES - 1);
}

/* Row i of a block, whose first coefficient is number `number` of the row of blocks. */
static void choose_row(const struct choice *c, int64_t i, int64_t at, int64_t columns, int64_t number,
                       struct survivors *s, const struct trail *trails, struct trail *after) {
    float fed[LANES][BLOCK], errors[BLOCK][LANES];
    for (int lane = 0; lane < LANES; lane++) {
        const struct trail *trail = trails + lane;
        for (int j = 0; j < BLOCK; j++)
            fed[lane][j] = c->up[0] * trail->above[1][j] + c->up[1] * trail->above[0][j];
        s->second[lane / PLACES][lane % PLACES] = trail->edges[i][0];
        s->last[lane / PLACES][lane % PLACES] = trail->edges[i][1];
        s->root[lane / PLACES][lane % PLACES] = lane;
    }
    int16_t *ways = c->ways + number * LANES;
    for (int64_t j = 0; j < columns; j++) {
        struct branches found;
        const float *rates = c->rates + class_at(c, at + j) * LODE_RATES;
        find_branches(c, s, part_of(c->relative[at + j]).rest, fed[0] + j, rates, &found);
        advance(s, &found, errors[j], ways + j * LANES);
    }
    follow(c, i, columns, errors, ways, trails, after);
}

static float cost_of(const struct survivors *s, int lane) {
    return s->cost[lane / PLACES][lane % PLACES];
}

/* Survivors and trails at the begin of a block: costs count from the least, so that they stay small. */
static void begin_block(const struct choice *c, int64_t left, struct survivors *s, struct trail *trails) {
    int64_t across = c->band[BAND_COLUMNS];
    float least_cost = s->cost[0][0];
    for (int lane = 1; lane < LANES; lane++)
        least_cost = cost_of(s, lane) < least_cost ? cost_of(s, lane) : least_cost;
    s->cost[0] -= least_cost, s->cost[1] -= least_cost;
    for (int lane = 0; lane < LANES; lane++)
        for (int64_t j = 0; j < least(BLOCK, across - left); j++)
            for (int row = 0; row < 2; row++)
                trails[lane].above[row][j] = c->above[row * across + left + j];
}

/* Take the way that ends in a lane at the end of a row of blocks, and keep the errors of its last two rows. */
static void take(const struct choice *c, int64_t top, int64_t end, int64_t number, int lane) {
    int64_t columns = c->band[BAND_COLUMNS];
    for (int64_t left = (columns - 1) / BLOCK * BLOCK; left >= 0; left -= BLOCK)
        for (int64_t i = end - 1; i >= top; i--)
            for (int64_t j = least(left + BLOCK, columns) - 1; j >= left; j--) {
                int64_t at = c->band[BAND_OFFSET] + i * c->band[BAND_STRIDE] + j;
                int32_t way = c->ways[--number * LANES + lane];
                lane = way & (LANES - 1);
                int32_t index = part_of(c->relative[at]).common + (way - lane) / LANES;
                int32_t size = index < 0 ? -index : index;
                int odd = ODD[STATES[lane]];
                c->chosen[at] = index;
                c->counts[(odd * LODE_CLASSES + class_at(c, at)) * LODE_INDICES + least(size, LODE_INDICES - 1)] += 1.0;
                double point = size ? (double)size - (double)c->half[lane % PLACES] : 0.0;
                if (i >= end - 2)
                    c->above[(i - end + 2) * columns + j] = (float)(c->relative[at] - (index < 0 ? -point : point));
            }
}

/* Errors of two rows to what is fed back of them along the row, from the end on: those to the left are still wanted. */
static void filter_rows(const struct choice *c) {
    int64_t columns = c->band[BAND_COLUMNS];
    for (float *row = c->above; row < c->above + 2 * columns; row += columns)
        for (int64_t j = columns - 1; j > 0; j--)
            row[j] = row[j] + c->left[0] * row[j - 1] + c->left[1] * (j > 1 ? row[j - 2] : 0.0f);
}

/* Whether the coefficients of a row of blocks are so small, with all that is fed back, that 0 is the nearest point of
 * both quantisers. */
static bool is_negligible(const struct choice *c, int64_t top, int64_t end) {
    const int64_t *band = c->band;
    double up = magnitude((double)c->up[0]) + magnitude((double)c->up[1]);
    double left = magnitude((double)c->left[0]) + magnitude((double)c->left[1]);
    double above = 0.0, half = (double)c->half[PLACES - 1];
    for (int64_t j = 0; j < 2 * band[BAND_COLUMNS]; j++) {
        double size = magnitude((double)c->above[j]);
        above = size > above ? size : above;
    }
    double limit = ((1.0 - half) / 2.0 - up * above) / ((1.0 + up) * (1.0 + left));
    for (int64_t i = top; i < end; i++) {
        const double *row = c->relative + band[BAND_OFFSET] + i * band[BAND_STRIDE];
        for (int64_t j = 0; j < band[BAND_COLUMNS]; j++)
            if (!(magnitude(row[j]) < limit))
                return false;
    }
    return true;
}

/* Give all coefficients of a row of blocks index 0, which leaves the trellis in state 0. */
static void choose_nothing(const struct choice *c, int64_t top, int64_t end) {
    int64_t columns = c->band[BAND_COLUMNS];
    for (int64_t i = top; i < end; i++)
        for (int64_t j = 0; j < columns; j++) {
            int64_t at = c->band[BAND_OFFSET] + i * c->band[BAND_STRIDE] + j;
            c->chosen[at] = 0;
            c->counts[class_at(c, at) * LODE_INDICES] += 1.0;
            if (i >= end - 2)
                c->above[(i - end + 2) * columns + j] = (float)c->relative[at];
        }
}

/* Choose the indices of a row of blocks. */
static void choose(const struct choice *c, int64_t top) {
    const int64_t *band = c->band;
    int64_t end = least(top + BLOCK, band[BAND_ROWS]), columns = band[BAND_COLUMNS], number = 0;
    if (is_negligible(c, top, end)) {
        choose_nothing(c, top, end);
        filter_rows(c);
        return;
    }
    struct survivors s;
    struct trail trails[2][LANES]; /* in turn at the begin of a row and after it */
    memset(trails, 0, sizeof trails);
    int now = 0;
    float unreached = __builtin_inff();
    s.cost[0] = (floats_t){0.0f, unreached, unreached, unreached};
    s.cost[1] = (floats_t){unreached, unreached, unreached, unreached};
    for (int64_t left = 0; left < columns; left += BLOCK) {
        int64_t width = least(BLOCK, columns - left);
        begin_block(c, left, &s, trails[now]);
        for (int64_t i = top; i < end; i++, number += width, now = 1 - now)
            choose_row(c, i - top, band[BAND_OFFSET] + i * band[BAND_STRIDE] + left, width, number, &s, trails[now],
                       trails[1 - now]);
    }
    int lane = 0;
    for (int other = 1; other < LANES; other++)
        lane = cost_of(&s, other) < cost_of(&s, lane) ? other : lane;
    take(c, top, end, number, lane);
    filter_rows(c);
}

int64_t lode_choose(const struct lode_choose *arguments) {
    const struct lode_choose call = *arguments;
    if (call.classes_count != call.relative_count || call.chosen_count != call.relative_count ||
        call.bands_count % BAND_FIELDS || call.rules_count != call.bands_count / BAND_FIELDS * RULE ||
        call.rates_count != 2 * LODE_CLASSES * LODE_RATES || call.counts_count != 2 * LODE_CLASSES * LODE_INDICES)
        return LODE_REFUSED;
    for (int64_t number = 0; number < call.bands_count / BAND_FIELDS; number++) {
        const int64_t *band = call.bands + number * BAND_FIELDS;
        const float *rule = call.rules + number * RULE;
        int64_t columns = band[BAND_COLUMNS];
        if (!is_band(band, call.relative_count) || !(rule[0] >= 0.0f && rule[0] <= 1.0f) ||
            columns > call.ways_count / (BLOCK * LANES) || columns > call.above_count / 2)
            return LODE_REFUSED;
        struct choice choice = {.band = band, .relative = call.relative, .classes = call.classes, .rates = call.rates};
        choice.weight = rule[1];
        for (int k = 0; k < 2; k++)
            choice.up[k] = rule[2 + k], choice.left[k] = rule[4 + k];
        choice.half = (floats_t){0.0f, 0.0f, rule[0], rule[0]};
        choice.above = call.above, choice.chosen = call.chosen, choice.counts = call.counts, choice.ways = call.ways;
        for (int64_t j = 0; j < 2 * columns; j++)
            call.above[j] = 0.0f;
        for (int64_t top = 0; top < band[BAND_ROWS]; top += BLOCK)
            choose(&choice, top);
    }
    return 0;
}
