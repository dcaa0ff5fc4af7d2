/* What the class coder knows of a stripe before a plane, 8 rows and 64 columns of a band (docs/format.md, "Large
 * units"): the planes above and the parents alone decide which coefficients a pass visits, and in which contexts.
 *
 * A row of the stripe is a mask of 64 bits, one for each column. The weights of a row, 0, 2 and 3, follow from the
 * planes in which coefficients were found, a byte each.
 */
#ifndef LODE_CLASS_MAP_H
#define LODE_CLASS_MAP_H

#include "class_unit.h"
#include "lanes.h"

enum {
    MARKED_ROWS = STRIPE_ROWS + 2 * MARGIN,
    ROW_ROOM = STRIPE_COLUMNS + LANES, /* of a row and its margins, as far as vectors reach */
    DISTANT = 5,                       /* classes of what is further off, for each class of the eight neighbours */
    CLASSES = 5 * DISTANT,             /* beside them a refinement */
};

/* All ones in the first bytes: from the place 8 - n on, in n of eight. */
static const uint8_t WITHIN[2 * BLOCK] = {255, 255, 255, 255, 255, 255, 255, 255};

LODE_INLINE uint64_t columns_of(const struct stripe *stripe) {
    return UINT64_MAX >> (STRIPE_COLUMNS - stripe->columns);
}

/* So many bytes of a row where whole vectors may be loaded: in their place, or copied into `room` with zeros behind
 * them. Of a band no more is there than eights that begin before the end. */
LODE_INLINE const uint8_t *loadable(const uint8_t *row, int bytes, bool whole, uint8_t room[ROW_ROOM]) {
    if (whole)
        return row;
    memset(room, 0, ROW_ROOM);
    for (int j = 0; j < bytes; j += BLOCK)
        put_eight(room + j, eight_at(row + j) & eight_at(bytes - j < BLOCK ? WITHIN + BLOCK - (bytes - j) : WITHIN));
    return room;
}

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

/* What the parents add, of all rows. `parents` begins at that of the first coefficient. */
static void sum_all_parents(const struct stripe *stripe, const uint32_t *parents, int64_t stride, int row_shift,
                            int column_shift, int plane, uint8_t sums[STRIPE_ROWS][STRIPE_COLUMNS]) {
    uint8_t seen[STRIPE_ROWS + 2][STRIPE_COLUMNS + 16];
    int64_t first = stripe->top >> row_shift, before = -1;
    int rows = (int)(((stripe->top + stripe->rows - 1) >> row_shift) - first) + 1;
    int columns = ((stripe->columns - 1) >> column_shift) + 1;
    if (rows == STRIPE_ROWS / 2 && columns == STRIPE_COLUMNS / 2)
        see_parents(parents, stride, STRIPE_ROWS / 2, STRIPE_COLUMNS / 2, plane, seen);
    else
        see_parents(parents, stride, rows, columns, plane, seen);
    for (int i = 0; i < STRIPE_ROWS; i++) {
        int64_t parent = ((stripe->top + i) >> row_shift) - first;
        if (i >= stripe->rows)
            memset(sums[i], 0, STRIPE_COLUMNS);
        else if (parent == before)
            memcpy(sums[i], sums[i - 1], STRIPE_COLUMNS);
        else if (column_shift == 1 && stripe->columns == STRIPE_COLUMNS)
            sum_parents(seen[parent], seen[parent + 1], seen[parent + 2], STRIPE_COLUMNS, 1, sums[i]);
        else
            sum_parents(seen[parent], seen[parent + 1], seen[parent + 2], stripe->columns, column_shift, sums[i]);
        before = parent;
    }
}

/* Weights of a stripe and of the margin around it. */
LODE_INLINE void weigh(const uint8_t *marks, int64_t stride, const struct stripe *stripe, int plane,
                       uint8_t weights[MARKED_ROWS][ROW_ROOM]) {
    uint8_t room[ROW_ROOM];
    bool whole = stripe->columns == STRIPE_COLUMNS;
    lanes_t one = (lanes_t){0} + (int8_t)(plane + 1), two = one + 1;
    marks -= MARGIN * stride + MARGIN;
    for (int i = 0; i < stripe->rows + 2 * MARGIN; i++, marks += stride) {
        const uint8_t *row = loadable(marks, stripe->columns + 2 * MARGIN, whole, room);
        for (int j = 0; j < STRIPE_COLUMNS; j += LANES) {
            lanes_t mark = lanes_at(row + j) & (FOUND_SECOND - 1);
            put_lanes(weights[i] + j, ((lanes_t)(mark > one) & 2) | ((lanes_t)(mark > two) & 1));
        }
        eight_t mark = eight_at(row + STRIPE_COLUMNS) & 127 * EACH; /* four are wanted */
        put_eight(weights[i] + STRIPE_COLUMNS, 2 * reaching(mark, plane + 2) + reaching(mark, plane + 3));
    }
    for (int i = stripe->rows + 2 * MARGIN; i < MARKED_ROWS; i++)
        memset(weights[i], 0, ROW_ROOM);
}

/* Contexts, and which coefficients have a significant neighbour. */
static void see_contexts(uint8_t weights[MARKED_ROWS][ROW_ROOM], uint8_t sums[STRIPE_ROWS][STRIPE_COLUMNS],
                         struct class_map *map) {
    memset(map->near, 0, sizeof map->near);
    for (int j = 0; j < STRIPE_COLUMNS; j += LANES) {
        lanes_t own[MARKED_ROWS], beside[MARKED_ROWS], across[MARKED_ROWS]; /* at distance one and two in the row */
        for (int i = 0; i < MARKED_ROWS; i++) {
            const uint8_t *row = weights[i] + j;
            own[i] = lanes_at(row + 2);
            beside[i] = lanes_at(row + 1) + lanes_at(row + 3);
            across[i] = lanes_at(row) + lanes_at(row + 4);
        }
        for (int i = 0; i < STRIPE_ROWS; i++) {
            const lanes_t *o = own + i, *b = beside + i, *a = across + i;
            lanes_t corners = b[1] + b[3], four = o[1] + o[3] + b[2], both = four + corners;
            lanes_t near = both + both + four, straight = a[2] + o[0] + o[4];
            lanes_t far = straight + straight + a[1] + a[3] + a[0] + a[4] + b[0] + b[4] + lanes_at(sums[i] + j);
            lanes_t any = (lanes_t)(near > 0);
            lanes_t high = any + (lanes_t)(near > 5) + (lanes_t)(near > 12) + (lanes_t)(near > 23);
            lanes_t low = (lanes_t)(far > 0) + (lanes_t)(far > 3) + (lanes_t)(far > 8) + (lanes_t)(far > 17);
            lanes_t twice = high + high, class = 0 - (twice + twice + high + low), found = (lanes_t)(o[2] > 0);
            put_lanes(map->context[i] + j, (class & ~found) | (found & CLASSES));
            map->near[i] |= negative_lanes(any) << j;
        }
    }
}

/* Look at a stripe before a plane.
 *
 * marks:   of the stripe's band, at its first coefficient.
 * parents: magnitudes, at the parent of that.
 */
static void see_stripe(const uint8_t *marks, int64_t stride, const struct stripe *stripe, const uint32_t *parents,
                       int64_t parent_stride, int row_shift, int column_shift, int plane, struct class_map *map) {
    uint8_t weights[MARKED_ROWS][ROW_ROOM], sums[STRIPE_ROWS][STRIPE_COLUMNS];
    uint64_t within = columns_of(stripe), any = 0;
    weigh(marks, stride, stripe, plane, weights);
    for (int i = 0; i < STRIPE_ROWS; i++) {
        uint64_t zero = 0, young = 0;
        for (int j = 0; j < STRIPE_COLUMNS; j += LANES) {
            lanes_t weight = lanes_at(weights[i + MARGIN] + MARGIN + j);
            zero |= negative_lanes((lanes_t)(weight == 0)) << j;
            young |= negative_lanes((lanes_t)(weight == 2)) << j;
        }
        map->zero[i] = i < stripe->rows ? zero & within : 0;
        map->young[i] = i < stripe->rows ? young & within : 0;
        any |= map->zero[i];
    }
    memset(map->ones, 0, sizeof map->ones);
    if (!any) {
        memset(map->near, 0, sizeof map->near);
        memset(map->context, CLASSES, sizeof map->context);
        return;
    }
    sum_all_parents(stripe, parents, parent_stride, row_shift, column_shift, plane, sums);
    see_contexts(weights, sums, map);
}

#endif
