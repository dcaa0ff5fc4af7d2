/* What the passes of the embedded coder gain: the error of a tile when so many of its passes remain (docs/format.md,
 * "From coefficients to points", says what a receiver takes for bits that it does not know).
 */

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

static int64_t error_below(int64_t value, int plane) {
    return (value & ((INT64_C(1) << plane) - 1)) - ((INT64_C(7) << plane) >> 4);
}

static void add_coefficient(int64_t value, int early, int most, struct sums *sums) {
    int plane = 63 - __builtin_clzll((uint64_t)value);
    plane = plane < most ? plane : most;
    for (int known = 1; known <= plane; known++) {
        double error = (double)error_below(value, known);
        sums->refined[known] += error * error;
    }
    int first = early == plane + 1;
    if (first) {
        double error = (double)error_below(value, plane);
        sums->found[plane] += error * error;
    }
    sums->unknown[2 * plane + first] += (double)value * (double)value;
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
        for (int64_t i = 0; i < rows; i++) {
            const int32_t *row = truth + offset + i * stride;
            const uint8_t *marks = early + offset + i * stride;
            for (int64_t j = 0; j < columns; j++) {
                int64_t value = row[j] < 0 ? -(int64_t)row[j] : row[j];
                if (value)
                    add_coefficient(value, marks[j], (int)(passes + 1) >> 1, &sums);
            }
        }
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
