#include "reading.h"

static int64_t lode_lift(int64_t inverse, int64_t axis, int32_t *x, int64_t rows, int64_t columns, int64_t pitch,
                         int64_t midpoints, int64_t run, const int64_t *table, int64_t table_count, int64_t a,
                         int64_t b, int64_t from, int32_t *work, int64_t work_count);

#include "lifting.c"

/* The inverse step; `table` has 20 rows. Returns how many nodes are done. */
EXPORTED(lift)
int32_t inverse_lift(int32_t axis, int32_t *x, int32_t rows, int32_t columns, int32_t pitch, int32_t midpoints,
                     int32_t run, const int64_t *table, int32_t a, int32_t b, int32_t from, int32_t *work,
                     int32_t work_count) {
    return answer(
        lode_lift(1, axis, x, rows, columns, pitch, midpoints, run, table, 4 * REACH, a, b, from, work, work_count));
}
