#include "reading.h"

struct lode_mask;
static int64_t lode_mask(int64_t reads, int64_t rows, int64_t columns, int64_t first, int64_t last,
                         const struct lode_mask *arguments);

#include "mask.c"

/* Returns the bytes looked at so far. */
EXPORTED(mask)
int32_t read_mask(int32_t rows, int32_t columns, int32_t first, int32_t last, uint8_t *field, int32_t field_count,
                  int32_t *model, uint8_t *data, int32_t data_count, int64_t *state) {
    struct lode_mask arguments = {
        .field = field,
        .field_count = (uint32_t)field_count,
        .model = model,
        .model_count = LODE_MASK_MODEL,
        .data = data,
        .data_count = data_count,
        .state = state,
        .state_count = 4,
    };
    return answer(lode_mask(1, rows, columns, first, last, &arguments));
}
