/* What the contexts of a block of 8 x 8 coefficients see (docs/format.md, "Contexts of a unit"), of eight coefficients
 * at once.
 *
 * Magnitudes of the band are multiples of the plane's unit, so sums may be taken of units; those above 3 count as 3.
 * Parents may be known further and are shifted one by one.
 */
#ifndef LODE_SURROUNDINGS_H
#define LODE_SURROUNDINGS_H

#include <stdint.h>

#include "eight.h"

enum {
    BLOCK = 8,
    MARGIN = 2,
    HIGH = BLOCK + 2 * MARGIN,
    WIDE = 16, /* columns that are loaded of each row: those of the block, both margins, and what makes it a vector */
    MOST = 3,
    MOST_OF_PARENT = 4,
    MOST_BESIDE_PARENT = 12,
    NO_PARENT = 31, /* a shift that leaves no row or column but the first */
};

typedef uint8_t units_t[HIGH][WIDE];

static inline void load_units(const uint32_t *at, int64_t stride, int64_t rows, int plane, uint32_t most,
                              units_t units) {
    for (int64_t i = 0; i < rows; i++, at += stride)
        for (int j = 0; j < WIDE; j++) {
            uint32_t unit = at[j] >> plane;
            units[i][j] = (uint8_t)(unit < most ? unit : most);
        }
}

/* Sums over a row of a block that begins at `units`: both at a distance in the row, both so many rows above and below,
 * and the four at the corners. */
static inline eight_t beside(const uint8_t *units, int distance) {
    return eight_at(units - distance) + eight_at(units + distance);
}

static inline eight_t upright(const uint8_t *units, int distance) {
    return eight_at(units - distance * WIDE) + eight_at(units + distance * WIDE);
}

static inline eight_t corners(const uint8_t *units) {
    return beside(units - WIDE, 1) + beside(units + WIDE, 1);
}

/* The corners and those at distance two, but the corners and those in the same row or column twice; at most 84. */
static inline eight_t further(const uint8_t *units) {
    return 2 * (corners(units) + beside(units, 2) + upright(units, 2)) + upright(units - 1, 2) + upright(units + 1, 2) +
           beside(units - WIDE, 2) + beside(units + WIDE, 2) + beside(units - 2 * WIDE, 2) +
           beside(units + 2 * WIDE, 2);
}

/* Of a row of parents: three times each, plus the four around it; at most 24. */
static inline eight_t parent_sum(const uint8_t *units) {
    eight_t around = beside(units, 1) + upright(units, 1);
    return 3 * at_most(eight_at(units), MOST_OF_PARENT) + at_most(around, MOST_BESIDE_PARENT);
}

/* Classes of sums. */
static inline eight_t class_of_two(eight_t sum) {
    return reaching(sum, 1) + reaching(sum, 3);
}

static inline eight_t class_of_further(eight_t sum) {
    return reaching(sum, 1) + reaching(sum, 4) + reaching(sum, 12);
}

#endif
