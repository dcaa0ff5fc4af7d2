#include "reading.h"

struct lode_passes;
static int64_t lode_passes(int64_t reads, int64_t trellis, const struct lode_passes *arguments);

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
    struct lode_passes arguments = {
        .bands = bands,
        .bands_count = bands_count,
        .runs = runs,
        .runs_count = runs_count,
        .known = known,
        .known_count = size,
        .sign = sign,
        .sign_count = size,
        .flags = flags,
        .flags_count = flags_count,
        .early = early,
        .early_count = size,
        .models = models,
        .models_count = models_count,
        .data = data,
        .data_count = data_count,
        .state = state,
        .state_count = LODE_PASSES_STATE,
        .budget = budget,
    };
    return answer(lode_passes(1, trellis, &arguments));
}
