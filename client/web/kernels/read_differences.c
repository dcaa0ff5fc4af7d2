#include "reading.h"

struct lode_differences;
static int64_t lode_differences(int64_t reads, const struct lode_differences *arguments);

#include "differences.c"

/* `count` values; `used` takes the bytes of `data` and of `stored` that were looked at. */
EXPORTED(differences)
int32_t read_differences(const int64_t *line, int64_t *differences, const int32_t *exponents, uint8_t *marks,
                         int32_t count, int32_t most, int32_t specials, int32_t *model, int64_t *memory, uint8_t *data,
                         int32_t data_count, uint8_t *stored, int32_t stored_count, int64_t *used) {
    struct lode_differences arguments = {
        .line = line,
        .line_count = count,
        .differences = differences,
        .differences_count = count,
        .exponents = exponents,
        .exponents_count = count,
        .marks = marks,
        .marks_count = count,
        .most = most,
        .specials = specials,
        .model = model,
        .model_count = LODE_DIFFERENCES_MODEL,
        .memory = memory,
        .memory_count = 3 * LODE_DIFFERENCES_MEMORY,
        .data = data,
        .data_count = data_count,
        .stored = stored,
        .stored_count = stored_count,
        .used = used,
        .used_count = 2,
    };
    return answer(lode_differences(1, &arguments));
}
