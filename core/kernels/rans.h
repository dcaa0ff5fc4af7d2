/* The range coder of large units: rANS with two states that take turns (docs/format.md, "Large units").
 *
 * A state x is at least 2^16. A bit whose probability of being 1 is p / 2^12 takes the part [0, p) of 2^12 for a 1 and
 * the rest for a 0. Reading goes forwards through words of 16 bits; writing keeps all decisions and goes through them
 * backwards. Probabilities change between stripes, never within one.
 */
#ifndef LODE_RANS_H
#define LODE_RANS_H

#include "class_tables.h"
#include "class_unit.h"
#include "copying.h"
#include "inlining.h"

enum {
    PROBABILITY_BITS = 12,
    PROBABILITY_RANGE = 1 << PROBABILITY_BITS,
    STATE_BYTES = 8,
    MOST_COUNT = 127, /* adaptation count */
};

_Static_assert(MOST_COUNT + STRIPE_SIZE < sizeof ADAPTATION / sizeof *ADAPTATION, "a rate for each count");

#define LOWEST_STATE (UINT32_C(1) << 16)

static inline void set_coded(struct contexts *contexts, int number) {
    int coded = contexts->probability[number] >> (16 - PROBABILITY_BITS);
    contexts->coded[number] = (uint16_t)(coded ? coded : 1);
}

/* Move probabilities, from number `first` to the one before `last` by steps, towards the share of 1s among the
 * decisions that were counted, each of which weighs as much as one before. Without a branch: where there were none,
 * nothing changes. */
LODE_INLINE void adapt(struct contexts *contexts, int first, int last, int step) {
    uint16_t *even = contexts->counts[0], *odd = contexts->counts[1];
    for (int k = first; k < last; k += step) {
        int32_t ones = even[2 * k + 1] + odd[2 * k + 1], decisions = even[2 * k] + odd[2 * k] + ones;
        int32_t probability = contexts->probability[k], adapted = contexts->adapted[k] + decisions;
        int32_t away = ones * (1 << 16) - decisions * probability;
        contexts->probability[k] = (uint16_t)(probability + (int32_t)(((int64_t)away * ADAPTATION[adapted]) >> 16));
        contexts->adapted[k] = (uint8_t)(adapted < MOST_COUNT ? adapted : MOST_COUNT);
        set_coded(contexts, k);
        even[2 * k] = even[2 * k + 1] = odd[2 * k] = odd[2 * k + 1] = 0;
    }
}

/* Read a bit; `at` moves by a word where the state takes one, which is seldom. */
LODE_INLINE uint32_t read_bit(uint32_t *state, const uint8_t **at, uint32_t probability) {
    uint32_t x = *state, part = x & (PROBABILITY_RANGE - 1), below = (x >> PROBABILITY_BITS) * probability;
    uint32_t one = below + part, zero = x - probability - below, bit = part < probability;
    x = bit ? one : zero;
    if (__builtin_expect(x < LOWEST_STATE, 0)) {
        x = x << 16 | (*at)[0] | (uint32_t)(*at)[1] << 8;
        *at += WORD;
    }
    *state = x;
    return bit;
}

/* A decision that was taken, until it is written: its probability, and above 15 bits whether it is a 1. */
typedef uint16_t symbol_t;

LODE_INLINE symbol_t symbol_of(uint32_t probability, uint32_t bit) {
    return (symbol_t)(probability | bit << 15);
}

/* The state before a decision from that after it, x. It may give a word to the bytes before `end`; two of these are
 * overwritten in any case. */
LODE_INLINE uint32_t write_symbol(symbol_t symbol, uint32_t x, uint8_t **end) {
    uint32_t probability = symbol & (PROBABILITY_RANGE - 1), zero = (symbol >> 15) - 1u;
    uint32_t width = (probability ^ zero) + (zero & (PROBABILITY_RANGE + 1));
    (*end)[-2] = (uint8_t)x;
    (*end)[-1] = (uint8_t)(x >> 8);
    uint32_t high = 0 - (uint32_t)(x >= width << (32 - PROBABILITY_BITS));
    *end -= high & WORD;
    x >>= high & 16;
    uint32_t quotient = x / width;
    return (quotient << PROBABILITY_BITS) + (x - quotient * width) + (zero & probability);
}

/* Write the decisions from number `first` to the one before `last`, backwards, to the bytes before `end`; where they
 * begin. Those of even numbers take the first state. */
static uint8_t *write_symbols(const symbol_t *symbols, int64_t first, int64_t last, uint32_t states[2], uint8_t *end) {
    int64_t i = last;
    if (i > first && i & 1) {
        i--;
        states[0] = write_symbol(symbols[i], states[0], &end);
    }
    uint32_t even = states[0], odd = states[1];
    for (; i - 2 >= first; i -= 2) {
        odd = write_symbol(symbols[i - 1], odd, &end);
        even = write_symbol(symbols[i - 2], even, &end);
    }
    if (i > first)
        odd = write_symbol(symbols[i - 1], odd, &end);
    states[0] = even;
    states[1] = odd;
    return end;
}

#endif
