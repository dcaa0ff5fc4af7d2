/* The adaptive binary range coder, for the kernels that code decisions in contexts (docs/format.md, "The binary
 * coder").
 *
 * A context is an int32: its probability of a 1 over 2^20, and in the lowest 8 bits its adaptation count, 1 to 127.
 * After each bit the probability moves towards 0 or 2^20 - 1 by the part RATES of the distance, and the count grows by
 * 1. Two contexts are mixed in the logistic domain: the probability is SQUASH of the sum of both STRETCH, each times
 * its weight; each weight then grows by its STRETCH times the prediction error.
 *
 * Everything is an integer, and right shifts of negative ones round down, as every compiler here does.
 *
 * Not part of the interface: each kernel that includes this is compiled for reading and for writing, with `reads` a
 * constant.
 */
#ifndef LODE_BINARY_CODER_H
#define LODE_BINARY_CODER_H

#include <stdbool.h>
#include <stdint.h>

#include "lodestream.h"
#include "tables.h"

#define LODE_INLINE static inline __attribute__((always_inline))

enum {
    /* A context at the start: a probability of one half, and an adaptation count of 1. */
    UNKNOWN_CONTEXT = (1 << 27) | 1,
    /* Either weight of a mixture at the start, over 2^16. */
    FIRST_WEIGHT = 1 << 15,
    HEAVIEST = 1 << 18,
    MOST_ADAPTED = 127,
};

#define WIDEST UINT32_C(0xFFFFFFFF)
#define NARROWEST (UINT32_C(1) << 24)

/* An interval, and the bytes that it is read from or written to. Reading, `low` is the distance of the data from the
 * interval's lower end, always less than `width`; writing, it is the lower end, and a carry runs back into bytes
 * already written. `place` is the next byte; it may pass `size`: bytes past the end read as zeros, and are not written.
 */
struct coder {
    uint64_t low;
    uint32_t width;
    int64_t place;
    uint8_t *data;
    int64_t size;
};

LODE_INLINE struct coder coder_start(bool reads, uint8_t *data, int64_t size) {
    struct coder coder = {0, WIDEST, 0, data, size};
    if (reads) {
        for (; coder.place < 4; coder.place++)
            coder.low = (coder.low << 8) | (coder.place < size ? data[coder.place] : 0);
        if (coder.low == WIDEST)
            coder.low--; /* no writer begins so; it counts as the largest number in the interval */
    }
    return coder;
}

/* Whether a coder and its weights that a caller has kept since the last call are such as a call leaves behind: from any
 * others it might run forever, or back out of its bytes. Contexts may hold anything. */
static inline bool coder_can_go_on(bool reads, const struct coder *coder, const int32_t *weights, int64_t count) {
    for (int64_t i = 0; i < count; i++)
        if (weights[i] < -HEAVIEST || weights[i] > HEAVIEST)
            return false;
    return coder->width >= NARROWEST && coder->low <= (reads ? coder->width - 1 : 2 * (uint64_t)WIDEST) &&
           coder->place >= 0 && coder->place <= INT64_MAX / 2;
}

/* Add 1 to the number that ends before `place`; what is past `size` was not written. */
static inline void coder_carry(struct coder *coder) {
    int64_t back = coder->place < coder->size ? coder->place : coder->size;
    while (back > 0 && ++coder->data[back - 1] == 0)
        back--;
}

/* Move bytes until the interval is wide enough again. */
LODE_INLINE void coder_shift(bool reads, struct coder *coder) {
    if (!reads && coder->low > WIDEST) {
        coder->low &= WIDEST;
        coder_carry(coder);
    }
    do {
        if (reads) {
            coder->low = (coder->low << 8) | (coder->place < coder->size ? coder->data[coder->place] : 0);
        } else {
            if (coder->place < coder->size)
                coder->data[coder->place] = (uint8_t)(coder->low >> 24);
            coder->low = (coder->low << 8) & WIDEST;
        }
        coder->place++;
        coder->width <<= 8;
    } while (coder->width < NARROWEST);
}

/* The part of the interval for a bit, which is read where reading; a 1 has the lower part: `chance` over 2^16. */
LODE_INLINE int coder_narrow(bool reads, struct coder *coder, int bit, uint32_t chance) {
    uint32_t bound = (coder->width >> 16) * chance;
    if (reads)
        bit = coder->low < bound;
    if (bit) {
        coder->width = bound;
    } else {
        coder->width -= bound;
        coder->low = reads ? coder->low - bound : coder->low + bound;
    }
    return bit;
}

LODE_INLINE int32_t clamped(int32_t value, int32_t low, int32_t high) {
    return value < low ? low : value > high ? high : value;
}

/* A context after a bit. */
LODE_INLINE int32_t context_after(int32_t context, int bit) {
    int32_t chance = context >> 8, count = context & 255;
    int64_t way = (int64_t)((bit ? (1 << 20) - 1 : 0) - chance) * RATES[count & MOST_ADAPTED];
    chance += (int32_t)(way >> 16);
    return (int32_t)((uint32_t)chance << 8) | (count < MOST_ADAPTED ? count + 1 : MOST_ADAPTED);
}

/* Code one bit in one context, which adapts. Coded with the highest 16 bits of the probability, within 32 ... 2^16
 * - 32. */
LODE_INLINE int code_bit(bool reads, struct coder *coder, int bit, int32_t *context) {
    bit = coder_narrow(reads, coder, bit, (uint32_t)clamped(*context >> 12, 32, 65504));
    *context = context_after(*context, bit);
    if (coder->width < NARROWEST)
        coder_shift(reads, coder);
    return bit;
}

LODE_INLINE int32_t weight_after(int32_t weight, int32_t stretch, int32_t error) {
    return clamped(weight + ((stretch * error + 16384) >> 15), -HEAVIEST, HEAVIEST);
}

/* Code one bit in two contexts, mixed with two weights; all four adapt. */
LODE_INLINE int code_mixed_bit(bool reads, struct coder *coder, int bit, int32_t *first, int32_t *second,
                               int32_t *weights) {
    int32_t x = STRETCH[(*first >> 16) & 4095], y = STRETCH[(*second >> 16) & 4095];
    int32_t sum = (weights[0] * x + weights[1] * y) >> 16; /* weights of at most 2^18, inputs of less than 2^11 */
    int32_t chance = SQUASH[(clamped(sum, -2047, 2047) + 2048) & 4095];
    bit = coder_narrow(reads, coder, bit, (uint32_t)chance);
    int32_t error = (bit ? 65536 : 0) - chance;
    weights[0] = weight_after(weights[0], x, error);
    weights[1] = weight_after(weights[1], y, error);
    *first = context_after(*first, bit);
    *second = context_after(*second, bit);
    if (coder->width < NARROWEST)
        coder_shift(reads, coder);
    return bit;
}

/* Write the fewest bytes that name a number in the interval, without zeros at the end; the length, at least 1, or
 * LODE_REFUSED where `size` was too small. */
static inline int64_t coder_finish(struct coder *coder) {
    if (coder->low > WIDEST) {
        coder->low &= WIDEST;
        coder_carry(coder);
    }
    for (int count = 0; count < 5; count++) {
        uint64_t mask = WIDEST >> (8 * (count < 4 ? count : 3));
        if (count == 4)
            mask = 0;
        uint64_t value = (coder->low + mask) & ~mask;
        if (value >= coder->low + coder->width)
            continue;
        if (value > WIDEST) {
            value &= WIDEST;
            coder_carry(coder);
        }
        for (int i = 0; i < count; i++, coder->place++)
            if (coder->place < coder->size)
                coder->data[coder->place] = (uint8_t)(value >> (24 - 8 * i));
        break;
    }
    if (coder->place > coder->size || coder->size < 1)
        return LODE_REFUSED;
    while (coder->place > 1 && coder->data[coder->place - 1] == 0)
        coder->place--;
    if (coder->place == 0) {
        coder->data[0] = 0;
        coder->place = 1;
    }
    return coder->place;
}

#endif
