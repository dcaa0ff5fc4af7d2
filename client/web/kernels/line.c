/* What the Python library leaves to numpy in restoring chunks of the residual (docs/format.md, sections 9.1 and 9.3):
 * values as places on a line of whole numbers and back, and the bases that offsets are counted from. Integers of 64
 * bits are slow in JavaScript.
 *
 * Types are the numbers that containers have for them. Counts are of values; places overflow modulo 2^64.
 */

#include "reading.h"

enum { INT8, INT16, INT32, INT64, UINT8, UINT16, UINT32, UINT64, FLOAT32, FLOAT64 };
enum { DECIMALS = 2 };

static const double POWERS[16] = {1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15};
static const double LARGEST_WHOLE = 0x1p53;

static int64_t integer_at(const void *values, int32_t type, int32_t i) {
    switch (type) {
    case INT8:
        return ((const int8_t *)values)[i];
    case INT16:
        return ((const int16_t *)values)[i];
    case INT32:
        return ((const int32_t *)values)[i];
    case UINT8:
        return ((const uint8_t *)values)[i];
    case UINT16:
        return ((const uint16_t *)values)[i];
    case UINT32:
        return ((const uint32_t *)values)[i];
    default:
        return ((const int64_t *)values)[i];
    }
}

static void put_integer(void *values, int32_t type, int32_t i, uint64_t value) {
    switch (type) {
    case INT8:
    case UINT8:
        ((uint8_t *)values)[i] = (uint8_t)value;
        break;
    case INT16:
    case UINT16:
        ((uint16_t *)values)[i] = (uint16_t)value;
        break;
    case INT32:
    case UINT32:
    case FLOAT32:
        ((uint32_t *)values)[i] = (uint32_t)value;
        break;
    default:
        ((uint64_t *)values)[i] = value;
    }
}

static int64_t decimal_place(double value, int32_t places) {
    double wide = value * POWERS[places];
    wide = wide > LARGEST_WHOLE ? LARGEST_WHOLE : wide < -LARGEST_WHOLE ? -LARGEST_WHOLE : wide;
    return (int64_t)__builtin_rint(wide);
}

/* Places and exponents of finite values, by a rule of section 9 (1: patterns, 2: decimals) and its argument. */
EXPORTED(to_line)
void to_line(int32_t rule, int32_t argument, const void *values, int32_t type, int32_t count, int64_t *line,
             int32_t *exponents) {
    for (int32_t i = 0; i < count; i++) {
        exponents[i] = 0;
        if (rule == DECIMALS) {
            double value = type == FLOAT32 ? (double)((const float *)values)[i] : ((const double *)values)[i];
            line[i] = decimal_place(value, argument);
        } else if (type < FLOAT32) {
            line[i] = integer_at(values, type, i) >> argument;
        } else if (type == FLOAT32) {
            int32_t pattern = ((const int32_t *)values)[i];
            int64_t magnitude = pattern & INT32_MAX;
            exponents[i] = (int32_t)(magnitude >> 23);
            line[i] = pattern < 0 ? ~(magnitude >> argument) : magnitude >> argument;
        } else {
            int64_t pattern = ((const int64_t *)values)[i], magnitude = pattern & INT64_MAX;
            exponents[i] = (int32_t)(magnitude >> 52);
            line[i] = pattern < 0 ? ~(magnitude >> argument) : magnitude >> argument;
        }
    }
}

/* Values at places and differences together. */
EXPORTED(from_line)
void from_line(int32_t rule, int32_t argument, const int64_t *line, const int64_t *differences, void *values,
               int32_t type, int32_t count) {
    for (int32_t i = 0; i < count; i++) {
        int64_t place = (int64_t)((uint64_t)line[i] + (uint64_t)differences[i]);
        if (rule == DECIMALS) {
            int64_t most = INT64_C(1) << 53;
            double value = (double)(place > most ? most : place < -most ? -most : place) / POWERS[argument];
            if (type == FLOAT32) {
                ((float *)values)[i] = (float)value;
            } else {
                ((double *)values)[i] = value;
            }
        } else if (type < FLOAT32) {
            put_integer(values, type, i, (uint64_t)place << argument);
        } else {
            uint64_t pattern = (uint64_t)(place < 0 ? ~place : place) << argument;
            uint64_t sign = type == FLOAT32 ? UINT64_C(1) << 31 : UINT64_C(1) << 63;
            put_integer(values, type, i, place < 0 ? pattern | sign : pattern);
        }
    }
}

/* Where offsets are counted from: values rounded to whole multiples of a step, and the places of the values. */
EXPORTED(offset_bases)
void offset_bases(const float *values, int32_t count, double step, double *bases, int64_t *places) {
    for (int32_t i = 0; i < count; i++) {
        int32_t pattern = ((const int32_t *)values)[i];
        places[i] = pattern < 0 ? ~(int64_t)(pattern & INT32_MAX) : pattern;
        bases[i] = __builtin_rint((double)values[i] / step) * step;
    }
}

/* The float32 values at places, as patterns. */
EXPORTED(offset_values)
void offset_values(const int64_t *places, int32_t count, uint32_t *patterns) {
    for (int32_t i = 0; i < count; i++) {
        int64_t place = places[i] < INT32_MIN ? INT32_MIN : places[i] > INT32_MAX ? INT32_MAX : places[i];
        patterns[i] = place < 0 ? (uint32_t)~place | UINT32_C(1) << 31 : (uint32_t)place;
    }
}
