/* Squared distances between integers of at most 16 bits and values of a lattice of whole numbers, in integers.
 *
 * A value is origin + step q / 2^shift, rounded to the nearest, halves to even, and within the range of the type. All
 * sums are exact, so they are those that float64 gives, in less time.
 */
#ifndef LODE_WHOLE_DISTANCES_H
#define LODE_WHOLE_DISTANCES_H

#include <stdbool.h>
#include <stdint.h>

enum { MOST_SHIFT = 8, MOST_STEP = 1 << 20, MOST_ORIGIN = 1 << 20 };

struct whole_rule {
    int32_t step, origin;  /* in units of 1 / 2^shift; */
    int32_t first, last;   /* coordinates below and above which values lie outside the type; */
    int32_t low, high;     /* its least and largest value */
    int32_t below, parity; /* halves are rounded up or down by these */
    int shift;
};

static inline bool is_whole_number(double number, double most) {
    return number >= -most && number <= most && (double)(int32_t)number == number;
}

/* The rule origin + step scale q, of a type whose values lie from `low` to `high`; whether it is one of whole numbers.
 */
static inline bool whole_rule_of(double origin, double step, double scale, double low, double high,
                                 struct whole_rule *rule) {
    int shift = 0;
    for (double unit = 1.0; unit != scale && shift <= MOST_SHIFT; unit *= 0.5)
        shift++;
    if (shift > MOST_SHIFT || !is_whole_number(step, MOST_STEP) || !is_whole_number(origin, MOST_ORIGIN) || step < 1 ||
        low < INT16_MIN || high > UINT16_MAX)
        return false;
    int64_t unit = INT64_C(1) << shift, middle = (int64_t)origin * unit;
    /* Half a million beyond the type at most: nothing leaves int32. */
    int64_t first = (((int64_t)low - 1) * unit - middle) / (int64_t)step - 1;
    int64_t last = (((int64_t)high + 1) * unit - middle) / (int64_t)step + 1;
    *rule = (struct whole_rule){
        .step = (int32_t)step,
        .origin = (int32_t)middle,
        .first = (int32_t)first,
        .last = (int32_t)last,
        .low = (int32_t)low,
        .high = (int32_t)high,
        .below = shift ? (1 << (shift - 1)) - 1 : 0,
        .parity = shift ? 1 : 0,
        .shift = shift,
    };
    return true;
}

struct whole_figures {
    uint64_t sum;
    uint32_t worst;
};

/* Sums of the squares of `count` points, into `total`, of any type. */
#define ADD_POINTS(total, counts)                                                                                      \
    for (int64_t j = 0; j < count; j++) {                                                                              \
        int32_t q = coordinates[j] < r.first ? r.first : coordinates[j] > r.last ? r.last : coordinates[j];            \
        int32_t units = q * r.step + r.origin;                                                                         \
        int32_t value = (units + r.below + ((units >> r.shift) & r.parity)) >> r.shift;                                \
        value = value < r.low ? r.low : value > r.high ? r.high : value;                                               \
        uint32_t delta = (uint32_t)(points[j] - value), square = (counts) ? delta * delta : 0;                         \
        total += square;                                                                                               \
        worst = square > worst ? square : worst;                                                                       \
    }

/* 32 bits take less time and hold the sum of most rows. */
#define WHOLE_ROW(type)                                                                                                \
    static void add_row_##type(const int32_t *restrict coordinates, const type##_t *restrict points,                   \
                               const uint8_t *restrict counted, int64_t count, const struct whole_rule *rule,          \
                               struct whole_figures *figures) {                                                        \
        struct whole_rule r = *rule;                                                                                   \
        uint64_t sum = 0;                                                                                              \
        uint32_t brief = 0, worst = 0;                                                                                 \
        if (counted)                                                                                                   \
            ADD_POINTS(sum, counted[j] != 0)                                                                           \
        else {                                                                                                         \
            ADD_POINTS(brief, true)                                                                                    \
            if (worst <= UINT32_MAX / (uint64_t)count)                                                                 \
                sum = brief;                                                                                           \
            else                                                                                                       \
                ADD_POINTS(sum, true)                                                                                  \
        }                                                                                                              \
        figures->sum += sum;                                                                                           \
        figures->worst = worst > figures->worst ? worst : figures->worst;                                              \
    }

WHOLE_ROW(int8)
WHOLE_ROW(int16)
WHOLE_ROW(uint8)
WHOLE_ROW(uint16)

#undef WHOLE_ROW
#undef ADD_POINTS

#endif
