#include "reading.h"

struct lode_store_values;
static int64_t lode_store_values(const struct lode_store_values *arguments);
struct lode_square_distances;
static int64_t lode_square_distances(const struct lode_square_distances *arguments) __attribute__((unused));

#include "values.c"

/* All of a plane into one channel of (rows, columns, channels). */
EXPORTED(store_values)
int32_t store_values(const int32_t *coordinates, int32_t rows, int32_t columns, int32_t pitch, void *points,
                     int32_t points_type, int32_t channels, int32_t channel, int32_t decimal, double origin,
                     double step, double scale) {
    int64_t count = (int64_t)rows * columns;
    struct lode_store_values arguments = {
        .coordinates = coordinates,
        .rows = rows,
        .columns = columns,
        .pitch = pitch,
        .points = points,
        .points_count = count * channels,
        .points_type = points_type,
        .channels = channels,
        .channel = channel,
        .first = 0,
        .last = count,
        .decimal = decimal,
        .origin = origin,
        .step = step,
        .scale = scale,
    };
    return answer(lode_store_values(&arguments));
}
