/* Coefficients from what is known of their bits, for the inverse transform (docs/format.md, section 8, and 8.1 for
 * indices of a quantiser).
 *
 * When n passes of a tile remain, the planes below p = (n + 1) >> 1 are unknown; if n is odd, the first pass of plane
 * p - 1 is known. Unknown bits of a significant coefficient are replaced by a point below the middle of what they may
 * be.
 */
#include <stdbool.h>

#include "band_fields.h"
#include "lodestream.h"
#include "trellis.h"

#define LODE_INLINE static inline __attribute__((always_inline))

enum {
    BLOCK = 8,
    FRACTION_BITS = 3,
    LARGEST = 1 << 28, /* magnitude of a coefficient */
    WIDEST_STEP = 1 << 26,
    ORIGIN_FIELDS = 3, /* tile, first row, first column */
};

/* How the magnitudes of a band become coefficients when some passes remain. Products stay below 2^31: what would lead
 * beyond the largest coefficient is cut off before it is multiplied. */
struct rule {
    int32_t mask;  /* of the bits that are known of a magnitude */
    int32_t most;  /* the largest known part that matters */
    int32_t step;  /* of the quantiser */
    int32_t above; /* added to the known part, if it is not 0, times the step */
    bool half;     /* the first pass of one plane more is known: */
    uint8_t mark;  /* coefficients coded there have this mark, */
    int begun;     /* are significant if bits from this plane on are not 0, */
    int32_t found; /* and then have this magnitude */
    int32_t limit; /* for magnitudes, before they are multiplied by the unit */
    int32_t unit;
};

/* A band where it is known, and where its rows from `first` to `last` - 1 go, of these the columns from `begin` to
 * `end` - 1. */
struct places {
    const int32_t *magnitudes;
    const int8_t *signs;
    const uint8_t *early;
    int64_t stride;
    int32_t *out; /* of row `first` and column `begin` */
    int64_t pitch;
    int64_t first, last, begin, end;
};

LODE_INLINE int32_t plus(int32_t a, int32_t b) {
    return (int32_t)((uint32_t)a + (uint32_t)b);
}

LODE_INLINE int32_t times(int32_t a, int32_t b) {
    return (int32_t)((uint32_t)a * (uint32_t)b);
}

LODE_INLINE int32_t least(int32_t a, int32_t b) {
    return a < b ? a : b;
}

/* A magnitude from its index in sixteenths. */
static int32_t from_sixteenths(int64_t sixteenths, int64_t step) {
    int64_t magnitude = sixteenths * step >> 4;
    return magnitude < LARGEST ? (int32_t)magnitude : LARGEST;
}

/* Bits that are unknown are replaced so that a magnitude lies below the middle of what is possible; `step` 0 is that of
 * no quantiser. */
LODE_INLINE struct rule rule_of(int remaining, int64_t step, bool finer) {
    int begun = remaining >> 1, plane = begun + (remaining & 1);
    int64_t unknown = INT64_C(1) << plane, unit = INT64_C(1) << begun;
    struct rule rule = {
        .mask = (int32_t)-unknown,
        .most = step == 0 ? LARGEST : LARGEST / (int32_t)step + 2,
        .step = step == 0 ? 1 : (int32_t)step,
        .half = plane != begun,
        .mark = (uint8_t)(begun + 1),
        .begun = begun,
        .limit = finer ? LARGEST >> FRACTION_BITS : LARGEST,
        .unit = finer ? 1 << FRACTION_BITS : 1,
    };
    if (step == 0) {
        rule.above = (int32_t)(7 * unknown >> 4);
        rule.found = (int32_t)(unit + (7 * unit >> 4));
    } else if (remaining > 0) {
        rule.above = from_sixteenths(7 * (unknown - 1) - 4, step);
        rule.found = from_sixteenths(16 * unit + 7 * (unit - 1) - 4, step);
    }
    return rule;
}

LODE_INLINE void spread_row(const int32_t *restrict magnitudes, const int8_t *restrict signs,
                            const uint8_t *restrict early, int32_t *restrict out, int64_t count, struct rule rule,
                            bool half, bool stepped) {
    for (int64_t j = 0; j < count; j++) {
        int32_t magnitude = magnitudes[j], high = magnitude & rule.mask;
        int32_t above = plus(stepped ? times(least(high, rule.most), rule.step) : high, rule.above);
        int32_t below = half && early[j] == rule.mark ? magnitude >> rule.begun : 0; /* 1 or 0 where high is 0 */
        int32_t value = least(high != 0 ? above : -below & rule.found, rule.limit);
        out[j] = times(times(signs[j], value), rule.unit);
    }
}

LODE_INLINE void spread_band(struct places at, struct rule rule) {
    for (int64_t i = at.first; i < at.last; i++, at.out += at.pitch) {
        int64_t place = i * at.stride + at.begin, count = at.end - at.begin;
        const int32_t *magnitudes = at.magnitudes + place;
        const int8_t *signs = at.signs + place;
        const uint8_t *early = at.early + place;
        if (rule.half && rule.step > 1)
            spread_row(magnitudes, signs, early, at.out, count, rule, true, true);
        else if (rule.half)
            spread_row(magnitudes, signs, early, at.out, count, rule, true, false);
        else if (rule.step > 1)
            spread_row(magnitudes, signs, early, at.out, count, rule, false, true);
        else
            spread_row(magnitudes, signs, early, at.out, count, rule, false, false);
    }
}

/* Which of a band's rows or columns, `length` of them, lie among the `count` of a plane: the band's first one has the
 * number `start` there. Whether any does. */
static bool part_of(int64_t length, int64_t start, int64_t count, int64_t *first, int64_t *last) {
    *first = start < 0 ? -start : 0;
    *last = length < count - start ? length : count - start;
    return *first < *last;
}

/* A band of indices that are known: the trellis follows them in raster order of blocks, as they were coded. */
LODE_INLINE void spread_trellis(struct places at, int64_t rows, int64_t columns, struct rule rule) {
    int32_t less = (rule.step + 1) / 2;
    for (int64_t top = at.first / BLOCK * BLOCK; top < at.last; top += BLOCK) {
        unsigned state = 0;
        for (int64_t left = 0; left < columns; left += BLOCK)
            for (int64_t i = top; i < top + BLOCK && i < rows; i++)
                for (int64_t j = left; j < left + BLOCK && j < columns; j++) {
                    int32_t magnitude = at.magnitudes[i * at.stride + j];
                    int32_t value = plus(times(least(magnitude, rule.most), rule.step), -less * ODD[state]);
                    value = least(magnitude != 0 ? value : 0, rule.limit);
                    state = TRANSITIONS[state][magnitude & 1];
                    if (i >= at.first && i < at.last && j >= at.begin && j < at.end)
                        at.out[(i - at.first) * at.pitch + j - at.begin] =
                            times(times(at.signs[i * at.stride + j], value), rule.unit);
                }
    }
}

static void clear(struct places at) {
    for (int64_t i = at.first; i < at.last; i++, at.out += at.pitch)
        for (int64_t j = 0; j < at.end - at.begin; j++)
            at.out[j] = 0;
}

int64_t lode_spread(const struct lode_spread *arguments) {
    const struct lode_spread call = *arguments;
    if (call.sign_count != call.known_count || call.early_count != call.known_count ||
        call.bands_count != call.steps_count * BAND_FIELDS || call.origins_count != call.steps_count * ORIGIN_FIELDS ||
        (call.rows > 1 && call.pitch < call.columns) || call.first_row < 0 || call.first_row > INT32_MAX ||
        call.first_column < 0 || call.first_column > INT32_MAX)
        return LODE_REFUSED;
    for (int64_t i = 0; i < call.numbers_count; i++) {
        if (call.numbers[i] < 0 || call.numbers[i] >= call.steps_count)
            return LODE_REFUSED;
        const int64_t *band = call.bands + call.numbers[i] * BAND_FIELDS,
                      *origin = call.origins + call.numbers[i] * ORIGIN_FIELDS;
        int64_t offset = band[BAND_OFFSET], stride = band[BAND_STRIDE], step = call.steps[call.numbers[i]],
                tile = origin[0];
        int64_t height = band[BAND_ROWS], width = band[BAND_COLUMNS];
        if (origin[1] < 0 || origin[1] > INT32_MAX || origin[2] < 0 || origin[2] > INT32_MAX || height < 0 ||
            width < 0 || height > INT32_MAX || stride < width || stride < 1 || stride > INT32_MAX || offset < 0 ||
            offset > call.known_count - width || (height - 1) * stride > call.known_count - width - offset ||
            tile < 0 || tile >= call.state_count || call.state[tile] < 0 || step < 0 || step >= WIDEST_STEP)
            return LODE_REFUSED;
        int64_t top = origin[1] - call.first_row, left = origin[2] - call.first_column, first, last, begin, end;
        if (!part_of(height, top, call.rows, &first, &last) || !part_of(width, left, call.columns, &begin, &end))
            continue;
        struct places at = {
            .magnitudes = call.known + offset,
            .signs = call.sign + offset,
            .early = call.early + offset,
            .stride = stride,
            .out = call.out + (top + first) * call.pitch + left + begin,
            .pitch = call.pitch,
            .first = first,
            .last = last,
            .begin = begin,
            .end = end,
        };
        if (call.state[tile] >= LODE_UNANNOUNCED)
            clear(at);
        else if (step > 0 && call.state[tile] == 0)
            spread_trellis(at, height, width, rule_of(0, step, tile >= call.finer));
        else
            spread_band(at, rule_of(call.state[tile], step, tile >= call.finer));
    }
    return 0;
}
