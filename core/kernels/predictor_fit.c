/* What the encoder asks of a sample of lines when it chooses the third step's (a, b) for a level and axis
 * (docs/mathematics.md, section 8): moments for a weighted least-squares fit, and about how many bits the details take.
 *
 * With u_k = -c_{k+2} + c_{k+1} + c_k - c_{k-1} and w_k = -c_{k+3} + c_{k+1} + c_k - c_{k-2}, the third step turns a
 * detail d_k into e_k = d_k - floor((a u_k + b w_k + 128) / 256).
 */
#include <stdbool.h>

#include "lodestream.h"
#include "logarithm.h"

#define LODE_INLINE static inline __attribute__((always_inline))

enum {
    LANES = 32, /* sums or products side by side, so that a processor can take several values at once */
    FACTORS = 16,
    MOMENTS = 5,
    AROUND = 5, /* nodes that u and w look at, but one */
};

LODE_INLINE int32_t plus(int32_t a, int32_t b) {
    return (int32_t)((uint32_t)a + (uint32_t)b);
}

LODE_INLINE int32_t minus(int32_t a, int32_t b) {
    return (int32_t)((uint32_t)a - (uint32_t)b);
}

LODE_INLINE int32_t times(int32_t a, int32_t b) {
    return (int32_t)((uint32_t)a * (uint32_t)b);
}

LODE_INLINE int64_t least(int64_t a, int64_t b) {
    return a < b ? a : b;
}

int64_t lode_predictor_factors(const int32_t *nodes, int64_t rows, int64_t columns, int64_t pitch,
                               const int32_t *details, int64_t details_rows, int64_t details_columns,
                               int64_t details_pitch, int32_t *first, int64_t first_count, int32_t *second,
                               int64_t second_count, int32_t *kept, int64_t kept_count) {
    if (columns < 0 || pitch < columns || details_pitch < columns || rows != details_rows + AROUND ||
        details_columns != columns || details_rows < 0 || first_count != details_rows * columns ||
        second_count != first_count || kept_count != first_count)
        return LODE_REFUSED;
    int32_t bits = 0;
    for (int64_t k = 0; k < details_rows; k++) {
        const int32_t *n = nodes + k * pitch, *d = details + k * details_pitch;
        int32_t *restrict u = first + k * columns, *restrict w = second + k * columns;
        int32_t *restrict e = kept + k * columns;
        for (int64_t j = 0; j < columns; j++) {
            int32_t near = plus(n[2 * pitch + j], n[3 * pitch + j]);
            u[j] = minus(near, plus(n[pitch + j], n[4 * pitch + j]));
            w[j] = minus(near, plus(n[j], n[5 * pitch + j]));
            e[j] = d[j];
            bits |= (u[j] ^ u[j] >> 31) | (w[j] ^ w[j] >> 31);
        }
    }
    return (int64_t)bits + 1;
}

LODE_INLINE void add_moments(const int32_t *restrict first, const int32_t *restrict second,
                             const int32_t *restrict details, int64_t count, double a, double b, double weighted,
                             double sums[MOMENTS][LANES]) {
    for (int64_t j = 0; j < count; j++) {
        double u = first[j], w = second[j], d = details[j];
        double weight = 1.0 / (1.0 + weighted * __builtin_fabs(d - (a * u + b * w) * 0x1p-8));
        double weighted_u = weight * u, weighted_w = weight * w;
        sums[0][j] += weighted_u * u;
        sums[1][j] += weighted_u * w;
        sums[2][j] += weighted_w * w;
        sums[3][j] += weighted_u * d;
        sums[4][j] += weighted_w * d;
    }
}

int64_t lode_predictor_moments(const int32_t *first, int64_t first_count, const int32_t *second, int64_t second_count,
                               const int32_t *details, int64_t details_count, double a, double b, int64_t weighted,
                               double *moments, int64_t moments_count) {
    if (first_count != details_count || second_count != details_count || moments_count != MOMENTS)
        return LODE_REFUSED;
    double sums[MOMENTS][LANES] = {{0}}, weight = weighted ? 1.0 : 0.0;
    int64_t i = 0;
    for (; i + LANES <= details_count; i += LANES)
        add_moments(first + i, second + i, details + i, LANES, a, b, weight, sums);
    add_moments(first + i, second + i, details + i, details_count - i, a, b, weight, sums);
    for (i = 0; i < MOMENTS; i++)
        for (int64_t j = 0; j < LANES; j++)
            moments[i] += sums[i][j];
    return 0;
}

/* Multiply each product by 1 + |e|; `wide` where a u + b w + 128 need not fit int32. */
LODE_INLINE void multiply(const int32_t *restrict first, const int32_t *restrict second,
                          const int32_t *restrict details, int64_t count, int32_t a, int32_t b, bool wide,
                          double *restrict products) {
    for (int64_t j = 0; j < count; j++) {
        int64_t v = (int64_t)a * first[j] + (int64_t)b * second[j] + 128;
        int32_t low = plus(plus(times(a, first[j]), times(b, second[j])), 128);
        int32_t e = minus(details[j], wide ? (int32_t)(uint32_t)((uint64_t)v >> 8) : low >> 8);
        products[j] *= 1.0 + __builtin_fabs((double)e);
    }
}

LODE_INLINE double bits_of(const int32_t *first, const int32_t *second, const int32_t *details, int64_t count,
                           int32_t a, int32_t b, bool wide) {
    double bits = 0.0;
    for (int64_t start = 0; start < count; start += FACTORS * LANES) {
        /* Sixteen factors of at most 2^31 + 1 are far from overflow: one logarithm does for all of them. */
        double products[LANES];
        for (int64_t j = 0; j < LANES; j++)
            products[j] = 1.0;
        int64_t i = start, end = least(start + FACTORS * LANES, count);
        for (; i + LANES <= end; i += LANES)
            multiply(first + i, second + i, details + i, LANES, a, b, wide, products);
        multiply(first + i, second + i, details + i, end - i, a, b, wide, products);
        for (int64_t j = 0; j < LANES; j++)
            bits += log2_of(products[j]);
    }
    return bits;
}

int64_t lode_predictor_bits(const int32_t *first, int64_t first_count, const int32_t *second, int64_t second_count,
                            const int32_t *details, int64_t details_count, int64_t largest, int64_t a, int64_t b,
                            double *bits, int64_t bits_count) {
    if (first_count != details_count || second_count != details_count || bits_count != 1 || a < -127 || a > 127 ||
        b < -127 || b > 127 || largest < 0 || largest > INT32_MAX + INT64_C(1))
        return LODE_REFUSED;
    bool wide = ((a < 0 ? -a : a) + (b < 0 ? -b : b)) * largest > INT32_MAX - 128;
    *bits += wide ? bits_of(first, second, details, details_count, (int32_t)a, (int32_t)b, true)
                  : bits_of(first, second, details, details_count, (int32_t)a, (int32_t)b, false);
    return 0;
}
