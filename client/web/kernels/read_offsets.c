#include "reading.h"

static int64_t lode_offsets(int64_t reads, const double *bases, int64_t bases_count, const int64_t *restored,
                            int64_t restored_count, int64_t bits, int64_t *places, int64_t places_count, int32_t *model,
                            int64_t model_count, uint8_t *data, int64_t data_count);

#include "offsets.c"

/* `count` values; returns the bytes looked at. */
EXPORTED(offsets)
int32_t read_offsets(const double *bases, const int64_t *restored, int32_t count, int32_t bits, int64_t *places,
                     int32_t *model, uint8_t *data, int32_t data_count) {
    return answer(lode_offsets(1, bases, count, restored, count, bits, places, count, model, LODE_OFFSETS_MODEL, data,
                               data_count));
}
