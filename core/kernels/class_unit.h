/* A large unit while it is read or written, and all that this takes (docs/format.md, "Large units"). */
#ifndef LODE_CLASS_UNIT_H
#define LODE_CLASS_UNIT_H

#include <stdbool.h>
#include <stdint.h>

#include "contexts.h"

enum {
    STRIPE_ROWS = BLOCK,
    STRIPE_COLUMNS = 64,
    STRIPE_SIZE = STRIPE_ROWS * STRIPE_COLUMNS,
    MOST_IN_STRIPE = 2 * STRIPE_SIZE + STRIPE_COLUMNS / BLOCK, /* decisions: bits, signs and flags */
    WORD = 2,                                                  /* bytes of a word, which a decision may take */
    REST_BYTES = WORD * MOST_IN_STRIPE,
    KEPT_MAPS = 32, /* of the first stripes; the last one is that of all others */
    MOST_CONTEXTS = 68,
    /* A mark is 1 + the plane in which a coefficient was found, and this if its second pass did. */
    FOUND_SECOND = 128,
};

/* A part of a band. */
struct stripe {
    int64_t top, left; /* its first row and column */
    int64_t first;     /* the place of its first coefficient */
    int rows, columns;
};

/* What is known of a stripe before a plane. A row is a mask, a bit for each column. */
struct class_map {
    uint64_t zero[STRIPE_ROWS];  /* not significant above this plane */
    uint64_t young[STRIPE_ROWS]; /* with the highest bit in the plane above */
    uint64_t near[STRIPE_ROWS];  /* with a significant neighbour */
    uint64_t ones[STRIPE_ROWS];  /* bits of this plane that were read, and not added to what is known yet */
    uint8_t context[STRIPE_ROWS][STRIPE_COLUMNS]; /* of significance, or of a refinement */
};

/* How often contexts have coded each bit, by 2 k + bit. */
typedef uint16_t counts_t[2 * MOST_CONTEXTS];

/* Contexts: the probability of a 1 over 2^16, an adaptation count, and what the coder takes. Neighbouring decisions
 * count in different arrays, so that none waits for the other. */
struct contexts {
    uint16_t probability[MOST_CONTEXTS];
    uint16_t coded[MOST_CONTEXTS]; /* the probability over 2^12, neither 0 nor 1 */
    uint8_t adapted[MOST_CONTEXTS];
    counts_t counts[2]; /* since the last change */
};

/* Where reading stands: both states, of which the first one codes the next decision. */
struct rans {
    uint32_t states[2];
    const uint8_t *at, *end;
};

/* Maps of the first stripes of all bands are made once for a plane: its second pass takes them again, also in the next
 * run. */
struct unit {
    const struct tiles *tiles;
    struct contexts contexts;
    struct rans rans;
    uint16_t *symbols; /* where the next decision that is written will stand */
    int plane;
    uint32_t seen;    /* a bit for each map that holds what is known before the plane, */
    uint32_t pending; /* and for each with ones */
    struct class_map maps[KEPT_MAPS];
    bool near_end;
    uint8_t rest[2 * REST_BYTES]; /* near the end of a segment its last bytes, with zeros behind them */
};

#endif
