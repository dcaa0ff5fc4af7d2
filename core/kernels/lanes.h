/* Sixteen small numbers at once, one a byte, as vectors of the machine; and masks, a bit for each. */
#ifndef LODE_LANES_H
#define LODE_LANES_H

#include <stdint.h>

#include "eight.h"
#include "inlining.h"

enum { LANES = 16 };

/* Numbers below 128: machines compare signed bytes. A comparison that holds gives -1. */
typedef int8_t lanes_t __attribute__((vector_size(LANES)));

LODE_INLINE lanes_t lanes_at(const void *at) {
    lanes_t lanes;
    memcpy(&lanes, at, sizeof lanes);
    return lanes;
}

LODE_INLINE void put_lanes(void *at, lanes_t lanes) {
    memcpy(at, &lanes, sizeof lanes);
}

/* A bit for each number that is negative, the first lowest. */
LODE_INLINE uint64_t negative_lanes(lanes_t lanes) {
#if defined __SSE2__
    typedef char chars_t __attribute__((vector_size(LANES)));
    return (uint32_t)__builtin_ia32_pmovmskb128((chars_t)lanes);
#elif defined __wasm_simd128__
    return __builtin_wasm_bitmask_i8x16(lanes);
#else
    eight_t halves[2];
    memcpy(halves, &lanes, sizeof halves);
    return bits_of(halves[0] >> 7 & EACH) | bits_of(halves[1] >> 7 & EACH) << 8;
#endif
}

#endif
