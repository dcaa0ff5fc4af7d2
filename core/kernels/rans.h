/* The range coder of large units: rANS with two states that take turns (docs/format.md, "Large units").
 *
 * A state x is at least 2^16. A bit whose probability of being 1 is p / 2^12 takes the part [0, p) of 2^12 for a 1 and
 * the rest for a 0. Reading goes forwards through words of 16 bits; writing keeps all decisions and goes through them
 * backwards. Probabilities change between runs of decisions, never within one.
 */
#ifndef LODE_RANS_H
#define LODE_RANS_H

#include <stdbool.h>
#include <stdint.h>

#include "copying.h"
#include "inlining.h"

enum {
    PROBABILITY_BITS = 12,
    PROBABILITY_RANGE = 1 << PROBABILITY_BITS,
    WORD = 2,          /* bytes of a word, */
    STATE_BYTES = 8,   /* and of two states */
    MOST_IN_RUN = 512, /* decisions that are coded in turn */
    MOST_COUNT = 127,  /* adaptation count */
    MOST_CONTEXTS = 128,
};

#define LOWEST_STATE (UINT32_C(1) << 16)

/* Where reading stands. */
struct rans {
    uint32_t next, other; /* the state that codes the next decision, and the other one */
    const uint8_t *at, *end;
};

/* A context: the probability of a 1 over 2^16, an adaptation count, and what the coder takes. */
struct contexts {
    uint16_t probability[MOST_CONTEXTS];
    uint8_t adapted[MOST_CONTEXTS];
    uint16_t coded[MOST_CONTEXTS];   /* the probability over 2^12, neither 0 nor 1 */
    uint32_t counted[MOST_CONTEXTS]; /* decisions since the last change, and above 16 bits the 1s among them */
};

static inline void set_coded(struct contexts *contexts, int number) {
    int coded = contexts->probability[number] >> (16 - PROBABILITY_BITS);
    contexts->coded[number] = (uint16_t)(coded ? coded : 1);
}

/* Count a decision. */
static inline void count(struct contexts *contexts, int number, int bit) {
    contexts->counted[number] += 1 + ((uint32_t)bit << 16);
}

/* Move a probability towards the share of 1s among the counted decisions, each of which weighs as much as one before.
 */
static inline void adapt(struct contexts *contexts, int number) {
    uint32_t counted = contexts->counted[number];
    contexts->counted[number] = 0;
    int32_t decisions = (int32_t)(counted & 0xFFFF), ones = (int32_t)(counted >> 16),
            adapted = contexts->adapted[number];
    int32_t probability = contexts->probability[number], rate = (1 << 17) / (2 * (adapted + decisions) + 1);
    int64_t change = ((int64_t)((ones << 16) - decisions * probability) * rate) >> 16;
    contexts->probability[number] = (uint16_t)(probability + change);
    adapted += decisions;
    contexts->adapted[number] = (uint8_t)(adapted < MOST_COUNT ? adapted : MOST_COUNT);
    set_coded(contexts, number);
}

/* Read a bit; `at` moves by a word where the state takes one. */
LODE_INLINE int read_bit(uint32_t *state, const uint8_t **at, uint32_t probability) {
    uint32_t x = *state, part = x & (PROBABILITY_RANGE - 1), below = (x >> PROBABILITY_BITS) * probability;
    uint32_t one = below + part, zero = x - below - probability;
    int bit = part < probability;
    x = bit ? one : zero;
    uint32_t more = x << 16 | (*at)[0] | (uint32_t)(*at)[1] << 8;
    bool low = x < LOWEST_STATE;
    *state = low ? more : x;
    *at += low ? WORD : 0;
    return bit;
}

/* Decisions that are read in turn. None takes more than a word, so a run near the end reads from a copy with zeros
 * behind it. */
struct run {
    struct rans *rans;
    const uint8_t *at;
    int64_t left;
    bool copied;
    uint32_t even, odd;
    uint8_t rest[MOST_IN_RUN * WORD + WORD];
};

/* Begin a run of so many decisions, at most MOST_IN_RUN. */
LODE_INLINE void begin_run(struct run *run, int many) {
    struct rans *rans = run->rans;
    run->even = rans->next;
    run->odd = rans->other;
    run->at = rans->at;
    run->left = rans->end - rans->at;
    run->copied = run->left < WORD * (many + 1);
    if (run->copied) {
        memset(run->rest, 0, sizeof run->rest);
        memcpy(run->rest, rans->at, (size_t)run->left);
        run->at = run->rest;
    }
}

LODE_INLINE int next_bit(struct run *run, uint32_t probability) {
    uint32_t state = run->even;
    int bit = read_bit(&state, &run->at, probability);
    run->even = run->odd;
    run->odd = state;
    return bit;
}

LODE_INLINE void end_run(struct run *run) {
    struct rans *rans = run->rans;
    rans->next = run->even;
    rans->other = run->odd;
    int64_t taken = run->at - (run->copied ? run->rest : rans->at);
    rans->at += taken < run->left ? taken : run->left;
}

/* Read the bits of a run: of each decision the context and the bit stand at its place. */
static void read_run(struct rans *rans, struct contexts *contexts, const uint16_t *places, int many,
                     const uint8_t *context, uint8_t *bits) {
    struct run run;
    run.rans = rans;
    begin_run(&run, many);
    for (int i = 0; i < many; i++) {
        int place = places[i], number = context[place], bit = next_bit(&run, contexts->coded[number]);
        bits[place] = (uint8_t)bit;
        count(contexts, number, bit);
    }
    end_run(&run);
}

/* A decision that was taken, until it is written: its probability, and above 15 bits whether it is a 1. */
typedef uint16_t symbol_t;

static inline symbol_t symbol_of(const struct contexts *contexts, int number, int bit) {
    return (symbol_t)(contexts->coded[number] | bit << 15);
}

/* Keep the decisions of a run; where the next one will stand. */
static inline symbol_t *keep_run(symbol_t *to, struct contexts *contexts, const uint16_t *places, int many,
                                 const uint8_t *context, const uint8_t *bits) {
    for (int i = 0; i < many; i++) {
        int place = places[i], number = context[place], bit = bits[place];
        to[i] = symbol_of(contexts, number, bit);
        count(contexts, number, bit);
    }
    return to + many;
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
