/* Classes of coefficients by the size of what is around them, by which the cost of an index is known
 * (docs/mathematics.md, "Quantised for one error").
 */
#include "bands.h"
#include "copying.h"
#include "lodestream.h"

enum { FIRST_CLASS = 8 /* of coefficients of about a step */ };

/* Whether what is around a band and its parents lie within `size` elements, too. */
static bool has_surroundings(const int64_t *band, int64_t size) {
    int64_t down = band[BAND_ROW_SHIFT], right = band[BAND_COLUMN_SHIFT];
    if (band[BAND_STRIDE] < 0 || band[BAND_STRIDE] >= band[BAND_OFFSET] || down < 0 || down > 31 || right < 0 ||
        right > 31)
        return false;
    return holds(size, band[BAND_OFFSET] - band[BAND_STRIDE] - 1, band[BAND_STRIDE], band[BAND_ROWS] + 2,
                 band[BAND_COLUMNS] + 2) &&
           holds(size, band[BAND_PARENT], band[BAND_PARENT_STRIDE], ((band[BAND_ROWS] - 1) >> down) + 1,
                 ((band[BAND_COLUMNS] - 1) >> right) + 1);
}

static void divide(const int64_t *band, int64_t step, const int32_t *coefficients, double *relative) {
    double scale = 1.0 / (double)step;
    for (int64_t i = 0; i < band[BAND_ROWS]; i++) {
        int64_t start = band[BAND_OFFSET] + i * band[BAND_STRIDE];
        for (int64_t j = 0; j < band[BAND_COLUMNS]; j++)
            relative[start + j] = coefficients[start + j] * scale;
    }
}

/* Half octaves: 2 log2(size) + FIRST_CLASS rounded down, from the exponent, and whether the rest is sqrt(2) or more. */
static int8_t class_of(double size) {
    const uint64_t root = 0x6A09E667F3BCD; /* the fraction of sqrt(2) */
    size += 1e-3;
    uint64_t bits;
    memcpy(&bits, &size, sizeof bits);
    int64_t exponent = (int64_t)(bits >> 52 & 2047) - 1023;
    int64_t found = 2 * exponent + ((bits & ((UINT64_C(1) << 52) - 1)) >= root) + FIRST_CLASS;
    return (int8_t)(found < 0 ? 0 : least(found, LODE_CLASSES - 1));
}

/* Classes of a band's coefficients, by their eight neighbours and their parent. */
static void classify(const int64_t *band, const double *relative, int8_t *classes) {
    int64_t stride = band[BAND_STRIDE];
    for (int64_t i = 0; i < band[BAND_ROWS]; i++) {
        int64_t start = band[BAND_OFFSET] + i * stride;
        const double *parents = relative + band[BAND_PARENT] + (i >> band[BAND_ROW_SHIFT]) * band[BAND_PARENT_STRIDE];
        for (int64_t j = 0; j < band[BAND_COLUMNS]; j++) {
            const double *at = relative + start + j;
            double near = magnitude(at[-1]) + magnitude(at[1]) + magnitude(at[-stride]) + magnitude(at[stride]);
            double corners = magnitude(at[-stride - 1]) + magnitude(at[-stride + 1]) + magnitude(at[stride - 1]) +
                             magnitude(at[stride + 1]);
            double above = magnitude(parents[j >> band[BAND_COLUMN_SHIFT]]);
            classes[start + j] = class_of((2.0 * near + corners + 2.0 * above) / 14.0);
        }
    }
}

int64_t lode_classify(const int64_t *bands, int64_t bands_count, const int64_t *steps, int64_t steps_count,
                      const int32_t *coefficients, int64_t coefficients_count, double *relative, int64_t relative_count,
                      int8_t *classes, int64_t classes_count) {
    if (relative_count != coefficients_count || classes_count != coefficients_count || bands_count % BAND_FIELDS ||
        steps_count != bands_count / BAND_FIELDS)
        return LODE_REFUSED;
    for (int64_t number = 0; number < steps_count; number++) {
        const int64_t *band = bands + number * BAND_FIELDS;
        if (steps[number] < 1 || !is_band(band, coefficients_count) || !has_surroundings(band, coefficients_count))
            return LODE_REFUSED;
        divide(band, steps[number], coefficients, relative);
        classify(band, relative, classes);
    }
    return 0;
}
