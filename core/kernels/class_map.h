/* What the class coder knows of a stripe before a pass, 8 rows and 64 columns of a band (docs/format.md, "Large
 * units"): the planes above and the parents alone decide which coefficients a pass visits, and in which contexts.
 *
 * A coefficient has an age: 0 where it is not significant above this plane, 1 where its highest bit stands in the plane
 * above, 2 where higher. It follows from the plane in which the coefficient was found, a byte each.
 */
#ifndef LODE_CLASS_MAP_H
#define LODE_CLASS_MAP_H

#include <stdbool.h>
#include <stdint.h>

#include "contexts.h"

enum {
    STRIPE_ROWS = BLOCK,
    STRIPE_COLUMNS = 64,
    STRIPE_BLOCKS = STRIPE_COLUMNS / BLOCK,
    STRIPE_SIZE = STRIPE_ROWS * STRIPE_COLUMNS,
    DISTANT = 5, /* classes of what is further off, for each class of the eight neighbours */
    CLASSES = 5 * DISTANT,
    /* A mark is 1 + the plane in which a coefficient was found, and this if its second pass did. */
    FOUND_SECOND = 128,
};

/* A part of a band. */
struct stripe {
    int64_t top, left; /* its first row and column */
    int64_t first;     /* the place of its first coefficient */
    int rows, columns;
};

struct class_map {
    uint8_t weights[STRIPE_ROWS + 2 * MARGIN][STRIPE_COLUMNS + 2 * MARGIN + 12]; /* by age: 0, 2, 3 */
    uint8_t context[STRIPE_ROWS][STRIPE_COLUMNS]; /* of significance; CLASSES for a refinement */
};

/* What the parents of a row of the stripe add to what is far; nothing where there are none. */
LODE_INLINE void sum_parents(const uint8_t *above, const uint8_t *own, const uint8_t *below, int columns, int shift,
                             uint8_t *sums) {
    uint8_t of[STRIPE_COLUMNS] = {0};
    int count = ((columns - 1) >> shift) + 1;
    for (int j = 0; j < count; j++) {
        uint8_t around = (uint8_t)(above[j + 1] + own[j] + own[j + 2] + below[j + 1]), self = own[j + 1];
        of[j] = (uint8_t)(3 * (self < MOST_OF_PARENT ? self : MOST_OF_PARENT) +
                          (around < MOST_BESIDE_PARENT ? around : MOST_BESIDE_PARENT));
    }
    for (int j = 0; j < STRIPE_COLUMNS; j += BLOCK)
        put_eight(sums + j, shift == 0 ? eight_at(of + j) : shift == 1 ? doubled(eight_at(of + j / 2)) : 0);
}

/* Units of parents and of what is around them, at most 12. */
LODE_INLINE void see_parents(const uint32_t *at, int64_t stride, int rows, int columns, int plane,
                             uint8_t parents[STRIPE_ROWS + 2][STRIPE_COLUMNS + 16]) {
    at -= stride + 1;
    for (int i = 0; i < rows + 2; i++, at += stride)
        for (int j = 0; j < columns + 2; j++) {
            uint32_t unit = at[j] >> plane;
            parents[i][j] = (uint8_t)(unit < MOST_BESIDE_PARENT ? unit : MOST_BESIDE_PARENT);
        }
}

LODE_INLINE void see_weights(const uint8_t *marks, int64_t stride, int rows, int columns, int plane,
                             struct class_map *map) {
    marks -= MARGIN * stride + MARGIN;
    uint8_t one = (uint8_t)(plane + 2), two = (uint8_t)(plane + 3);
    for (int i = 0; i < rows + 2 * MARGIN; i++, marks += stride)
        for (int j = 0; j < columns + 2 * MARGIN; j++) {
            uint8_t mark = marks[j] & (FOUND_SECOND - 1);
            map->weights[i][j] = (uint8_t)((mark >= one ? 2 : 0) + (mark >= two ? 1 : 0));
        }
}

/* Sixteen small numbers at once. */
typedef uint8_t bytes_t __attribute__((vector_size(16)));

static inline bytes_t bytes_at(const uint8_t *at) {
    bytes_t bytes;
    memcpy(&bytes, at, sizeof bytes);
    return bytes;
}

/* The context of each coefficient of a row, from the sums of its parents and the weights of five rows, of which the
 * third is its own; each of them begins at the margin. */
static inline void see_contexts(const uint8_t *sums, const uint8_t *a, const uint8_t *b, const uint8_t *own,
                                const uint8_t *d, const uint8_t *e, uint8_t *context) {
    for (int j = 0; j < STRIPE_COLUMNS; j += 16, a += 16, b += 16, own += 16, d += 16, e += 16) {
        bytes_t corners = bytes_at(b + 1) + bytes_at(d + 1) + bytes_at(b + 3) + bytes_at(d + 3);
        bytes_t beside = bytes_at(own + 1) + bytes_at(own + 3) + bytes_at(b + 2) + bytes_at(d + 2);
        bytes_t across = bytes_at(own) + bytes_at(own + 4) + bytes_at(a + 2) + bytes_at(e + 2);
        bytes_t ring = bytes_at(b) + bytes_at(d) + bytes_at(b + 4) + bytes_at(d + 4) + bytes_at(a) + bytes_at(e) +
                       bytes_at(a + 1) + bytes_at(e + 1) + bytes_at(a + 3) + bytes_at(e + 3) + bytes_at(a + 4) +
                       bytes_at(e + 4);
        bytes_t near = 3 * beside + 2 * corners, far = 2 * across + ring + bytes_at(sums + j);
        /* A comparison that holds gives 255, which is -1. */
        bytes_t high = (bytes_t)(near >= 1) + (bytes_t)(near >= 6) + (bytes_t)(near >= 13) + (bytes_t)(near >= 24);
        bytes_t low = (bytes_t)(far >= 1) + (bytes_t)(far >= 4) + (bytes_t)(far >= 9) + (bytes_t)(far >= 18);
        bytes_t class = 0 - DISTANT * high - low, significant = (bytes_t)(bytes_at(own + 2) != 0);
        class = (class & ~significant) | (CLASSES & significant);
        memcpy(context + j, &class, sizeof class);
    }
}

/* Whether a row has a coefficient that is not significant among those that may be. */
static inline bool has_zeros(const uint8_t *weights, const uint8_t *possible) {
    bytes_t any = {0};
    for (int j = 0; j < STRIPE_COLUMNS; j += 16)
        any |= (bytes_t)(bytes_at(weights + j) == 0) & bytes_at(possible + j);
    uint64_t halves[2];
    memcpy(halves, &any, sizeof halves);
    return (halves[0] | halves[1]) != 0;
}

/* Look at a stripe before a pass.
 *
 * marks:    of the stripe's band; `parents` begins at that of its first coefficient.
 * possible: 255 for each column that may be visited, else 0.
 */
static void see_stripe(const uint8_t *marks, int64_t stride, const struct stripe *stripe, const uint32_t *parents,
                       int64_t parent_stride, int row_shift, int column_shift, int plane, const uint8_t *possible,
                       struct class_map *map) {
    if (stripe->rows == STRIPE_ROWS && stripe->columns == STRIPE_COLUMNS)
        see_weights(marks, stride, STRIPE_ROWS, STRIPE_COLUMNS, plane, map);
    else {
        memset(map->weights, 0, sizeof map->weights);
        see_weights(marks, stride, stripe->rows, stripe->columns, plane, map);
    }
    uint8_t seen[STRIPE_ROWS + 2][STRIPE_COLUMNS + 16], sums[STRIPE_COLUMNS] = {0};
    int64_t first = stripe->top >> row_shift, before = -1;
    int rows = (int)(((stripe->top + stripe->rows - 1) >> row_shift) - first) + 1;
    int columns = ((stripe->columns - 1) >> column_shift) + 1;
    for (int i = 0; i < stripe->rows; i++) {
        if (!has_zeros(map->weights[i + MARGIN] + MARGIN, possible)) {
            memset(map->context[i], CLASSES, STRIPE_COLUMNS);
            continue;
        }
        if (before < 0) {
            if (rows == STRIPE_ROWS / 2 && columns == STRIPE_COLUMNS / 2)
                see_parents(parents, parent_stride, STRIPE_ROWS / 2, STRIPE_COLUMNS / 2, plane, seen);
            else
                see_parents(parents, parent_stride, rows, columns, plane, seen);
        }
        int64_t parent = ((stripe->top + i) >> row_shift) - first;
        if (parent != before && column_shift == 1 && stripe->columns == STRIPE_COLUMNS)
            sum_parents(seen[parent], seen[parent + 1], seen[parent + 2], STRIPE_COLUMNS, 1, sums);
        else if (parent != before)
            sum_parents(seen[parent], seen[parent + 1], seen[parent + 2], stripe->columns, column_shift, sums);
        before = parent;
        see_contexts(sums, map->weights[i], map->weights[i + 1], map->weights[i + 2], map->weights[i + 3],
                     map->weights[i + 4], map->context[i]);
    }
}

#endif
