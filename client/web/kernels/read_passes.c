#include "reading.h"

static int64_t lode_passes(int64_t reads, int64_t trellis, const int64_t *bands, int64_t bands_count, int64_t *runs,
                           int64_t runs_count, int32_t *known, int64_t known_count, int8_t *sign, int64_t sign_count,
                           uint8_t *flags, int64_t flags_count, uint8_t *early, int64_t early_count,
                           const int32_t *truth, int64_t truth_count, int32_t *models, int64_t models_count,
                           uint8_t *data, int64_t data_count, double *costs, int64_t costs_count, uint16_t *symbols,
                           int64_t symbols_count, int64_t *state, int64_t state_count, int64_t budget);

#include "block_coder.h"

/* A table of bitplanes.c names the functions of both directions: those that write become empty. */
#define code_block(reads, ...)                                                                                         \
    do {                                                                                                               \
        if (reads)                                                                                                     \
            code_block(true, __VA_ARGS__);                                                                             \
    } while (0)

#include "bitplanes.c"

/* `size` numbers of known, sign and early; returns how many runs are done. */
EXPORTED(passes)
int32_t read_passes(int32_t trellis, const int64_t *bands, int32_t bands_count, int64_t *runs, int32_t runs_count,
                    int32_t *known, int8_t *sign, uint8_t *early, int32_t size, uint8_t *flags, int32_t flags_count,
                    int32_t *models, int32_t models_count, uint8_t *data, int32_t data_count, int64_t *state,
                    int32_t budget) {
    return answer(lode_passes(1, trellis, bands, bands_count, runs, runs_count, known, size, sign, size, flags,
                              flags_count, early, size, 0, 0, models, models_count, data, data_count, 0, 0, 0, 0, state,
                              LODE_PASSES_STATE, budget));
}
