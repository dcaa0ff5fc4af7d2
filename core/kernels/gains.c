/* What the passes of the embedded coder gain: the error of a tile when so many of its passes remain (docs/format.md,
 * "From coefficients to points", says what a receiver takes for bits that it does not know).
 */

#include <stdbool.h>

#include "band_fields.h"
#include "copying.h"
#include "lodestream.h"

enum { PLANES = 32 };

/* Sums of squares over a band. */
struct sums {
    double refined[PLANES + 1]; /* of errors, by the plane below which bits are unknown */
    double found[PLANES + 1];   /* of errors just after the first pass of a plane found a coefficient, by that plane */
    double unknown[2 * PLANES + 2]; /* of magnitudes, by the pass in which they are found */
};

static inline int64_t magnitude(int32_t value) {
    return value < 0 ? -(int64_t)value : value;
}

static int64_t error_below(int64_t value, int plane) {
    return (value & ((INT64_C(1) << plane) - 1)) - ((INT64_C(7) << plane) >> 4);
}

/* The plane of the highest bit of a magnitude that is not 0, at most `most`. */
static inline int plane_of(int64_t value, int most) {
    int plane = 63 - __builtin_clzll((uint64_t)value);
    return plane < most ? plane : most;
}

/* Add so many coefficients of one magnitude, all found in a plane's first pass or all in its second. */
static void add_coefficients(int64_t value, int first, double times, int most, struct sums *sums) {
    int plane = plane_of(value, most);
    for (int known = 1; known <= plane; known++) {
        double error = (double)error_below(value, known);
        sums->refined[known] += times * (error * error);
    }
    if (first) {
        double error = (double)error_below(value, plane);
        sums->found[plane] += times * (error * error);
    }
    sums->unknown[2 * plane + first] += times * ((double)value * (double)value);
}

/* Add all coefficients of a band. Small ones are counted first, where no sum can leave the whole numbers of double:
 * then the order does not matter. */
static void add_band(const int32_t *truth, const uint8_t *early, int64_t rows, int64_t columns, int64_t stride,
                     int most, struct sums *sums) {
    enum { SMALL = 1024 };
    uint32_t counts[SMALL][2];
    uint64_t seen = 0;
    for (int64_t i = 0; i < rows; i++)
        for (int64_t j = 0; j < columns; j++)
            seen |= (uint64_t)magnitude(truth[i * stride + j]);
    uint64_t most_exact = (UINT64_C(1) << 53) / (uint64_t)(rows * columns + 1);
    bool exact = rows * columns <= UINT32_MAX && seen < UINT64_C(1) << 26 && seen * seen < most_exact;
    int64_t small = !exact ? 0 : seen < SMALL ? (int64_t)seen + 1 : SMALL;
    memset(counts, 0, (size_t)small * sizeof *counts);
    for (int64_t i = 0; i < rows; i++)
        for (int64_t j = 0; j < columns; j++) {
            int64_t value = magnitude(truth[i * stride + j]);
            int first = early[i * stride + j] == plane_of(value | !value, most) + 1;
            if (value < small)
                counts[value][first]++;
            else if (value)
                add_coefficients(value, first, 1.0, most, sums);
        }
    for (int64_t value = 1; value < small; value++)
        for (int first = 0; first < 2; first++)
            if (counts[value][first])
                add_coefficients(value, first, counts[value][first], most, sums);
}

int64_t lode_pass_gains(const int64_t *bands, int64_t bands_count, const double *weights, int64_t weights_count,
                        const int32_t *truth, int64_t truth_count, const uint8_t *early, int64_t early_count,
                        double *errors, int64_t errors_count) {
    int64_t passes = errors_count - 1;
    if (bands_count != BAND_FIELDS * weights_count || early_count != truth_count || passes < 0 || passes > 2 * PLANES)
        return LODE_REFUSED;
    memset(errors, 0, (size_t)errors_count * sizeof *errors);
    for (int64_t number = 0; number < weights_count; number++) {
        const int64_t *band = bands + number * BAND_FIELDS;
        int64_t offset = band[BAND_OFFSET], stride = band[BAND_STRIDE];
        int64_t rows = band[BAND_ROWS], columns = band[BAND_COLUMNS];
        if (offset < 0 || stride < 1 || stride < columns || rows < 0 || columns < 0 || stride > INT32_MAX ||
            rows > INT32_MAX || columns > truth_count || offset > truth_count ||
            (rows > 0 && offset + (rows - 1) * stride + columns > truth_count))
            return LODE_REFUSED;
        struct sums sums;
        memset(&sums, 0, sizeof sums);
        add_band(truth + offset, early + offset, rows, columns, stride, (int)(passes + 1) >> 1, &sums);
        double unknown = 0.0;
        for (int64_t remaining = 1; remaining <= passes; remaining++) {
            unknown += sums.unknown[remaining - 1];
            int64_t known = (remaining + 1) >> 1;
            double error = unknown + sums.refined[known];
            if (remaining & 1)
                error += sums.found[remaining >> 1];
            errors[remaining] += weights[number] * error;
        }
    }
    return 0;
}
