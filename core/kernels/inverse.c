/* All levels of one plane undone, one step after another (docs/format.md, section 8): small surfaces have many levels
 * of few values, of which a call each would take longer than what it does. */
#include "lodestream.h"

enum {
    KIND,
    AXIS,
    ROWS,
    COLUMNS,
    MIDPOINTS,
    RUN,
    A,
    B,
    TABLE,
    TABLE_COUNT = LODE_INVERSE_STEP - TABLE,
    FRACTION_BITS = 3,
    LARGEST = 1 << (27 - FRACTION_BITS),
};

/* Steps become steps over 2**FRACTION_BITS, kept within what the lifting takes. */
static void refine(int32_t *x, int64_t rows, int64_t columns, int64_t pitch) {
    for (int64_t i = 0; i < rows; i++)
        for (int64_t j = 0; j < columns; j++) {
            int32_t value = x[i * pitch + j];
            value = value < -LARGEST ? -LARGEST : value > LARGEST ? LARGEST : value;
            x[i * pitch + j] = value * (1 << FRACTION_BITS);
        }
}

int64_t lode_inverse(const int64_t *steps, int64_t steps_count, int32_t *x, int64_t rows, int64_t columns,
                     int64_t pitch, int32_t *work, int64_t work_count) {
    if (steps_count % LODE_INVERSE_STEP || rows < 1 || columns < 1 || (rows > 1 && pitch < columns))
        return LODE_REFUSED;
    for (int64_t i = 0; i < steps_count; i += LODE_INVERSE_STEP) {
        const int64_t *step = steps + i;
        if (step[KIND] == LODE_INVERSE_NOTHING)
            continue;
        if (step[ROWS] < 1 || step[ROWS] > rows || step[COLUMNS] < 1 || step[COLUMNS] > columns)
            return LODE_REFUSED;
        if (step[KIND] == LODE_INVERSE_REFINE) {
            refine(x, step[ROWS], step[COLUMNS], pitch);
            continue;
        }
        if (step[KIND] != 1 && step[KIND] != LODE_LIFT_BARE)
            return LODE_REFUSED;
        for (int64_t from = 0; from < step[RUN];) {
            from = lode_lift(step[KIND], step[AXIS], x, step[ROWS], step[COLUMNS], pitch, step[MIDPOINTS], step[RUN],
                             step + TABLE, TABLE_COUNT, step[A], step[B], from, work, work_count);
            if (from == LODE_REFUSED)
                return LODE_REFUSED;
        }
    }
    return 0;
}
