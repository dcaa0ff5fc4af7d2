/* The adaptive binary range coder, for the kernels that code decisions in contexts (docs/format.md, "The binary
 * coder").
 *
 * A context is an int32: its probability of a 1 over 2^20, and in the lowest 8 bits its adaptation count, 1 to 127.
 * After each bit the probability moves towards 0 or 2^20 - 1 by the part RATES of the distance, and the count grows by
 * 1.
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

#include "inlining.h"
#include "lodestream.h"
#include "tables.h"

#define SELDOM(condition) __builtin_expect(condition, 0)

enum { MOST_ADAPTED = 127 };

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

/* Whether a coder that a caller has kept since the last call is such as a call leaves behind: from any other it might
 * run forever, or back out of its bytes. Contexts may hold anything. */
static inline bool coder_can_go_on(bool reads, const struct coder *coder) {
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

/* The part of the interval for a bit, which is read where reading; a 1 has the lower part, `bound`. Without a branch:
 * of most bits nobody can guess what they are. */
LODE_INLINE int coder_narrow(bool reads, struct coder *coder, int bit, uint32_t bound) {
    if (reads)
        bit = coder->low < bound;
    uint32_t above = bound & ((uint32_t)bit - 1);
    coder->low = reads ? coder->low - above : coder->low + above;
    coder->width = bit ? bound : coder->width - bound;
    return bit;
}

LODE_INLINE int32_t clamped(int32_t value, int32_t low, int32_t high) {
    return value < low ? low : value > high ? high : value;
}

/* The same of what is almost always within its limits: a branch that is guessed takes no time. */
LODE_INLINE int32_t seldom_clamped(int32_t value, int32_t low, int32_t high) {
    return SELDOM((uint32_t)value - (uint32_t)low > (uint32_t)high - (uint32_t)low) ? clamped(value, low, high) : value;
}

/* A context after a bit. */
LODE_INLINE int32_t context_after(int32_t context, int bit) {
    uint32_t now = (uint32_t)context;
    int64_t way = ((int64_t)((0 - (uint32_t)bit) & 0xFFFFF) - (int64_t)(now >> 8)) * RATES[now & MOST_ADAPTED];
    return (int32_t)(now + ((uint32_t)(way >> 8) & ~UINT32_C(255)) + ((now & 255) < MOST_ADAPTED));
}

/* The part of the interval that a 1 has in a context: the highest 16 bits of the probability, within 32 ... 2^16 - 32.
 */
LODE_INLINE uint32_t bound_of(const struct coder *coder, int32_t context) {
    return (coder->width >> 16) * (uint32_t)seldom_clamped((int32_t)((uint32_t)context >> 12 & 0xFFFF), 32, 65504);
}

/* Code one bit in one context, which adapts. */
LODE_INLINE int code_bit(bool reads, struct coder *coder, int bit, int32_t *context) {
    int32_t before = *context;
    bit = coder_narrow(reads, coder, bit, bound_of(coder, before));
    *context = context_after(before, bit);
    if (coder->width < NARROWEST)
        coder_shift(reads, coder);
    return bit;
}

/* Code a bit that is as likely 0 as 1, without a context. */
LODE_INLINE int code_raw_bit(bool reads, struct coder *coder, int bit) {
    bit = coder_narrow(reads, coder, bit, (coder->width >> 16) << 15);
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
    /* One byte is always enough, since the interval is wider than the numbers that begin with it. */
    for (int count = 0; count < 2; count++) {
        uint64_t mask = WIDEST >> (8 * count);
        uint64_t value = (coder->low + mask) & ~mask;
        if (value >= coder->low + coder->width)
            continue;
        if (value > WIDEST) {
            value &= WIDEST;
            coder_carry(coder);
        }
        if (count && coder->place++ < coder->size)
            coder->data[coder->place - 1] = (uint8_t)(value >> 24);
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
