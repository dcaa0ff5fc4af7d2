#include "reading.h"

struct lode_spread;
static int64_t lode_spread(const struct lode_spread *arguments);

#include "dequantize.c"

/* `size` numbers of known, sign and early, `bands_count` numbers in the table
 * of bands. */
EXPORTED(dequantize)
int32_t dequantize(const int32_t *known, const int8_t *sign, const uint8_t *early, int32_t size, const int64_t *bands,
                   int32_t bands_count, const int64_t *windows, const int64_t *steps, const int64_t *numbers,
                   int32_t numbers_count, const int8_t *state, int32_t state_count, int32_t finer, int32_t *out,
                   int32_t rows, int32_t columns, int32_t pitch, int32_t first_row, int32_t first_column) {
    int64_t bands_there = bands_count / BAND_FIELDS;
    struct lode_spread arguments = {
        .known = known,
        .known_count = size,
        .sign = sign,
        .sign_count = size,
        .early = early,
        .early_count = size,
        .bands = bands,
        .bands_count = bands_count,
        .origins = windows,
        .origins_count = 3 * bands_there,
        .steps = steps,
        .steps_count = bands_there,
        .numbers = numbers,
        .numbers_count = numbers_count,
        .state = state,
        .state_count = state_count,
        .finer = finer,
        .out = out,
        .rows = rows,
        .columns = columns,
        .pitch = pitch,
        .first_row = first_row,
        .first_column = first_column,
    };
    return answer(lode_spread(&arguments));
}
