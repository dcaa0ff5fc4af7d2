/* Bands in the flat arrays that the table of bands describes: whether they lie within them. */
#ifndef LODE_BANDS_H
#define LODE_BANDS_H

#include <stdbool.h>
#include <stdint.h>

#include "band_fields.h"

static inline int64_t least(int64_t a, int64_t b) {
    return a < b ? a : b;
}

static inline double magnitude(double value) {
    return __builtin_fabs(value);
}

/* Whether rows x columns elements from `place` on, rows `stride` apart and none in another, lie within `size`. */
static inline bool holds(int64_t size, int64_t place, int64_t stride, int64_t rows, int64_t columns) {
    if (place < 0 || place > size || rows < 1 || columns < 1 || columns > size - place)
        return false;
    return rows == 1 || (stride >= columns && rows - 1 <= (size - place - columns) / stride);
}

/* Whether a band lies within `size` elements. */
static inline bool is_band(const int64_t *band, int64_t size) {
    return band[BAND_ROWS] <= INT32_MAX && band[BAND_COLUMNS] <= INT32_MAX &&
           holds(size, band[BAND_OFFSET], band[BAND_STRIDE], band[BAND_ROWS], band[BAND_COLUMNS]);
}

#endif
