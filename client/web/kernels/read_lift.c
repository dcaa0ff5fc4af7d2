#include "reading.h"

struct lode_lift;
static int64_t lode_lift(int64_t inverse, int64_t axis, const struct lode_lift *arguments);

#include "lifting.c"

/* The inverse step; `table` has 20 rows. Returns how many nodes are done. */
EXPORTED(lift)
int32_t inverse_lift(int32_t axis, int32_t *x, int32_t rows, int32_t columns, int32_t pitch, int32_t midpoints,
                     int32_t run, const int64_t *table, int32_t a, int32_t b, int32_t from, int32_t *work,
                     int32_t work_count) {
    struct lode_lift arguments = {
        .x = x,
        .rows = rows,
        .columns = columns,
        .pitch = pitch,
        .midpoints = midpoints,
        .run = run,
        .table = table,
        .table_count = 4 * REACH,
        .a = a,
        .b = b,
        .from = from,
        .work = work,
        .work_count = work_count,
    };
    return answer(lode_lift(1, axis, &arguments));
}
