/* Lattice coordinates into values of any type, and their squared distances from other values (docs/format.md,
 * "Header", lattices).
 *
 * A value is origin + step q, or (origin + q) / step, in float64, rounded after each operation. Into a float32 it is
 * rounded after it is brought into the range of finite ones; into an integer, to the nearest, halves to even, and
 * within the range of the type.
 *
 * Values are worked on some hundred at a time, loop by loop: what lies in between stays in the cache, and loops that
 * know one type or one rule are few and fast.
 */
#include <float.h>
#include <stdbool.h>

#include "copying.h"
#include "lodestream.h"
#include "whole_distances.h"

enum {
    TOGETHER = 512,   /* values worked on together */
    SIDE_BY_SIDE = 8, /* parts whose rows are read from end to end: memory comes faster so */
    WIDEST = SIDE_BY_SIDE * LODE_PART_COLUMNS,
    MOST_KINDS = 4, /* of figures of one part: of the distances and of three channels; they share the room */
    RULE_NUMBERS = 4,
};

/* Added to a float64 of less than 2^51, this leaves its integer part, rounded, in the lowest bits. */
#define WHOLE 0x1.8p52

static int64_t least(int64_t a, int64_t b) {
    return a < b ? a : b;
}

/* A lattice, and the least and largest value of the type that is wanted. */
struct rule {
    bool decimal;
    double origin, step, scale, low, high;
};

static double value_of(int32_t coordinate, const struct rule *rule) {
    double q = (double)coordinate * rule->scale;
    return rule->decimal ? (q + rule->origin) / rule->step : q * rule->step + rule->origin;
}

/* Whether all values are within the range of the type: they rise with their coordinates. */
static bool are_within(const int32_t *coordinates, int64_t count, const struct rule *rule) {
    if (value_of(INT32_MIN, rule) >= rule->low && value_of(INT32_MAX, rule) <= rule->high)
        return true;
    int32_t first = coordinates[0], last = coordinates[0];
    for (int64_t j = 0; j < count; j++) {
        first = coordinates[j] < first ? coordinates[j] : first;
        last = coordinates[j] > last ? coordinates[j] : last;
    }
    return value_of(first, rule) >= rule->low && value_of(last, rule) <= rule->high;
}

static void evaluate(const int32_t *coordinates, int64_t count, const struct rule *rule, double *values) {
    double origin = rule->origin, step = rule->step, scale = rule->scale, low = rule->low, high = rule->high;
    if (rule->decimal)
        for (int64_t j = 0; j < count; j++)
            values[j] = ((double)coordinates[j] * scale + origin) / step;
    else
        for (int64_t j = 0; j < count; j++)
            values[j] = (double)coordinates[j] * scale * step + origin;
    if (!are_within(coordinates, count, rule))
        for (int64_t j = 0; j < count; j++)
            values[j] = values[j] < low ? low : values[j] > high ? high : values[j];
}

typedef float float32_t;
typedef double float64_t;

enum {
    NUMBER_int8,
    NUMBER_int16,
    NUMBER_int32,
    NUMBER_int64,
    NUMBER_uint8,
    NUMBER_uint16,
    NUMBER_uint32,
    NUMBER_uint64,
    NUMBER_float32,
    NUMBER_float64,
    TYPES,
};

static const struct {
    int64_t size;
    double low, high;
} TYPE[TYPES] = {
    {1, INT8_MIN, INT8_MAX},
    {2, INT16_MIN, INT16_MAX},
    {4, INT32_MIN, INT32_MAX},
    {8, -0x1p63, 0x1p63},
    {1, 0, UINT8_MAX},
    {2, 0, UINT16_MAX},
    {4, 0, UINT32_MAX},
    {8, 0, 0x1p64},
    {4, -(double)FLT_MAX, (double)FLT_MAX},
    {8, -DBL_MAX, DBL_MAX},
};

/* For each type: `to_`, a value within its range into the type, and `seen_`, what that is as a float64; each where it
 * is needed. */
#define INTEGER(type)                                                                                                  \
    static inline type##_t to_##type(double value) {                                                                   \
        double sum = value + WHOLE;                                                                                    \
        uint64_t bits;                                                                                                 \
        memcpy(&bits, &sum, sizeof bits);                                                                              \
        return (type##_t)bits;                                                                                         \
    }                                                                                                                  \
    static inline double seen_##type(double value) {                                                                   \
        return (value + WHOLE) - WHOLE;                                                                                \
    }

INTEGER(int8)
INTEGER(int16)
INTEGER(int32)
INTEGER(uint8)
INTEGER(uint16)
INTEGER(uint32)

/* The nearest whole number of any float64; those of 2^52 and more are whole. */
static inline double nearest(double value) {
    double away = value < 0 ? -0x1p52 : 0x1p52;
    return value > -0x1p52 && value < 0x1p52 ? (value + away) - away : value;
}

static inline int64_t to_int64(double value) {
    value = nearest(value);
    return value >= 0x1p63 ? INT64_MAX : (int64_t)value;
}

static inline uint64_t to_uint64(double value) {
    value = nearest(value);
    return value >= 0x1p64 ? UINT64_MAX : (uint64_t)value;
}

static inline float to_float32(double value) {
    return (float)value;
}

static inline double seen_float32(double value) {
    return (double)(float)value;
}

static inline double seen_float64(double value) {
    return value;
}

/* The square of the difference of integers that float64 cannot tell apart: it is taken in integers. */
#define WIDE_INTEGER(type)                                                                                             \
    static inline double square_##type(type##_t point, double value) {                                                 \
        type##_t other = to_##type(value);                                                                             \
        double delta =                                                                                                 \
            (double)(point > other ? (uint64_t)point - (uint64_t)other : (uint64_t)other - (uint64_t)point);           \
        return delta * delta;                                                                                          \
    }

WIDE_INTEGER(int64)
WIDE_INTEGER(uint64)

#define CONVERT(type)                                                                                                  \
    case NUMBER_##type: {                                                                                              \
        type##_t *own = points;                                                                                        \
        for (int64_t j = 0; j < count; j++)                                                                            \
            own[j] = to_##type(values[j]);                                                                             \
        break;                                                                                                         \
    }

#define SQUARE(type)                                                                                                   \
    case NUMBER_##type: {                                                                                              \
        const type##_t *own = points;                                                                                  \
        for (int64_t j = 0; j < count; j++) {                                                                          \
            double delta = (double)own[j] - seen_##type(values[j]);                                                    \
            squares[j] = delta * delta;                                                                                \
        }                                                                                                              \
        break;                                                                                                         \
    }

#define SQUARE_WIDE(type)                                                                                              \
    case NUMBER_##type: {                                                                                              \
        const type##_t *own = points;                                                                                  \
        for (int64_t j = 0; j < count; j++)                                                                            \
            squares[j] = square_##type(own[j], values[j]);                                                             \
        break;                                                                                                         \
    }

/* Values into points that lie side by side. */
static void convert(const double *restrict values, int64_t count, int64_t type, void *restrict points) {
    switch (type) {
        CONVERT(int8)
        CONVERT(int16)
        CONVERT(int32)
        CONVERT(int64)
        CONVERT(uint8)
        CONVERT(uint16)
        CONVERT(uint32)
        CONVERT(uint64)
        CONVERT(float32)
    }
}

/* Squares of how far points that lie side by side are from values. */
static void square(const double *restrict values, int64_t count, int64_t type, const void *restrict points,
                   double *restrict squares) {
    switch (type) {
        SQUARE(int8)
        SQUARE(int16)
        SQUARE(int32)
        SQUARE_WIDE(int64)
        SQUARE(uint8)
        SQUARE(uint16)
        SQUARE(uint32)
        SQUARE_WIDE(uint64)
        SQUARE(float32)
        SQUARE(float64)
    }
}

#define COPY(bits)                                                                                                     \
    case (bits) / 8:                                                                                                   \
        for (int64_t j = 0; j < count; j++)                                                                            \
            ((uint##bits##_t *)to)[j * to_stride] = ((const uint##bits##_t *)from)[j * from_stride];                   \
        break;

/* Copy elements of some bytes that stand some elements apart. */
static void copy(int64_t size, const void *from, int64_t from_stride, void *to, int64_t to_stride, int64_t count) {
    switch (size) {
        COPY(8)
        COPY(16)
        COPY(32)
        COPY(64)
    }
}

static bool is_finite(double number) {
    return number >= -DBL_MAX && number <= DBL_MAX;
}

/* Whether values rise with their coordinates, and are numbers. */
static bool is_rule(double origin, double step, double scale) {
    return is_finite(origin) && is_finite(step) && is_finite(scale) && step > 0 && scale > 0;
}

/* Whether there are `count` elements in rows x columns x channels. */
static bool is_shape(int64_t count, int64_t rows, int64_t columns, int64_t channels) {
    return rows >= 1 && columns >= 1 && rows <= INT32_MAX && columns <= INT32_MAX && channels >= 1 &&
           count % channels == 0 && count / channels == rows * columns;
}

int64_t lode_store_values(const struct lode_store_values *arguments) {
    const struct lode_store_values call = *arguments;
    if (!is_shape(call.points_count, call.rows, call.columns, call.channels) || (call.rows > 1 && call.pitch < 0) ||
        call.points_type < 0 || call.points_type >= TYPES || call.channel < 0 || call.channel >= call.channels ||
        call.first < 0 || call.last < call.first || call.last > call.rows * call.columns ||
        !is_rule(call.origin, call.step, call.scale))
        return LODE_REFUSED;
    struct rule rule = {call.decimal != 0,          call.origin, call.step, call.scale, TYPE[call.points_type].low,
                        TYPE[call.points_type].high};
    int64_t size = TYPE[call.points_type].size;
    bool as_it_is = call.points_type == NUMBER_float64, beside = call.channels == 1;
    double values[TOGETHER], own[TOGETHER];
    for (int64_t at = call.first; at < call.last;) {
        int64_t row = at / call.columns, column = at % call.columns;
        int64_t count = least(least(call.columns - column, call.last - at), TOGETHER);
        void *place = (char *)call.points + (at * call.channels + call.channel) * size;
        double *evaluated = as_it_is && beside ? place : values;
        void *made = as_it_is ? evaluated : beside ? place : own;
        evaluate(call.coordinates + row * call.pitch + column, count, &rule, evaluated);
        if (!as_it_is)
            convert(evaluated, count, call.points_type, made);
        if (!beside)
            copy(size, made, 1, place, call.channels, count);
        at += count;
    }
    return 0;
}

struct comparison {
    const void *points;
    const int32_t *coordinates;
    const double *rules;
    const uint8_t *counted; /* or null: all are */
    int64_t type, columns, channels, channel, compared, height, pitch;
};

/* Figures of a part: of the distances and, where several channels are compared, of each. */
static int64_t kinds_of(int64_t compared) {
    return compared > 1 ? 1 + compared : 1;
}

/* Squared distances of at most TOGETHER points of a row in one channel. */
static void channel_distances(const struct comparison *c, int64_t channel, int64_t row, int64_t left, int64_t count,
                              double *squares) {
    const double *numbers = c->rules + RULE_NUMBERS * channel;
    struct rule rule = {numbers[0] != 0, numbers[1], numbers[2], numbers[3], TYPE[c->type].low, TYPE[c->type].high};
    double values[TOGETHER], own[TOGETHER];
    evaluate(c->coordinates + (channel * c->height + row) * c->pitch + left, count, &rule, values);
    int64_t size = TYPE[c->type].size;
    int64_t place = (row * c->columns + left) * c->channels + c->channel + channel;
    const void *points = (const char *)c->points + place * size;
    if (c->channels > 1) {
        copy(size, points, c->channels, own, 1, count);
        points = own;
    }
    square(values, count, c->type, points, squares);
}

/* The same of all kinds of figures, TOGETHER numbers each. */
static void row_distances(const struct comparison *c, int64_t row, int64_t left, int64_t count, double *squares) {
    int64_t kinds = kinds_of(c->compared);
    for (int64_t channel = 0; channel < c->compared; channel++) {
        double *own = squares + (kinds > 1 ? channel + 1 : 0) * TOGETHER;
        channel_distances(c, channel, row, left, count, own);
        if (kinds > 1)
            for (int64_t j = 0; j < count; j++)
                squares[j] = channel ? squares[j] + own[j] : own[j];
    }
    if (c->counted) {
        const uint8_t *counted = c->counted + row * c->columns + left;
        for (int64_t kind = 0; kind < kinds; kind++)
            for (int64_t j = 0; j < count; j++)
                squares[kind * TOGETHER + j] = counted[j] ? squares[kind * TOGETHER + j] : 0.0;
    }
}

/* Figures of parts side by side, together `count` points wide: those of columns, then of those. */
static void part_figures(const struct comparison *c, int64_t top, int64_t bottom, int64_t left, int64_t count,
                         double *figures) {
    double squares[MOST_KINDS * TOGETHER], sums[WIDEST], worst[WIDEST];
    int64_t kinds = kinds_of(c->compared);
    for (int64_t j = 0; j < kinds * count; j++)
        sums[j] = worst[j] = 0.0;
    for (int64_t row = top; row < bottom; row++)
        for (int64_t start = 0; start < count; start += TOGETHER) {
            int64_t some = least(count - start, TOGETHER);
            row_distances(c, row, left + start, some, squares);
            for (int64_t kind = 0; kind < kinds; kind++) {
                double *sum = sums + kind * count + start, *most = worst + kind * count + start;
                const double *own = squares + kind * TOGETHER;
                for (int64_t j = 0; j < some; j++) {
                    sum[j] += own[j];
                    most[j] = own[j] > most[j] ? own[j] : most[j];
                }
            }
        }
    for (int64_t kind = 0; kind < kinds; kind++)
        for (int64_t j = 0; j < count; j++) {
            double *own = figures + 2 * (j / LODE_PART_COLUMNS * kinds + kind);
            if (j % LODE_PART_COLUMNS == 0)
                own[0] = own[1] = 0.0;
            own[0] += sums[kind * count + j];
            own[1] = worst[kind * count + j] > own[1] ? worst[kind * count + j] : own[1];
        }
}

#define ADD_ROW(type)                                                                                                  \
    case NUMBER_##type:                                                                                                \
        add_row_##type(coordinates, (const type##_t *)c->points + at, c->counted ? c->counted + at : 0, count, rule,   \
                       figures);                                                                                       \
        break;

/* `part_figures` in integers. */
static void whole_part_figures(const struct comparison *c, const struct whole_rule *rule, int64_t top, int64_t bottom,
                               int64_t left, int64_t columns, double *found) {
    struct whole_figures parts[SIDE_BY_SIDE] = {{0, 0}};
    for (int64_t row = top; row < bottom; row++)
        for (int64_t start = 0; start < columns; start += LODE_PART_COLUMNS) {
            const int32_t *coordinates = c->coordinates + row * c->pitch + left + start;
            int64_t at = row * c->columns + left + start, count = least(columns - start, LODE_PART_COLUMNS);
            struct whole_figures *figures = parts + start / LODE_PART_COLUMNS;
            switch (c->type) {
                ADD_ROW(int8)
                ADD_ROW(int16)
                ADD_ROW(uint8)
                ADD_ROW(uint16)
            }
        }
    for (int64_t k = 0; k * LODE_PART_COLUMNS < columns; k++) {
        found[2 * k] = (double)parts[k].sum;
        found[2 * k + 1] = (double)parts[k].worst;
    }
}

/* Whether a comparison is one of integers of one channel on a lattice of whole numbers, and that. */
static bool compares_whole(const struct comparison *c, struct whole_rule *rule) {
    const double *numbers = c->rules;
    return c->channels == 1 && TYPE[c->type].size <= 2 && numbers[0] == 0 &&
           whole_rule_of(numbers[1], numbers[2], numbers[3], TYPE[c->type].low, TYPE[c->type].high, rule);
}

int64_t lode_square_distances(const struct lode_square_distances *arguments) {
    const struct lode_square_distances call = *arguments;
    int64_t compared = call.rules_count / RULE_NUMBERS, kinds = kinds_of(compared);
    if (!is_shape(call.points_count, call.rows, call.columns, call.channels) || call.rules_count % RULE_NUMBERS ||
        compared < 1 || kinds > MOST_KINDS || call.channel < 0 || call.channel > call.channels - compared ||
        !is_shape(call.coordinates_count, call.height, call.pitch, compared) || call.height < call.rows ||
        call.pitch < call.columns || (call.counted_count && call.counted_count != call.rows * call.columns) ||
        call.points_type < 0 || call.points_type >= TYPES)
        return LODE_REFUSED;
    int64_t across = (call.columns + LODE_PART_COLUMNS - 1) / LODE_PART_COLUMNS;
    int64_t down = (call.rows + LODE_PART_ROWS - 1) / LODE_PART_ROWS;
    if (call.first < 0 || call.last < call.first || call.last > down * across ||
        call.figures_count != 2 * kinds * down * across)
        return LODE_REFUSED;
    for (int64_t at = 0; at < call.rules_count; at += RULE_NUMBERS)
        if (!is_rule(call.rules[at + 1], call.rules[at + 2], call.rules[at + 3]))
            return LODE_REFUSED;
    struct comparison comparison = {
        call.points,      call.coordinates, call.rules,    call.counted_count ? call.counted : 0,
        call.points_type, call.columns,     call.channels, call.channel,
        compared,         call.height,      call.pitch};
    struct whole_rule whole = {0};
    bool is_whole = compares_whole(&comparison, &whole);
    for (int64_t part = call.first; part < call.last;) {
        int64_t top = part / across * LODE_PART_ROWS, left = part % across * LODE_PART_COLUMNS;
        int64_t parts = least(least(across - part % across, call.last - part),
                              kinds > 1 ? SIDE_BY_SIDE / MOST_KINDS : SIDE_BY_SIDE);
        int64_t bottom = least(top + LODE_PART_ROWS, call.rows),
                width = least(call.columns - left, parts * LODE_PART_COLUMNS);
        if (is_whole)
            whole_part_figures(&comparison, &whole, top, bottom, left, width, call.figures + 2 * part);
        else
            part_figures(&comparison, top, bottom, left, width, call.figures + 2 * kinds * part);
        part += parts;
    }
    return 0;
}
