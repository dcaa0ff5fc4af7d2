#include "reading.h"

static int64_t lode_store_values(const int32_t *coordinates, int64_t rows, int64_t columns, int64_t pitch, void *points,
                                 int64_t points_count, int64_t points_type, int64_t channels, int64_t channel,
                                 int64_t first, int64_t last, int64_t decimal, double origin, double step,
                                 double scale);
static int64_t lode_square_distances(const void *points, int64_t points_count, int64_t points_type,
                                     const int32_t *coordinates, int64_t coordinates_count, const double *rules,
                                     int64_t rules_count, const uint8_t *counted, int64_t counted_count,
                                     double *figures, int64_t figures_count, int64_t rows, int64_t columns,
                                     int64_t channels, int64_t channel, int64_t height, int64_t pitch, int64_t first,
                                     int64_t last) __attribute__((unused));

#include "values.c"

/* All of a plane into one channel of (rows, columns, channels). */
EXPORTED(store_values)
int32_t store_values(const int32_t *coordinates, int32_t rows, int32_t columns, int32_t pitch, void *points,
                     int32_t points_type, int32_t channels, int32_t channel, int32_t decimal, double origin,
                     double step, double scale) {
    int64_t count = (int64_t)rows * columns;
    return answer(lode_store_values(coordinates, rows, columns, pitch, points, count * channels, points_type, channels,
                                    channel, 0, count, decimal, origin, step, scale));
}
