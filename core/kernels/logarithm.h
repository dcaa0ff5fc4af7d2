/* Logarithms for encoders, which estimate with them what something costs: the same bits on every machine. */
#ifndef LODE_LOGARITHM_H
#define LODE_LOGARITHM_H

#include <stdint.h>
#include <string.h>

#include "tables.h"

/* log2 of a normal number greater than 0, good to 3e-6: between the entries of
 * a table in a straight line. */
static inline double log2_of(double x) {
    uint64_t bits;
    memcpy(&bits, &x, sizeof bits);
    int64_t exponent = (int64_t)(bits >> 52 & 2047) - 1023;
    uint64_t i = bits >> 44 & 255;
    double part = (double)(int64_t)(bits & ((UINT64_C(1) << 44) - 1)) * 0x1p-44;
    double low = (double)LOGARITHMS[i], rise = (double)(LOGARITHMS[i + 1] - LOGARITHMS[i]);
    return (double)exponent + (low + rise * part) * 0x1p-32;
}

#endif
