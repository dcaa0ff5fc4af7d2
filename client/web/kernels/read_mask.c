#include "reading.h"

static int64_t lode_mask(int64_t reads, int64_t rows, int64_t columns, int64_t first, int64_t last, uint8_t *field,
                         int64_t field_count, int32_t *model, int64_t model_count, uint8_t *data, int64_t data_count,
                         int64_t *state, int64_t state_count);

#include "mask.c"

/* Returns the bytes looked at so far. */
EXPORTED(mask)
int32_t read_mask(int32_t rows, int32_t columns, int32_t first, int32_t last, uint8_t *field, int32_t field_count,
                  int32_t *model, uint8_t *data, int32_t data_count, int64_t *state) {
    return answer(lode_mask(1, rows, columns, first, last, field, (uint32_t)field_count, model, LODE_MASK_MODEL, data,
                            data_count, state, 4));
}
