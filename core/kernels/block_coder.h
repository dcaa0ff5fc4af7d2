/* A block of 8 x 8 coefficients in one pass of the sequential coder (docs/format.md, "Passes" and "Contexts of a
 * unit").
 *
 * What contexts see is summed up for a row of the block before the row is coded; only what its own bits add follows
 * from coefficient to coefficient.
 */
#ifndef LODE_BLOCK_CODER_H
#define LODE_BLOCK_CODER_H

#include "band_fields.h"
#include "binary_coder.h"
#include "contexts.h"
#include "trellis.h"

enum {
    KINDS = 4,
    /* The contexts of a unit: significance, first refinement, signs, flags. */
    FIRST_REFINEMENT = 3 * 3 * 4,
    SIGNS = FIRST_REFINEMENT + 1,
    FLAGS = SIGNS + 15,
    CONTEXTS = FLAGS + 27,
    /* Of a trellis, those of the lowest plane: significance, first and later refinement, for either quantiser. */
    LOWEST_PLANE = CONTEXTS,
    TRELLIS_CONTEXTS = LOWEST_PLANE + 2 * (FIRST_REFINEMENT + 2),
    MOST_PASSES = 2 * 28,
};

/* A first pass; a second one; the only one of the lowest plane of indices. */
enum pass { FIRST, SECOND, LOWEST };

struct tiles {
    uint32_t *known;
    int8_t *sign;
    uint8_t *flags, *early;
    const int32_t *truth;
    int32_t *model; /* of the tile */
};

struct band {
    int64_t offset, stride, rows, columns, flags, across, parent, parent_stride;
    int row_shift, column_shift, kind;
};

static inline struct band band_of(const int64_t *fields) {
    return (struct band){
        .offset = fields[BAND_OFFSET],
        .stride = fields[BAND_STRIDE],
        .rows = fields[BAND_ROWS],
        .columns = fields[BAND_COLUMNS],
        .flags = fields[BAND_FLAGS],
        .across = (fields[BAND_COLUMNS] + BLOCK - 1) / BLOCK,
        .parent = fields[BAND_PARENT],
        .parent_stride = fields[BAND_PARENT_STRIDE],
        .row_shift = (int)fields[BAND_ROW_SHIFT],
        .column_shift = (int)fields[BAND_COLUMN_SHIFT],
        .kind = (int)fields[BAND_KIND],
    };
}

/* A block of a band. */
struct block {
    int64_t top, left, rows, columns, flag;
};

/* What is around a block, from a margin before its first row and column on, and around its parents. */
struct surroundings {
    units_t units, parents;
};

static inline uint32_t magnitude(int32_t value) {
    uint32_t sign = value < 0 ? UINT32_MAX : 0;
    return ((uint32_t)value ^ sign) - sign;
}

static const uint32_t PLACES[BLOCK] = {1, 2, 4, 8, 16, 32, 64, 128};

/* Bits of a plane of eight coefficients. */
static inline uint32_t plane_bits(const int32_t *truth, int plane) {
    uint32_t bits = 0;
    for (int j = 0; j < BLOCK; j++)
        bits |= (0 - (magnitude(truth[j]) >> plane & 1)) & PLACES[j];
    return bits;
}

static inline void add_known(uint32_t *known, uint32_t bits, int plane) {
    for (int j = 0; j < BLOCK; j++)
        known[j] += ((bits & PLACES[j]) == PLACES[j] ? UINT32_C(1) : 0) << plane;
}

/* The state of the trellis after so many indices of 0: after four it is the same again. */
static inline int after_zeros(int state, int64_t count) {
    for (int64_t i = 0; i < (count & 3); i++)
        state = TRANSITIONS[state][0];
    return state;
}

LODE_INLINE void code_sign(bool reads, struct coder *coder, const struct tiles *tiles, const struct band *band,
                           int64_t at) {
    int8_t *sign = tiles->sign + at;
    int x = clamped(sign[-1] + sign[1], -1, 1), y = clamped(sign[-band->stride] + sign[band->stride], -1, 1);
    int sum = band->kind == 2 ? 3 * y + x : 3 * x + y, flip = sum < 0;
    int32_t *context = tiles->model + SIGNS + 3 * (flip ? -sum : sum) + (band->kind > 1 ? band->kind - 1 : 0);
    int bit = reads ? 0 : (tiles->truth[at] < 0) ^ flip;
    bit = code_bit(reads, coder, bit, context) ^ flip;
    *sign = (int8_t)(1 - 2 * bit);
}

/* All bits of the parents of a block's coefficients. */
static inline uint32_t parents_in(const struct tiles *tiles, const struct band *band, const struct block *block) {
    int64_t first = block->top >> band->row_shift, last = (block->top + block->rows - 1) >> band->row_shift;
    int64_t left = block->left >> band->column_shift, right = (block->left + block->columns - 1) >> band->column_shift;
    const uint32_t *parents = tiles->known + band->parent;
    uint32_t family = 0;
    for (int64_t i = first; i <= last; i++)
        for (int64_t j = left; j <= right; j++)
            family |= parents[i * band->parent_stride + j];
    return family;
}

/* All bits of the magnitudes of a block that is written. */
static inline uint32_t truth_in(const struct tiles *tiles, const struct band *band, const struct block *block) {
    const int32_t *truth = tiles->truth + band->offset + block->top * band->stride + block->left;
    uint32_t seen = 0;
    for (int64_t i = 0; i < block->rows; i++, truth += band->stride)
        for (int64_t j = 0; j < block->columns; j++)
            seen |= magnitude(truth[j]);
    return seen;
}

/* Code whether a block gets a significant coefficient, which has none so far. */
LODE_INLINE int code_flag(bool reads, struct coder *coder, const struct tiles *tiles, const struct band *band,
                          const struct block *block, int plane) {
    uint32_t family = parents_in(tiles, band, block) >> plane;
    const uint8_t *flag = tiles->flags + block->flag;
    int before = (flag[-1] != 0) + (flag[-band->across - 1] != 0);
    int after = (flag[1] != 0) + (flag[band->across + 1] != 0);
    int slot = FLAGS + (before * 3 + after) * 3 + (int)(family < 2 ? family : 2);
    return code_bit(reads, coder, !reads && truth_in(tiles, band, block) >> plane != 0, &tiles->model[slot]);
}

/* Look at a block, and at what is around its parents. */
static inline void see_block(struct surroundings *s, const struct tiles *tiles, const struct band *band,
                             const struct block *block, int plane) {
    const uint32_t *own = tiles->known + band->offset + block->top * band->stride + block->left;
    load_units(own - MARGIN * band->stride - MARGIN, band->stride, block->rows + 2 * MARGIN, plane, MOST, s->units);
    int64_t first = block->top >> band->row_shift, last = (block->top + block->rows - 1) >> band->row_shift;
    const uint32_t *parent = tiles->known + band->parent + (first - 1) * band->parent_stride;
    load_units(parent + (block->left >> band->column_shift) - 1, band->parent_stride, last - first + 3, plane,
               MOST_BESIDE_PARENT, s->parents);
}

/* Numbers of a row's contexts of significance: of each coefficient a part by its neighbours in the row and the column,
 * and a part by what is further off. Either is known for both cases, that of a coefficient before it in the row, at
 * distance one or two, a bit of this plane makes the unit one more, or not. */
struct row {
    uint8_t near[2][BLOCK], far[2][BLOCK];
};

/* What comes from the parents of a row of the block. */
static inline eight_t parents_of(const struct surroundings *s, const struct band *band, const struct block *block,
                                 int64_t row) {
    int64_t parent = ((block->top + row) >> band->row_shift) - (block->top >> band->row_shift);
    eight_t sum = parent_sum(s->parents[parent + 1] + 1);
    return band->column_shift == 0 ? sum : band->column_shift == 1 ? doubled(sum) : repeated(sum);
}

static inline struct row see_row(const struct surroundings *s, const struct band *band, const struct block *block,
                                 int64_t number) {
    const uint8_t *units = s->units[number + MARGIN] + MARGIN;
    uint64_t across = band->kind == 2 ? 4 : 12, down = 16 - across;
    eight_t two = beside(units, 1), column = down * class_of_two(upright(units, 1));
    eight_t sum = further(units) + parents_of(s, band, block, number);
    struct row row;
    for (uint64_t more = 0; more < 2; more++) {
        put_eight(row.near[more], across * class_of_two(two + more * EACH) + column);
        put_eight(row.far[more], class_of_further(sum + 2 * more * EACH));
    }
    return row;
}

/* Code a row of a block; `state` is that of the trellis. */
LODE_INLINE void code_row(bool reads, enum pass pass, struct coder *coder, const struct tiles *tiles,
                          const struct band *band, const struct block *block, struct surroundings *s, int64_t number,
                          int plane, int *state) {
    int64_t at = band->offset + (block->top + number) * band->stride + block->left;
    uint8_t *units = s->units[number + MARGIN] + MARGIN;
    eight_t before = eight_at(units);
    /* A bit for each coefficient: those to be visited, insignificant ones, and those refined before. */
    uint32_t left = (UINT32_C(1) << block->columns) - 1, zeros = left & ~bits_of(reaching(before, 1));
    uint32_t refined = bits_of(reaching(before, MOST));
    if (pass == FIRST) {
        left = zeros;
        if (left)
            left &= bits_of(reaching(beside(units, 1) + upright(units, 1) + corners(units), 1));
    } else if (pass == SECOND) {
        eight_t unlike = eight_at(tiles->early + at) ^ (uint64_t)(plane + 1) * EACH;
        left &= bits_of(reaching(unlike & 127 * EACH, 1));
    }
    if (left == 0)
        return;
    struct row row;
    if (left & zeros)
        row = see_row(s, band, block, number);
    int32_t *model = tiles->model;
    uint32_t bits = reads ? 0 : plane_bits(tiles->truth + at, plane), visited = left;
    uint32_t ones = 0, grown = 0; /* the latter two places up */
    while (left) {
        int j = __builtin_ctz(left), odd = pass == LOWEST ? ODD[*state] : 0, bit = (int)(bits >> j & 1);
        uint32_t own = UINT32_C(1) << j;
        left &= left - 1;
        if (zeros & own) {
            int slot = row.near[grown >> j >> 1 & 1][j] + row.far[grown >> j & 1][j];
            bit = code_bit(reads, coder, bit, model + (pass == LOWEST ? LOWEST_PLANE + 2 * slot + odd : slot));
            if (bit) {
                ones |= own;
                grown |= own << 2;
                code_sign(reads, coder, tiles, band, at + j);
                if (pass == FIRST) {
                    left |= zeros & own << 1;
                    visited |= zeros & own << 1;
                }
            }
        } else if (pass != FIRST) {
            if (refined & own) {
                bit = pass == LOWEST
                          ? code_bit(reads, coder, bit, model + LOWEST_PLANE + 2 * (FIRST_REFINEMENT + 1) + odd)
                          : code_raw_bit(reads, coder, bit);
            } else {
                bit = code_bit(reads, coder, bit,
                               model + (pass == LOWEST ? LOWEST_PLANE + 2 * FIRST_REFINEMENT + odd : FIRST_REFINEMENT));
                grown |= (uint32_t)bit << j << 2;
            }
            ones |= (uint32_t)bit << j;
        }
        if (pass == LOWEST)
            *state = TRANSITIONS[*state][bit];
    }
    put_eight(units, before + ones_of(grown >> 2));
    add_known(tiles->known + at, ones, plane);
    if (pass == FIRST) {
        eight_t seen = ones_of(visited), marks = eight_at(tiles->early + at);
        put_eight(tiles->early + at, (marks & ~(255 * seen)) + (uint64_t)(plane + 1) * seen);
    }
}

/* Code a block. */
LODE_INLINE void code_block(bool reads, enum pass pass, struct coder *coder, const struct tiles *tiles,
                            const struct band *band, const struct block *block, int plane, int *state) {
    uint8_t *flag = tiles->flags + block->flag;
    if (!*flag && pass != FIRST)
        *flag = (uint8_t)code_flag(reads, coder, tiles, band, block, plane);
    if (!*flag) {
        if (pass == LOWEST)
            *state = after_zeros(*state, block->rows * block->columns);
        return;
    }
    struct surroundings s;
    see_block(&s, tiles, band, block, plane);
    for (int64_t row = 0; row < block->rows; row++)
        code_row(reads, pass, coder, tiles, band, block, &s, row, plane, state);
}

#endif
