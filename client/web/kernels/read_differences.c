#include "reading.h"

static int64_t lode_differences(int64_t reads, const int64_t *line, int64_t line_count, int64_t *differences,
                                int64_t differences_count, const int32_t *exponents, int64_t exponents_count,
                                uint8_t *marks, int64_t marks_count, int64_t most, int64_t specials, int32_t *model,
                                int64_t model_count, int64_t *memory, int64_t memory_count, uint8_t *data,
                                int64_t data_count, uint8_t *stored, int64_t stored_count, int64_t *used,
                                int64_t used_count);

#include "differences.c"

/* `count` values; `used` takes the bytes of `data` and of `stored` that were looked at. */
EXPORTED(differences)
int32_t read_differences(const int64_t *line, int64_t *differences, const int32_t *exponents, uint8_t *marks,
                         int32_t count, int32_t most, int32_t specials, int32_t *model, int64_t *memory, uint8_t *data,
                         int32_t data_count, uint8_t *stored, int32_t stored_count, int64_t *used) {
    return answer(lode_differences(1, line, count, differences, count, exponents, count, marks, count, most, specials,
                                   model, LODE_DIFFERENCES_MODEL, memory, 3 * LODE_DIFFERENCES_MEMORY, data, data_count,
                                   stored, stored_count, used, 2));
}
