/* All levels of a channel undone, one step after another (docs/format.md, section 8): small surfaces have many levels
 * of few values, of which a call each would take longer than what it does. */
#include <stdbool.h>

#include "lodestream.h"

enum {
    KIND,
    PLANE,
    AXIS,
    ROWS,
    COLUMNS,
    MIDPOINTS,
    RUN,
    A,
    B,
    TABLE,
    TABLE_COUNT = 40,
    SOURCE = TABLE + TABLE_COUNT,
    FROM,
    BY,
    LINE,
    FRACTION_BITS = 3,
    LARGEST = 1 << (27 - FRACTION_BITS),
};

_Static_assert(LINE + 1 == LODE_INVERSE_STEP, "a step has these fields");

/* Rows of values that lie side by side, somewhere in `x`. */
struct plane {
    int32_t *x;
    int64_t rows, columns, pitch;
};

/* Values `by` apart. */
struct line {
    int32_t *x;
    int64_t by;
};

/* A plane by its number; one without rows where it does not lie within `x`. */
static struct plane plane_of(const int64_t *planes, int64_t planes_count, int64_t number, int32_t *x, int64_t x_count) {
    const struct plane none = {x, 0, 0, 0};
    if (number < 0 || number >= planes_count / LODE_INVERSE_PLANE)
        return none;
    const int64_t *row = planes + number * LODE_INVERSE_PLANE;
    int64_t first = row[0], rows = row[1], columns = row[2], pitch = row[3];
    if (first < 0 || first > x_count || rows < 1 || columns < 1 || columns > x_count - first || pitch < columns ||
        (rows - 1) > (x_count - first - columns) / pitch)
        return none;
    return (struct plane){x + first, rows, columns, pitch};
}

/* Steps become steps over 2**FRACTION_BITS, kept within what the lifting takes. */
static void refine(int32_t *x, int64_t rows, int64_t columns, int64_t pitch) {
    for (int64_t i = 0; i < rows; i++)
        for (int64_t j = 0; j < columns; j++) {
            int32_t value = x[i * pitch + j];
            value = value < -LARGEST ? -LARGEST : value > LARGEST ? LARGEST : value;
            x[i * pitch + j] = value * (1 << FRACTION_BITS);
        }
}

/* Lift the first rows and columns of a plane, all of it or of a line. */
static bool lift(int64_t kind, const int64_t *step, int64_t axis, int32_t *x, int64_t rows, int64_t columns,
                 int64_t pitch, int32_t *work, int64_t work_count) {
    struct lode_lift call = {
        .x = x,
        .rows = rows,
        .columns = columns,
        .pitch = pitch,
        .midpoints = step[MIDPOINTS],
        .run = step[RUN],
        .table = step + TABLE,
        .table_count = TABLE_COUNT,
        .a = step[A],
        .b = step[B],
        .work = work,
        .work_count = work_count,
    };
    while (call.from < step[RUN]) {
        call.from = lode_lift(kind, axis, &call);
        if (call.from == LODE_REFUSED)
            return false;
    }
    return true;
}

/* The line of a plane that a step names, if it has `count` values. */
static bool line_of(const int64_t *step, struct plane of, int64_t count, struct line *found) {
    bool across = step[AXIS] == 1;
    if ((step[AXIS] != 0 && !across) || step[LINE] < 0 || step[LINE] >= (across ? of.rows : of.columns) ||
        count > (across ? of.columns : of.rows))
        return false;
    *found = across ? (struct line){of.x + step[LINE] * of.pitch, 1} : (struct line){of.x + step[LINE], of.pitch};
    return true;
}

/* The points that a step takes from the first column of another plane. */
static bool points_of(const int64_t *step, struct plane of, int64_t count, struct line *found) {
    if (!of.rows || count < 1 || step[FROM] < 0 || step[FROM] >= of.rows || step[BY] < -1 || step[BY] > 1)
        return false;
    if ((step[BY] > 0 && count > of.rows - step[FROM]) || (step[BY] < 0 && count > step[FROM] + 1))
        return false;
    *found = (struct line){of.x + step[FROM] * of.pitch, step[BY] * of.pitch};
    return true;
}

/* A side's points at level 0, or the details along it, from the points of an interface. */
static bool take(const int64_t *step, struct plane into, struct plane source, int32_t *work, int64_t work_count) {
    bool nodes = step[KIND] == LODE_INVERSE_NODES;
    int64_t count = step[COLUMNS];
    struct line side, points;
    if (!line_of(step, into, count, &side) || !points_of(step, source, count, &points))
        return false;
    if (nodes) {
        for (int64_t i = 0; i < count; i++)
            side.x[i * side.by] = points.x[i * points.by];
        return true;
    }
    if (step[MIDPOINTS] < 1 || step[MIDPOINTS] > count || work_count < count)
        return false;
    for (int64_t i = 0; i < count; i++)
        work[i] = step[BY] ? points.x[i * points.by] : 0; /* points that are one have no details */
    if (!lift(0, step, 1, work, 1, count, count, work + count, work_count - count))
        return false;
    for (int64_t i = count - step[MIDPOINTS]; i < count; i++)
        side.x[i * side.by] = work[i];
    return true;
}

int64_t lode_inverse(const int64_t *steps, int64_t steps_count, const int64_t *planes, int64_t planes_count, int32_t *x,
                     int64_t x_count, int32_t *work, int64_t work_count) {
    if (steps_count % LODE_INVERSE_STEP || planes_count % LODE_INVERSE_PLANE)
        return LODE_REFUSED;
    for (int64_t i = 0; i < steps_count; i += LODE_INVERSE_STEP) {
        const int64_t *step = steps + i;
        int64_t kind = step[KIND];
        if (kind == LODE_INVERSE_NOTHING)
            continue;
        struct plane plane = plane_of(planes, planes_count, step[PLANE], x, x_count);
        if (kind == LODE_INVERSE_NODES || kind == LODE_INVERSE_DETAILS) {
            struct plane source = plane_of(planes, planes_count, step[SOURCE], x, x_count);
            if (!take(step, plane, source, work, work_count))
                return LODE_REFUSED;
            continue;
        }
        if (step[ROWS] < 1 || step[ROWS] > plane.rows || step[COLUMNS] < 1 || step[COLUMNS] > plane.columns)
            return LODE_REFUSED;
        if (kind == LODE_INVERSE_REFINE)
            refine(plane.x, step[ROWS], step[COLUMNS], plane.pitch);
        else if ((kind != 1 && kind != LODE_LIFT_BARE) ||
                 !lift(kind, step, step[AXIS], plane.x, step[ROWS], step[COLUMNS], plane.pitch, work, work_count))
            return LODE_REFUSED;
    }
    return 0;
}
