/* A block of 8 x 8 coefficients in one pass of the embedded coder (docs/format.md, "Passes" and "Numbers of contexts").
 *
 * What contexts see is summed up for a row of the block before the row is coded; only what its own bits add follows
 * from coefficient to coefficient.
 */
#ifndef LODE_BLOCK_CODER_H
#define LODE_BLOCK_CODER_H

#include "binary_coder.h"
#include "surroundings.h"
#include "trellis.h"

enum {
    KINDS = 4,
    /* Contexts, and the weights behind them: across, around, signs, flags. */
    ACROSS_OF_CLASS = 5 * 5 * KINDS,
    AROUND = 4 * ACROSS_OF_CLASS,
    AROUND_OF_CLASS = 7 * 6,
    SIGNS = AROUND + 2 * AROUND_OF_CLASS,
    FLAGS = SIGNS + 9 * KINDS,
    WEIGHTS = FLAGS + 27,
    /* Of a trellis, those of the lowest plane: across and around for either quantiser and classes 0 and 1. */
    TRELLIS_ACROSS = WEIGHTS + 4,
    TRELLIS_AROUND = TRELLIS_ACROSS + 2 * 2 * ACROSS_OF_CLASS,
    TRELLIS_WEIGHTS = TRELLIS_AROUND + 2 * 2 * AROUND_OF_CLASS,
    TRELLIS_END = TRELLIS_WEIGHTS + 8,
    MOST_PASSES = 2 * 28,
    /* Of a block's flags: whether a coefficient is significant, or all are. */
    SOME_FOUND = 1,
    ALL_FOUND = 2,
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

/* One row of a block on its way. */
struct visit {
    uint32_t left, seen; /* a bit for each coefficient that is still to be visited, that was or is to be */
    uint32_t zeros;      /* in first passes, the insignificant ones */
    uint32_t bits;       /* writing, those of the plane */
    int64_t at;          /* where the first coefficient stands */
};

LODE_INLINE uint32_t magnitude(int32_t value) {
    uint32_t sign = value < 0 ? UINT32_MAX : 0;
    return ((uint32_t)value ^ sign) - sign;
}

static const uint32_t PLACES[BLOCK] = {1, 2, 4, 8, 16, 32, 64, 128};

/* Bits of a plane of eight coefficients. */
LODE_INLINE uint32_t plane_bits(const int32_t *truth, int plane) {
    uint32_t bits = 0;
    for (int j = 0; j < BLOCK; j++)
        bits |= (0 - (magnitude(truth[j]) >> plane & 1)) & PLACES[j];
    return bits;
}

LODE_INLINE void add_known(uint32_t *known, uint32_t bits, int plane) {
    for (int j = 0; j < BLOCK; j++)
        known[j] += ((bits & PLACES[j]) == PLACES[j] ? UINT32_C(1) : 0) << plane;
}

LODE_INLINE void code_sign(bool reads, struct coder *coder, const struct tiles *tiles, const struct band *band,
                           int64_t at) {
    int8_t *sign = tiles->sign + at;
    int x = clamped(sign[-1] + sign[1], -1, 1), y = clamped(sign[-band->stride] + sign[band->stride], -1, 1);
    int bit = reads ? 0 : tiles->truth[at] < 0;
    bit = code_bit(reads, coder, bit, &tiles->model[SIGNS + KINDS * (3 * (x + 1) + y + 1) + band->kind]);
    *sign = (int8_t)(1 - 2 * bit);
}

/* Code a row whose visited coefficients are all of the classes 2 and 3; its bits. */
LODE_INLINE uint32_t refine_row(bool reads, struct coder *coder, const struct tiles *tiles, const struct band *band,
                                const struct row *row, const struct visit *visit) {
    int32_t *across = tiles->model + band->kind;
    uint32_t ones = 0; /* one place up */
    for (uint32_t left = visit->left; left; left &= left - 1) {
        int j = __builtin_ctz(left);
        int32_t slot = row->across[j] + 5 * (int32_t)((ones & row->room) >> j & 1);
        int bit = code_bit(reads, coder, (int)(visit->bits >> j & 1), across + KINDS * slot);
        ones |= (uint32_t)bit << j << 1;
    }
    return ones >> 1;
}

/* Code any row; its bits. `state` is that of the trellis. */
LODE_INLINE uint32_t code_row(bool reads, enum pass pass, struct coder *coder, const struct tiles *tiles,
                              const struct band *band, const struct row *row, struct visit *visit, int32_t *weights,
                              int *state) {
    int32_t *model = tiles->model;
    uint32_t ones = 0; /* one place up */
    while (visit->left) {
        int j = __builtin_ctz(visit->left), own = pass == FIRST ? 0 : row->own[j], bit = (int)(visit->bits >> j & 1);
        visit->left &= visit->left - 1;
        int32_t slot = KINDS * (row->across[j] + 5 * (int32_t)((ones & row->room) >> j & 1)) + band->kind;
        if (own > 1) {
            bit = code_bit(reads, coder, bit, model + slot);
            ones |= (uint32_t)bit << j << 1;
        } else {
            int odd = pass == LOWEST ? ODD[*state] : 0;
            int32_t *across = model + slot, *around = model + AROUND, *pair = weights + 4 * odd;
            if (pass == LOWEST) {
                across += TRELLIS_ACROSS + 2 * ACROSS_OF_CLASS * odd;
                around += TRELLIS_AROUND - AROUND + 2 * AROUND_OF_CLASS * odd;
            }
            around += row->around[j] + RING[SEVENTEEN[row->far[j]] + row->sides[j] + 2 * (2 * ones >> j & 1)];
            if (own == 1) {
                bit = code_mixed_bit(reads, coder, bit, across, around, pair + 2);
                ones |= (uint32_t)bit << j << 1;
            } else {
                bit = code_guessed_bit(reads, coder, bit, across, around, pair);
                if (bit) {
                    ones |= UINT32_C(2) << j;
                    code_sign(reads, coder, tiles, band, visit->at + j);
                    if (pass == FIRST) {
                        visit->left |= visit->zeros & UINT32_C(2) << j;
                        visit->seen |= visit->zeros & UINT32_C(2) << j;
                    }
                }
            }
        }
        if (pass == LOWEST)
            *state = TRANSITIONS[*state][bit];
    }
    return ones >> 1;
}

/* The state of the trellis after so many indices of 0: after four it is the same again. */
static int after_zeros(int state, int64_t count) {
    for (int64_t i = 0; i < (count & 3); i++)
        state = TRANSITIONS[state][0];
    return state;
}

/* A block of a band. */
struct block {
    int64_t top, left, rows, columns, flag;
};

/* Code whether a block gets a significant coefficient, which has none so far. */
LODE_INLINE int code_flag(bool reads, struct coder *coder, const struct tiles *tiles, const struct band *band,
                          const struct block *block, int plane) {
    int64_t first = block->top >> band->row_shift, last = (block->top + block->rows - 1) >> band->row_shift;
    int64_t left = block->left >> band->column_shift, right = (block->left + block->columns - 1) >> band->column_shift;
    const uint32_t *parents = tiles->known + band->parent;
    uint32_t family = 0, seen = 0;
    for (int64_t i = first; i <= last; i++)
        for (int64_t j = left; j <= right; j++)
            family |= parents[i * band->parent_stride + j];
    family >>= plane;
    if (!reads) {
        const int32_t *truth = tiles->truth + band->offset + block->top * band->stride + block->left;
        for (int64_t i = 0; i < block->rows; i++, truth += band->stride)
            for (int64_t j = 0; j < block->columns; j++)
                seen |= magnitude(truth[j]);
    }
    const uint8_t *flag = tiles->flags + block->flag;
    int before = (flag[-1] != 0) + (flag[-band->across - 1] != 0);
    int after = (flag[1] != 0) + (flag[band->across + 1] != 0);
    int slot = FLAGS + (before * 3 + after) * 3 + (int)(family < 2 ? family : 2);
    return code_bit(reads, coder, seen >> plane != 0, &tiles->model[slot]);
}

/* Sum up what is around a row, the i-th with the margin, before its bits. */
LODE_INLINE void see_row(enum pass pass, struct surroundings *s, const struct tiles *tiles, const struct band *band,
                         const struct block *block, int64_t i, int plane, struct row *row) {
    if (!s->around) {
        int64_t first = block->top >> band->row_shift, last = (block->top + block->rows - 1) >> band->row_shift;
        int64_t corner = band->parent + (first - 1) * band->parent_stride + (block->left >> band->column_shift) - 1;
        see_around(s, block->rows);
        load_units(tiles->known + corner, band->parent_stride, last - first + 3, plane, MOST_OF_PARENTS, s->parents);
    }
    int64_t parent_row = ((block->top + i - MARGIN) >> band->row_shift) - (block->top >> band->row_shift);
    eight_t around = families(s, parent_row);
    if (band->column_shift)
        around = band->column_shift == NO_PARENT ? repeated(around) : doubled(around);
    if (pass != FIRST)
        around += AROUND_OF_CLASS * (s->own[i] >> 1 & EACH);
    put_eight(row->around, around);
    put_eight(row->far, s->far[i - 2] + s->far[i + 2]);
    put_eight(row->sides, s->sides[i - 1] + s->sides[i + 1] + 2 * s->sides[i]);
}

/* Code the row of a block that has so many columns, the i-th with the margin. */
LODE_INLINE void visit_row(bool reads, enum pass pass, struct coder *coder, const struct tiles *tiles,
                           const struct band *band, const struct block *block, struct surroundings *s, int64_t i,
                           int plane, int32_t *weights, int *state) {
    int64_t at = band->offset + (block->top + i - MARGIN) * band->stride + block->left;
    uint32_t inside = (UINT32_C(1) << block->columns) - 1;
    struct visit visit = {0, 0, 0, 0, at};
    struct row row;
    if (pass == FIRST) {
        visit.zeros = ~(s->found[i] >> 1) & inside;
        visit.left = to_visit_first(s, i, visit.zeros);
    } else if (pass == SECOND) {
        eight_t unlike = eight_at(tiles->early + at) ^ (uint64_t)(plane + 1) * EACH;
        visit.left = bits_of(reaching(unlike & 127 * EACH, 1)) & inside;
    } else {
        visit.left = inside;
    }
    if (visit.left == 0)
        return;
    visit.seen = visit.left;
    if (!reads)
        visit.bits = plane_bits(tiles->truth + at, plane);
    eight_t side = eight_at(s->units[i] + 1) + eight_at(s->units[i] + 3), full = reaching(side, 4);
    eight_t across = 5 * at_most(side, 4) + at_most(s->own[i - 1] + s->own[i + 1], 4);
    row.room = ~bits_of(full);
    uint32_t low = UINT32_MAX; /* coefficients of the classes 0 and 1 */
    if (pass != FIRST) {
        eight_t two = reaching(s->own[i], 4), own = reaching(s->own[i], 2) + two + reaching(s->own[i], 8);
        put_eight(row.own, own);
        across += 25 * own;
        low = ~bits_of(two);
    }
    put_eight(row.across, across);
    uint32_t ones;
    if (pass == LOWEST || visit.left & low) {
        see_row(pass, s, tiles, band, block, i, plane, &row);
        ones = code_row(reads, pass, coder, tiles, band, &row, &visit, weights, state);
    } else {
        ones = refine_row(reads, coder, tiles, band, &row, &visit);
    }
    add_bits(s, i, ones);
    add_known(tiles->known + at, ones, plane);
    if (pass == FIRST) {
        s->found[i] |= ones << 1;
        eight_t seen = ones_of(visit.seen), marks = eight_at(tiles->early + at);
        put_eight(tiles->early + at, (marks & ~(255 * seen)) + (uint64_t)(plane + 1) * seen);
    }
}

/* Whether all coefficients of a block are significant. */
static bool all_found(const struct surroundings *s, const struct block *block) {
    uint32_t inside = ((UINT32_C(1) << block->columns) - 1) << 1, found = inside;
    for (int64_t i = MARGIN; i < block->rows + MARGIN; i++)
        found &= s->found[i];
    return found == inside;
}

/* Code a block. */
LODE_INLINE void code_block(bool reads, enum pass pass, struct coder *coder, const struct tiles *tiles,
                            const struct band *band, const struct block *block, int plane, int32_t *weights,
                            int *state) {
    uint8_t *flag = tiles->flags + block->flag;
    if (pass == FIRST && *flag != SOME_FOUND)
        return;
    if (!*flag) {
        if (!code_flag(reads, coder, tiles, band, block, plane)) {
            if (pass == LOWEST)
                *state = after_zeros(*state, block->rows * block->columns);
            return;
        }
        *flag = SOME_FOUND;
    }
    struct surroundings s;
    see_block(&s, tiles->known + band->offset + block->top * band->stride + block->left, band->stride, block->rows,
              plane);
    if (pass == FIRST) {
        see_found(&s, block->rows);
        if (all_found(&s, block)) {
            *flag = ALL_FOUND;
            return;
        }
    }
    for (int64_t i = MARGIN; i < block->rows + MARGIN; i++)
        visit_row(reads, pass, coder, tiles, band, block, &s, i, plane, weights, state);
}

#endif
