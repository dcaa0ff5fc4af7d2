/* Logarithms for encoders, which estimate with them what something costs: the same bits on every machine. */
#ifndef LODE_LOGARITHM_H
#define LODE_LOGARITHM_H

#include <stdint.h>

#include "copying.h"
#include "tables.h"

/* log2 of a normal number greater than 0, good to 1e-8: between the entries of a table in a parabola. */
static inline double log2_of(double x) {
    uint64_t bits;
    memcpy(&bits, &x, sizeof bits);
    int64_t exponent = (int64_t)(bits >> 52 & 2047) - 1023;
    uint64_t i = bits >> 44 & 255;
    double part = (double)(int64_t)(bits & ((UINT64_C(1) << 44) - 1)) * 0x1p-44;
    double low = (double)LOGARITHMS[i], rise = (double)(LOGARITHMS[i + 1] - LOGARITHMS[i]);
    double bend = 0.7213475204444817 / (double)((256 + i) * (256 + i)); /* half of 1 / ln 2, over the square */
    return (double)exponent + (low + rise * part) * 0x1p-32 + bend * part * (1.0 - part);
}

#endif
