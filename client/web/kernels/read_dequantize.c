#include "reading.h"

static int64_t lode_spread(const int32_t *known, int64_t known_count, const int8_t *sign, int64_t sign_count,
                           const uint8_t *early, int64_t early_count, const int64_t *bands, int64_t bands_count,
                           const int64_t *windows, int64_t windows_count, const int64_t *steps, int64_t steps_count,
                           const int64_t *numbers, int64_t numbers_count, const int8_t *state, int64_t state_count,
                           int64_t finer, int32_t *out, int64_t rows, int64_t columns, int64_t pitch, int64_t first_row,
                           int64_t first_column);

#include "dequantize.c"

/* `size` numbers of known, sign and early, `bands_count` numbers in the table
 * of bands. */
EXPORTED(dequantize)
int32_t dequantize(const int32_t *known, const int8_t *sign, const uint8_t *early, int32_t size, const int64_t *bands,
                   int32_t bands_count, const int64_t *windows, const int64_t *steps, const int64_t *numbers,
                   int32_t numbers_count, const int8_t *state, int32_t state_count, int32_t finer, int32_t *out,
                   int32_t rows, int32_t columns, int32_t pitch, int32_t first_row, int32_t first_column) {
    int64_t bands_there = bands_count / BAND_FIELDS;
    return answer(lode_spread(known, size, sign, size, early, size, bands, bands_count, windows, 3 * bands_there, steps,
                              bands_there, numbers, numbers_count, state, state_count, finer, out, rows, columns, pitch,
                              first_row, first_column));
}
