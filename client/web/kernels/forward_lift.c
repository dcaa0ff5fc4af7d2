#include "reading.h"

static int64_t lode_lift(int64_t inverse, int64_t axis, int32_t *x, int64_t rows, int64_t columns, int64_t pitch,
                         int64_t midpoints, int64_t run, const int64_t *table, int64_t table_count, int64_t a,
                         int64_t b, int64_t from, int32_t *work, int64_t work_count);

#include "lifting.c"

/* The forward step of one row, which sides that come from curves take their details by. */
EXPORTED(forward)
int32_t forward_lift(int32_t *x, int32_t columns, int32_t midpoints, int32_t run, const int64_t *table, int32_t a,
                     int32_t b, int32_t from, int32_t *work, int32_t work_count) {
    return answer(
        lode_lift(0, 1, x, 1, columns, columns, midpoints, run, table, 4 * REACH, a, b, from, work, work_count));
}
