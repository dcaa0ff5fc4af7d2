/* The raw bits of a stripe of a large unit, and how bits become known (docs/format.md, "Large units"). */
#ifndef LODE_CLASS_RAW_H
#define LODE_CLASS_RAW_H

#include "block_coder.h"
#include "class_map.h"

typedef uint32_t units_of_four_t __attribute__((vector_size(16)));

/* Let a stripe that is read find bytes enough: behind the end of a segment are zeros. None of its decisions takes more
 * than a word. */
LODE_INLINE void find_bytes(struct unit *unit) {
    struct rans *rans = &unit->rans;
    int64_t left = rans->end - rans->at;
    if (left < 0)
        rans->at = rans->end;
    if (left >= REST_BYTES || unit->near_end)
        return;
    memcpy(unit->rest, rans->at, (size_t)left);
    memset(unit->rest + left, 0, REST_BYTES);
    rans->at = unit->rest;
    rans->end = unit->rest + left;
    unit->near_end = true;
}

/* The place of a stripe's map by its number in the pass, and its bit where the map is kept. */
LODE_INLINE int map_number(int64_t number) {
    return number < KEPT_MAPS - 1 ? (int)number : KEPT_MAPS - 1;
}

LODE_INLINE uint32_t kept_bit(int64_t number) {
    return number < KEPT_MAPS - 1 ? UINT32_C(1) << number : 0;
}

/* Add a bit of a plane to what is known of a row, where a mask says so. */
LODE_INLINE void add_ones(uint32_t *known, uint64_t mask, int columns, int plane) {
    enum { FEW = 6 };
    uint32_t bit = UINT32_C(1) << plane;
    if (columns < STRIPE_COLUMNS || __builtin_popcountll(mask) <= FEW) {
        for (; mask; mask &= mask - 1)
            known[__builtin_ctzll(mask)] += bit;
        return;
    }
    const units_of_four_t each = {1, 2, 4, 8};
    for (int j = 0; j < STRIPE_COLUMNS; j += 4, mask >>= 4) {
        units_of_four_t own = (units_of_four_t){0} + (uint32_t)mask, now;
        memcpy(&now, known + j, sizeof now);
        now += (units_of_four_t)((own & each) != 0) & bit;
        memcpy(known + j, &now, sizeof now);
    }
}

/* Coefficients of a row whose two highest bits stand above a plane: all further ones are raw. */
LODE_INLINE uint64_t refined_in(const uint8_t *marks, const struct stripe *stripe, int plane) {
    uint8_t room[ROW_ROOM];
    const uint8_t *row = loadable(marks, stripe->columns, stripe->columns == STRIPE_COLUMNS, room);
    uint64_t refined = 0;
    for (int j = 0; j < STRIPE_COLUMNS; j += LANES)
        refined |= negative_lanes((lanes_t)((lanes_at(row + j) & (FOUND_SECOND - 1)) > (int8_t)(plane + 2))) << j;
    return refined;
}

/* Let the ones of a stripe's map be known. */
static void add_pending(struct unit *unit, const struct band *band, const struct stripe *stripe, int64_t number) {
    uint64_t *ones = unit->maps[number].ones;
    for (int i = 0; i < stripe->rows; i++) {
        add_ones(unit->tiles->known + stripe->first + i * band->stride, ones[i], stripe->columns, unit->plane);
        ones[i] = 0;
    }
    unit->pending &= ~kept_bit(number);
}

/* Bits of eight bytes, the lowest one of the first first. */
LODE_INLINE uint64_t window(const uint8_t *bytes) {
    uint64_t bits = 0;
    for (int k = 0; k < 8; k++)
        bits |= (uint64_t)bytes[k] << 8 * k;
    return bits;
}

/* Read the raw bits of a stripe, of whose first byte `bits` are taken; those that are taken of the next byte then. What
 * was pending becomes known with them. */
static int read_raw(struct unit *unit, const struct band *band, const struct stripe *stripe, int64_t number, int plane,
                    int bits) {
    find_bytes(unit);
    const uint8_t *from = unit->rans.at;
    enum { HALF = 32 }; /* columns whose bits a window holds, wherever in a byte they begin */
    bool pending = unit->pending & kept_bit(number);
    uint64_t *ones_of_map = unit->maps[map_number(number)].ones;
    for (int i = 0; i < stripe->rows; i++) {
        int64_t place = stripe->first + i * band->stride;
        uint64_t refined = refined_in(unit->tiles->early + place, stripe, plane);
        uint64_t ones = pending ? ones_of_map[i] : 0;
        for (int j = 0; j < STRIPE_COLUMNS; j += HALF) {
            uint64_t half = refined >> j & UINT32_MAX, coming = window(from + (bits >> 3)) >> (bits & 7);
            bits += __builtin_popcountll(half);
            for (; half; half &= half - 1, coming >>= 1)
                ones |= (coming & 1) << j << __builtin_ctzll(half);
        }
        if (ones)
            add_ones(unit->tiles->known + place, ones, stripe->columns, plane);
        ones_of_map[i] = 0;
    }
    unit->pending &= ~kept_bit(number);
    unit->rans.at += bits >> 3;
    return bits & 7;
}

/* How many raw bits a stripe has. */
static int64_t count_raw(const struct tiles *tiles, const struct band *band, const struct stripe *stripe, int plane) {
    int64_t bits = 0;
    for (int i = 0; i < stripe->rows; i++)
        bits += __builtin_popcountll(refined_in(tiles->early + stripe->first + i * band->stride, stripe, plane));
    return bits;
}

/* Write the raw bits of a stripe behind `bits` others into zeros; those that are there then. */
static int64_t write_raw(const struct tiles *tiles, const struct band *band, const struct stripe *stripe, int plane,
                         uint8_t *data, int64_t bits) {
    for (int i = 0; i < stripe->rows; i++) {
        int64_t place = stripe->first + i * band->stride;
        uint64_t refined = refined_in(tiles->early + place, stripe, plane);
        for (; refined; refined &= refined - 1, bits++)
            data[bits >> 3] |= (uint8_t)((tiles->known[place + __builtin_ctzll(refined)] >> plane & 1) << (bits & 7));
    }
    return bits;
}

#endif
