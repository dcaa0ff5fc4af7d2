/* Eight small numbers in one word, one a byte, so that all are worked on at once. No operation carries from one byte
 * into the next as long as numbers stay within the bounds that are named.
 */
#ifndef LODE_EIGHT_H
#define LODE_EIGHT_H

#include <stdint.h>

#include "copying.h"

typedef uint64_t eight_t;

/* 1 in each byte. */
#define EACH UINT64_C(0x0101010101010101)

/* One bit for each byte, the first lowest. */
static const uint8_t BITS[8] = {1, 2, 4, 8, 16, 32, 64, 128};

static inline eight_t eight_at(const uint8_t *at) {
    eight_t numbers;
    memcpy(&numbers, at, sizeof numbers);
    return numbers;
}

static inline void put_eight(uint8_t *at, eight_t numbers) {
    memcpy(at, &numbers, sizeof numbers);
}

/* 1 for each number of at most 128 that is at least `least`. */
static inline eight_t reaching(eight_t numbers, int least) {
    return (numbers + (uint64_t)(128 - least) * EACH) >> 7 & EACH;
}

/* Numbers of at most 128, those above `most` as that. */
static inline eight_t at_most(eight_t numbers, int most) {
    eight_t above = reaching(numbers, most);
    return (numbers & ~(255 * above)) + (uint64_t)most * above;
}

/* A bit for each number that is 1 instead of 0, and the way back. */
static inline uint32_t bits_of(eight_t ones) {
    return (uint32_t)((255 * ones & eight_at(BITS)) * EACH >> 56);
}

static inline eight_t ones_of(uint32_t bits) {
    return reaching(bits * EACH & eight_at(BITS), 1);
}

/* The first four numbers, each twice. */
static inline eight_t doubled(eight_t numbers) {
    uint32_t half;
    memcpy(&half, &numbers, sizeof half);
    eight_t spread = half;
    spread = (spread | spread << 16) & UINT64_C(0x0000FFFF0000FFFF);
    spread = (spread | spread << 8) & UINT64_C(0x00FF00FF00FF00FF);
    return spread | spread << 8;
}

/* The first number, eight times. */
static inline eight_t repeated(eight_t numbers) {
    uint8_t first;
    memcpy(&first, &numbers, sizeof first);
    return first * EACH;
}

#endif
