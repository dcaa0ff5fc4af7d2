/* The trellis of dependent quantisation: which of two quantisers a coefficient is taken from (docs/format.md,
 * "Passes"). Every row of blocks of a band begins in state 0.
 */
#ifndef LODE_TRELLIS_H
#define LODE_TRELLIS_H

#include <stdint.h>

enum { TRELLIS_STATES = 8 };

/* The state after an even and after an odd index, by the state before. */
static const uint8_t TRANSITIONS[TRELLIS_STATES][2] = {
    {0, 2}, {5, 7}, {1, 3}, {6, 4}, {2, 0}, {4, 6}, {3, 1}, {7, 5},
};
/* Whether a coefficient is one of the odd multiples of half a step, by the state before it. */
static const uint8_t ODD[TRELLIS_STATES] = {0, 1, 0, 1, 0, 1, 0, 1};

#endif
