/* Values under holes: a thin plate through what is around them, by way of coarser grids (pull and push).
 *
 * Averages of 2 x 2 points are pulled until there are no holes left; on the way back each hole takes what the coarser
 * grid has there, in a straight line between its points, and some sweeps bring it to where a plate would lie.
 */
#include <stdbool.h>

#include "copying.h"
#include "lodestream.h"

enum {
    GROUP = 8, /* points that are left out together where none is a hole */
    MOST_STEPS = 1 << 20,
};

/* A plate lies at (8 near - 2 corners - far) / 20 of the points around one. Each step goes further than there, by 1.4,
 * so that fewer are needed. */
#define NEAR 0.56
#define CORNER 0.14
#define FAR 0.07
#define BEYOND 0.4

static int64_t least(int64_t a, int64_t b) {
    return a < b ? a : b;
}

static bool is_grid(int64_t values_count, int64_t known_count, int64_t rows, int64_t columns) {
    return rows >= 1 && columns >= 1 && rows <= INT32_MAX && columns <= INT32_MAX && values_count == rows * columns &&
           known_count == values_count;
}

static bool is_run(int64_t first, int64_t last, int64_t count) {
    return first >= 0 && first <= last && last <= count;
}

/* The place `step` further on, at most 2 either way; beyond the end of an axis that does not wrap, its last one. */
static int64_t beside(int64_t place, int64_t step, int64_t length, bool wraps) {
    int64_t other = place + step;
    if (other >= 0 && other < length)
        return other;
    if (wraps)
        return (other + 2 * length) % length;
    return other < 0 ? 0 : length - 1;
}

/* Whether GROUP points from `place` on, or of those up to it where `step` is -1, have no hole. */
static bool all_known(const uint8_t *place, int64_t step) {
    uint64_t group;
    memcpy(&group, place - (step < 0 ? GROUP - 1 : 0), sizeof group);
    return group == UINT64_C(0x0101010101010101);
}

/* The sum of the known points of a 2 x 2, in quarters, lest it overflow; into `count` how many they are, into `points`
 * of how many. */
static double sum_of(const double *values, const uint8_t *known, int64_t rows, int64_t columns, int64_t i, int64_t j,
                     int *count, int *points) {
    int64_t bottom = least(2 * i + 2, rows), right = least(2 * j + 2, columns);
    double sum = 0.0;
    *count = *points = 0;
    for (int64_t k = 2 * i; k < bottom; k++)
        for (int64_t m = 2 * j; m < right; m++) {
            ++*points;
            if (known[k * columns + m]) {
                sum += 0.25 * values[k * columns + m];
                ++*count;
            }
        }
    return sum;
}

/* Whether a point of the coarser grid or one of the eight around it has a 2 x 2 that is known in whole. Without a
 * branch for each: in ragged masks none could be foreseen. */
static bool is_near_whole(const uint8_t *known, int64_t rows, int64_t columns, int64_t i, int64_t j) {
    int64_t bottom = least(i + 2, (rows + 1) / 2), right = least(j + 2, (columns + 1) / 2);
    int whole = 0;
    for (int64_t k = i ? i - 1 : 0; k < bottom; k++) {
        const uint8_t *upper = known + 2 * k * columns, *lower = known + least(2 * k + 1, rows - 1) * columns;
        for (int64_t m = j ? j - 1 : 0; m < right; m++) {
            int64_t near = 2 * m, far = least(2 * m + 1, columns - 1);
            whole |= upper[near] & upper[far] & lower[near] & lower[far];
        }
    }
    return whole != 0;
}

int64_t lode_pull(const double *values, int64_t values_count, const uint8_t *known, int64_t known_count, int64_t rows,
                  int64_t columns, int64_t first, int64_t last, double *coarser, int64_t coarser_count, uint8_t *found,
                  int64_t found_count) {
    if (!is_grid(values_count, known_count, rows, columns))
        return LODE_REFUSED;
    int64_t width = (columns + 1) / 2;
    if (coarser_count != (rows + 1) / 2 * width || found_count != coarser_count || !is_run(first, last, coarser_count))
        return LODE_REFUSED;
    for (int64_t at = first, i = first / width, j = first % width; at < last; at++) {
        int count, points;
        double sum = sum_of(values, known, rows, columns, i, j, &count, &points);
        coarser[at] = count ? sum * (4.0 / count) : 0.0;
        /* The mean of a part is not that of the middle: beside better ones it would do more harm than good. */
        found[at] = count == points || (count && !is_near_whole(known, rows, columns, i, j));
        if (++j == width) {
            j = 0;
            i++;
        }
    }
    return 0;
}

/* The coarser grid in column j: three quarters of the point that it lies in, a quarter of the next. */
static double along(const double *row, int64_t j, int64_t width, bool wraps) {
    int64_t here = j >> 1;
    return 0.75 * row[here] + 0.25 * row[beside(here, 2 * (j & 1) - 1, width, wraps)];
}

int64_t lode_push(const struct lode_push *arguments) {
    const struct lode_push call = *arguments;
    if (!is_grid(call.values_count, call.known_count, call.rows, call.columns))
        return LODE_REFUSED;
    int64_t height = (call.rows + 1) / 2, width = (call.columns + 1) / 2;
    if (call.coarser_count != height * width || !is_run(call.first, call.last, call.values_count))
        return LODE_REFUSED;
    for (int64_t at = call.first; at < call.last;) {
        int64_t i = at / call.columns, start = at % call.columns, stop = least(call.columns, start + (call.last - at));
        const double *near = call.coarser + (i >> 1) * width;
        const double *far = call.coarser + beside(i >> 1, 2 * (i & 1) - 1, height, call.rows_wrap != 0) * width;
        const uint8_t *own = call.known + i * call.columns;
        for (int64_t k = start; k < stop; k += GROUP) {
            int64_t end = least(k + GROUP, stop);
            if (end == k + GROUP && all_known(own + k, 1))
                continue;
            for (int64_t j = k; j < end; j++)
                if (!own[j])
                    call.values[i * call.columns + j] = 0.75 * along(near, j, width, call.columns_wrap != 0) +
                                                        0.25 * along(far, j, width, call.columns_wrap != 0);
        }
        at += stop - start;
    }
    return 0;
}

/* A row and the two at either side of it. */
struct rows {
    double *own;
    const double *up, *down, *top, *bottom;
};

static struct rows rows_around(double *values, int64_t rows, int64_t columns, int64_t i, bool wraps) {
    struct rows around = {values + i * columns, values + beside(i, -1, rows, wraps) * columns,
                          values + beside(i, 1, rows, wraps) * columns, values + beside(i, -2, rows, wraps) * columns,
                          values + beside(i, 2, rows, wraps) * columns};
    return around;
}

/* One step of the hole in column j. Of all around it only what stands `step` before was changed just now: that is added
 * last, so that all else need not wait for it. */
static void relax_hole(struct rows r, int64_t j, int64_t step, int64_t columns, bool wraps) {
    int64_t ahead = beside(j, step, columns, wraps), behind = beside(j, -step, columns, wraps);
    double near = (r.up[j] + r.down[j]) + r.own[ahead];
    double corners = (r.up[behind] + r.down[ahead]) + (r.up[ahead] + r.down[behind]);
    double far = (r.top[j] + r.bottom[j]) + r.own[beside(j, 2 * step, columns, wraps)];
    double others = NEAR * near - CORNER * corners - FAR * far - BEYOND * r.own[j];
    r.own[j] = (others - FAR * r.own[beside(j, -2 * step, columns, wraps)]) + NEAR * r.own[behind];
}

int64_t lode_relax(double *values, int64_t values_count, const uint8_t *known, int64_t known_count, int64_t rows,
                   int64_t columns, int64_t first, int64_t last, int64_t rows_wrap, int64_t columns_wrap) {
    if (!is_grid(values_count, known_count, rows, columns) || !is_run(first, last, INT64_MAX) ||
        last - first > MOST_STEPS)
        return LODE_REFUSED;
    for (int64_t at = first; at < last;) {
        int64_t line = at / columns, start = at % columns, stop = least(columns, start + (last - at));
        int64_t step = (line / rows) & 1 ? -1 : 1;
        int64_t i = step > 0 ? line % rows : rows - 1 - line % rows;
        struct rows around = rows_around(values, rows, columns, i, rows_wrap != 0);
        const uint8_t *own = known + i * columns;
        for (int64_t k = start; k < stop; k += GROUP) {
            int64_t j = step > 0 ? k : columns - 1 - k, count = least(GROUP, stop - k);
            if (count == GROUP && all_known(own + j, step))
                continue;
            for (; count > 0; count--, j += step)
                if (!own[j])
                    relax_hole(around, j, step, columns, columns_wrap != 0);
        }
        at += stop - start;
    }
    return 0;
}
