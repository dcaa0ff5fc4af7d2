/* What contexts see around the coefficients of a block of 8 x 8 (docs/format.md, "Numbers of contexts"): sums of
 * magnitudes in units of the bit-plane, of eight coefficients at once.
 *
 * Magnitudes of the band are multiples of the plane's unit, so sums may be taken of units; those above what contexts
 * tell apart count as MOST. Parents may be known further and are shifted one by one.
 */
#ifndef LODE_SURROUNDINGS_H
#define LODE_SURROUNDINGS_H

#include <stdbool.h>
#include <stdint.h>

#include "eight.h"

enum {
    BLOCK = 8,
    MARGIN = 2,
    HIGH = BLOCK + 2 * MARGIN,
    WIDE = 16, /* columns that are loaded of each row: those of the block, both margins, and what makes it a vector */
    MOST = 17,
    MOST_OF_PARENTS = 12,
    NO_PARENT = 31, /* a shift that leaves no row or column but the first */
};

typedef uint8_t units_t[HIGH][WIDE];

/* Rows of a block with its margins; row and column MARGIN are the block's first. */
struct surroundings {
    units_t units;        /* before the pass */
    eight_t own[HIGH];    /* of the eight columns, with the bits of the pass as they become known */
    uint32_t found[HIGH]; /* in first passes: a bit for each that is not 0, from one column before the block on */
    /* Once `around` says so: the sums of both at distance two in the row; of those, both beside, and twice their own;
     * and the parents' units, one row and column before the block's first parent on. */
    bool around;
    eight_t sides[HIGH], far[HIGH];
    units_t parents;
};

/* What the contexts of a row's coefficients are made of, before the row's own bits. */
struct row {
    uint8_t own[BLOCK];               /* class of the own magnitude, 0 to 3 */
    uint8_t across[BLOCK];            /* 25 times that, 5 times the neighbours in the row, those in the column */
    uint8_t around[BLOCK];            /* class of the parents; for a magnitude of class 1, one of those behind */
    uint8_t far[BLOCK], sides[BLOCK]; /* of the rows at distance two, and of the three between */
    uint32_t room;                    /* a bit for each whose neighbours in the row count as less than four */
};

/* Table entries of contexts. */
#define TWICE(x) x, x
#define FOUR(x) TWICE(x), TWICE(x)
#define EIGHT(x) FOUR(x), FOUR(x)
#define SIXTEEN(x) EIGHT(x), EIGHT(x)
#define SIXTY_FOUR(x) SIXTEEN(x), SIXTEEN(x), SIXTEEN(x), SIXTEEN(x)

/* min(x, 17) */
static const uint8_t SEVENTEEN[256] = {0,
                                       1,
                                       2,
                                       3,
                                       4,
                                       5,
                                       6,
                                       7,
                                       8,
                                       9,
                                       10,
                                       11,
                                       12,
                                       13,
                                       14,
                                       15,
                                       16,
                                       EIGHT(17),
                                       FOUR(17),
                                       TWICE(17),
                                       17,
                                       SIXTEEN(17),
                                       SIXTEEN(17),
                                       SIXTY_FOUR(17),
                                       SIXTY_FOUR(17),
                                       SIXTY_FOUR(17)};

/* Six times the class of a sum: of at most 17 for what is far, and of what is at the sides. */
static const uint8_t RING[160] = {TWICE(0),       TWICE(6),       TWICE(12), TWICE(18), FOUR(24),  FOUR(30), 30,
                                  SIXTY_FOUR(36), SIXTY_FOUR(36), EIGHT(36), FOUR(36),  TWICE(36), 36};

static inline void load_units(const uint32_t *at, int64_t stride, int64_t rows, int plane, uint32_t most,
                              units_t units) {
    for (int64_t i = 0; i < rows; i++, at += stride)
        for (int j = 0; j < WIDE; j++) {
            uint32_t unit = at[j] >> plane;
            units[i][j] = (uint8_t)(unit < most ? unit : most);
        }
}

/* Look at a block whose first coefficient is at `at`. */
static inline void see_block(struct surroundings *s, const uint32_t *at, int64_t stride, int64_t rows, int plane) {
    load_units(at - MARGIN * stride - MARGIN, stride, rows + 2 * MARGIN, plane, MOST, s->units);
    for (int64_t i = 1; i < rows + 3; i++)
        s->own[i] = eight_at(s->units[i] + MARGIN);
    s->around = false;
}

static inline void see_found(struct surroundings *s, int64_t rows) {
    for (int64_t i = 1; i < rows + 3; i++) {
        const uint8_t *units = s->units[i];
        s->found[i] = (units[1] != 0) | bits_of(reaching(s->own[i], 1)) << 1 | (uint32_t)(units[10] != 0) << 9;
    }
}

/* Insignificant coefficients of a row, of those whose bit is set, with a significant neighbour. */
static inline uint32_t to_visit_first(const struct surroundings *s, int64_t i, uint32_t zeros) {
    uint32_t rows = s->found[i - 1] | s->found[i + 1];
    return (rows | rows >> 1 | rows >> 2 | s->found[i] | s->found[i] >> 2) & zeros;
}

/* Take in which of a row's bits are 1. */
static inline void add_around(struct surroundings *s, int64_t i, eight_t ones) {
    s->sides[i] += further(ones);
    s->far[i] += further(ones) + beside(ones) + 2 * ones;
}

static inline void add_bits(struct surroundings *s, int64_t i, uint32_t bits) {
    eight_t ones = ones_of(bits);
    s->own[i] += ones;
    if (s->around)
        add_around(s, i, ones);
}

static inline void see_around(struct surroundings *s, int64_t rows) {
    for (int64_t i = 0; i < rows + 2 * MARGIN; i++) {
        const uint8_t *units = s->units[i];
        s->sides[i] = eight_at(units) + eight_at(units + 4);
        s->far[i] = s->sides[i] + eight_at(units + 1) + 2 * eight_at(units + 2) + eight_at(units + 3);
    }
    for (int64_t i = MARGIN; i < rows + MARGIN; i++)
        add_around(s, i, s->own[i] - eight_at(s->units[i] + MARGIN));
    s->around = true;
}

/* Class of four times the parents in a row of them plus their four neighbours, at most 5. */
static inline eight_t families(const struct surroundings *s, int64_t row) {
    const uint8_t *above = s->parents[row], *own = s->parents[row + 1], *below = s->parents[row + 2];
    eight_t sum = eight_at(above + 1) + eight_at(own) + 4 * eight_at(own + 1) + eight_at(own + 2) + eight_at(below + 1);
    return reaching(sum, 2) + reaching(sum, 4) + reaching(sum, 6) + reaching(sum, 8) + reaching(sum, 12);
}

#endif
