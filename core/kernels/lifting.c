/* The optimal hierarchy as a lifting scheme on integers: one step along one axis, or its inverse, in place
 * (docs/format.md, section 8, "The forward step" and "the inverse step"; docs/mathematics.md, sections 7 and 8).
 *
 *     d_k = x_{2k+1} - floor((x_{2k} + x_{2k+2}) / 2)                        predict
 *     c_k = x_{2k} + floor(2^-24 sum_j h_j (d_{k+j} + d_{k-1-j}) + 3/8)      update
 *     e_k = d_k - floor((v_k + 128) / 256)                                   predict again, from c
 *     v_k = a (-c_{k+2} + c_{k+1} + c_k - c_{k-1}) + b (-c_{k+3} + c_{k+1} + c_k - c_{k-2})
 *
 * Lines are worked on in a bundle: one line, or STRIP columns that lie side by side. A bundle has two buffers, nodes
 * and details, in which neighbours along the axis stand `gap` apart: 1 or STRIP. The steps follow each other a chunk
 * behind, so that what one leaves is still in the nearest cache for the next.
 *
 * Sums are taken in 32 bits where their terms are so small that nothing can overflow, nearly always, and in 64
 * otherwise. Both are exact for samples within +-2^27 and coefficients below 2^29; beyond, all is modulo 2^32.
 */
#ifdef __AVX2__
#include <immintrin.h>
#endif
#include <stdbool.h>

#include "copying.h"
#include "lodestream.h"

#define LODE_INLINE static inline __attribute__((always_inline))

enum {
    REACH = 10,
    STRIP = LODE_LIFT_STRIP,
    NARROW = STRIP / 4, /* fewer columns are taken one by one */
    BEFORE = 2,         /* places for nodes before the first */
    AFTER = 3,          /* and after the last */
    ALIGNED = 16,       /* elements of a line of the cache */
    CHUNK = 2048,       /* nodes of a chunk, of all lines of a bundle */
    AT_ONCE = 1 << 21,  /* nodes of a call, of one bundle */
    AHEAD = 4,          /* rows of a strip that are asked for before they are wanted */
    LARGEST_POINT = 1 << 27,
    LARGEST_DETAIL = 1 << 28,
    /* What the taps over 2^24 give is computed with them as h_j = 2048 high_j + low_j: the magnitudes of the halves sum
     * to 2896 and 3500, so that neither weighted sum of details of at most 2^18 leaves int32. */
    SMALL = 1 << 18,
    BIAS = 3 << 21,
    MOST = CHUNK + 6 * REACH * STRIP, /* values of a chunk, the last one of a line being the longest, and around it */
};

static const int32_t TAPS[REACH] = {4913933, -843098, 144653, -24818, 4258, -731, 125, -21, 4, -1};

/* Lines that are stepped together. */
struct bundle {
    int32_t *x;     /* the first sample of the first line */
    int64_t along;  /* from one sample of a line to the next */
    int64_t width;  /* lines, side by side */
    int64_t gap;    /* from one sample of a line to the next in the buffers */
    int64_t length; /* samples of a line */
    int64_t midpoints, run;
    const int64_t *table; /* where details beyond the ends come from, and with which sign */
    int32_t a, b;
    int32_t *nodes, *details; /* where number 0 of each stands */
    bool bare;                /* all details are 0, whatever stands in their places */
    int32_t *room;            /* for MOST numbers, which a function leaves to nobody */
};

LODE_INLINE int32_t plus(int32_t a, int32_t b) {
    return (int32_t)((uint32_t)a + (uint32_t)b);
}

LODE_INLINE int32_t minus(int32_t a, int32_t b) {
    return (int32_t)((uint32_t)a - (uint32_t)b);
}

LODE_INLINE int32_t times(int32_t a, int32_t b) {
    return (int32_t)((uint32_t)a * (uint32_t)b);
}

LODE_INLINE int32_t within(int32_t value, int32_t limit) {
    return value < -limit ? -limit : value > limit ? limit : value;
}

LODE_INLINE int64_t least(int64_t a, int64_t b) {
    return a < b ? a : b;
}

static bool wraps(const struct bundle *w) {
    return w->run == w->midpoints;
}

static bool has_third_step(const struct bundle *w) {
    return w->run >= 3 && (w->a != 0 || w->b != 0);
}

/* Ask for a row of a strip that will be wanted soon: rows lie so far apart that the processor would not guess it. */
LODE_INLINE void ask(const struct bundle *w, int64_t sample) {
    if (w->gap > 1 && sample < w->length)
        for (int64_t j = 0; j < w->width; j += ALIGNED)
            __builtin_prefetch(w->x + sample * w->along + j);
}

/* Samples from `sample` on, one after the other, to the buffer or from it. */
static void move(const struct bundle *w, bool loads, int64_t sample, int32_t *buffer, int64_t count) {
    int32_t *x = w->x + sample * w->along;
    int64_t rows = w->along == 1 ? 1 : count, width = w->along == 1 ? count : w->width;
    for (int64_t k = 0; k < rows; k++) {
        int32_t *outside = x + k * w->along, *inside = buffer + k * w->gap;
        ask(w, sample + k + AHEAD);
        if (loads && width == STRIP) /* a call of memcpy takes as long as the copy */
            memcpy(inside, outside, STRIP * sizeof *x);
        else if (loads)
            memcpy(inside, outside, (size_t)width * sizeof *x);
        else
            memcpy(outside, inside, (size_t)width * sizeof *x);
    }
}

LODE_INLINE void split_line(const int32_t *restrict x, int64_t along, int32_t *restrict n, int32_t *restrict d,
                            int64_t count) {
    for (int64_t k = 0; k < count; k++) {
        n[k] = x[2 * k * along];
        d[k] = x[(2 * k + 1) * along];
    }
}

/* Samples to nodes `from` to `to` - 1 and the details between them. */
static void split(const struct bundle *w, int64_t from, int64_t to) {
    int64_t gap = w->gap;
    int32_t *n = w->nodes, *d = w->details;
    int64_t count = least(to, w->midpoints) - from;
    const int32_t *x = w->x + 2 * from * w->along;
    if (gap == 1 && w->along == 1) {
        split_line(x, 1, n + from, d + from, count);
    } else if (gap == 1) {
        split_line(x, w->along, n + from, d + from, count);
    } else {
        for (int64_t k = from; k < from + count; k++, x += 2 * w->along) {
            ask(w, 2 * k + 2 * AHEAD);
            ask(w, 2 * k + 2 * AHEAD + 1);
            memcpy(n + k * gap, x, (size_t)w->width * sizeof *x);
            memcpy(d + k * gap, x + w->along, (size_t)w->width * sizeof *x);
        }
    }
    if (from + count < to)
        move(w, true, 2 * (to - 1), n + (to - 1) * gap, 1);
}

/* Loops go over `spans` of `count` values, `gap` apart: one for a whole chunk, where buffers are filled. */
struct spans {
    int64_t spans, count;
};

LODE_INLINE struct spans spans_of(const struct bundle *w, int64_t from, int64_t to) {
    if (to <= from)
        return (struct spans){0, 0};
    return w->width == w->gap ? (struct spans){1, (to - from) * w->gap} : (struct spans){to - from, w->width};
}

LODE_INLINE void predict_at(int32_t *restrict details, const int32_t *restrict nodes, struct spans of, int64_t gap) {
    for (int64_t k = 0; k < of.spans; k++) {
        const int32_t *n = nodes + k * gap;
        int32_t *d = details + k * gap;
        for (int64_t i = 0; i < of.count; i++)
            d[i] = minus(d[i], plus(n[i], n[i + gap]) >> 1);
    }
}

/* Details `from` to `to` - 1, less the means of the nodes beside them. */
static void predict(const struct bundle *w, int64_t from, int64_t to) {
    struct spans of = spans_of(w, from, to);
    if (w->gap == 1)
        predict_at(w->details + from, w->nodes + from, of, 1);
    else
        predict_at(w->details + from * STRIP, w->nodes + from * STRIP, of, STRIP);
}

LODE_INLINE void join_line(int32_t *restrict x, int64_t along, int64_t next, const int32_t *restrict n,
                           const int32_t *restrict d, int64_t gap, int64_t count) {
    for (int64_t i = 0; i < count; i++) {
        int32_t mean = plus(n[i], n[i + gap]) >> 1;
        x[i * along] = within(n[i], LARGEST_POINT);
        x[i * along + next] = within(plus(d[i], mean), LARGEST_POINT);
    }
}

/* Undo the prediction of details `from` to `to` - 1: from there and the nodes before them to samples. */
static void join(const struct bundle *w, int64_t from, int64_t to) {
    int64_t gap = w->gap, count = to - from;
    const int32_t *n = w->nodes + from * gap, *d = w->details + from * gap;
    int32_t *x = w->x + 2 * from * w->along;
    if (gap == 1 && w->along == 1)
        join_line(x, 2, 1, n, d, 1, count);
    else if (gap == 1)
        join_line(x, 2 * w->along, w->along, n, d, 1, count);
    else
        for (int64_t k = 0; k < count; k++) {
            ask(w, 2 * (from + k) + AHEAD);
            ask(w, 2 * (from + k) + AHEAD + 1);
            join_line(x + 2 * k * w->along, 1, w->along, n + k * STRIP, d + k * STRIP, STRIP, w->width);
        }
}

/* Store a clamped sample. */
static void put(const struct bundle *w, int64_t sample, int32_t *buffer) {
    for (int64_t j = 0; j < w->width; j++)
        buffer[j] = within(buffer[j], LARGEST_POINT);
    move(w, false, sample, buffer, 1);
}

/* Something at least as large as the magnitude of every value, and less than twice the largest. */
LODE_INLINE int64_t magnitude(const int32_t *values, struct spans of, int64_t gap) {
    int32_t bits = 0;
    for (int64_t k = 0; k < of.spans; k++)
        for (int64_t i = k * gap; i < k * gap + of.count; i++)
            bits |= values[i] ^ (values[i] >> 31);
    return (int64_t)bits + 1;
}

LODE_INLINE void update_small(const int32_t *restrict details, int32_t *restrict nodes, struct spans of, int64_t gap,
                              bool inverse) {
    for (int64_t k = 0; k < of.spans; k++) {
        const int32_t *d = details + k * gap;
        int32_t *c = nodes + k * gap;
        for (int64_t i = 0; i < of.count; i++) {
            int32_t s0 = plus(d[i], d[i - gap]);
            int32_t s1 = plus(d[i + gap], d[i - 2 * gap]);
            int32_t s2 = plus(d[i + 2 * gap], d[i - 3 * gap]);
            int32_t s3 = plus(d[i + 3 * gap], d[i - 4 * gap]);
            int32_t s4 = plus(d[i + 4 * gap], d[i - 5 * gap]);
            int32_t s5 = plus(d[i + 5 * gap], d[i - 6 * gap]);
            int32_t s6 = plus(d[i + 6 * gap], d[i - 7 * gap]);
            int32_t s7 = plus(d[i + 7 * gap], d[i - 8 * gap]);
            int32_t s8 = plus(d[i + 8 * gap], d[i - 9 * gap]);
            int32_t s9 = plus(d[i + 9 * gap], d[i - 10 * gap]);
            int32_t high = plus(plus(times(2399, s0), times(-412, s1)), plus(times(71, s2), times(-12, s3)));
            int32_t low = plus(plus(times(781, s0), times(678, s1)), plus(times(-755, s2), times(-242, s3)));
            low = plus(low, plus(plus(times(162, s4), times(-731, s5)), plus(times(125, s6), times(-21, s7))));
            low = plus(low, minus(plus(times(4, s8), BIAS), s9));
            int32_t rise = plus(plus(high, plus(s4, s4)), low >> 11) >> 13;
            c[i] = inverse ? minus(c[i], rise) : plus(c[i], rise);
        }
    }
}

static void update_wide(const int32_t *restrict details, int32_t *restrict nodes, struct spans of, int64_t gap,
                        bool inverse) {
    for (int64_t k = 0; k < of.spans; k++) {
        const int32_t *d = details + k * gap;
        int32_t *c = nodes + k * gap;
        for (int64_t i = 0; i < of.count; i++) {
            int64_t sum = BIAS;
            for (int64_t j = 0; j < REACH; j++)
                sum += (int64_t)TAPS[j] * plus(d[i + j * gap], d[i - (1 + j) * gap]);
            int32_t rise = (int32_t)(uint32_t)((uint64_t)sum >> 24);
            c[i] = inverse ? minus(c[i], rise) : plus(c[i], rise);
        }
    }
}

#ifdef __AVX2__

/* Where details are below 2^14, sums of two of them, which have the same tap, fit 16 bits, and one operation multiplies
 * two such sums by their taps and adds the products. Half of the taps' magnitudes sum to at most 7596, so that no sum
 * leaves int32. */
enum {
    SHORT = 1 << 14,
    SHORTS = 16, /* of a register */
};

/* The taps of two neighbouring sums, as the low and the high halves of the coefficients. */
#define TAP_WORD(first, second) ((int32_t)((uint32_t)((first) & 0xFFFF) | (uint32_t)(second) << 16))

static const int32_t LOW_TAPS[REACH / 2] = {
    TAP_WORD(781, 678), TAP_WORD(-755, -242), TAP_WORD(4258, -731), TAP_WORD(125, -21), TAP_WORD(4, -1),
};
static const int32_t HIGH_TAPS[2] = {TAP_WORD(2399, -412), TAP_WORD(71, -12)};

/* Details in 16 bits; whether they all are so short. */
LODE_INLINE bool shorten(const int32_t *restrict details, int16_t *restrict shorts, int64_t count) {
    int32_t bits = 0;
    for (int64_t i = 0; i < count; i++) {
        bits |= details[i] ^ (details[i] >> 31);
        shorts[i] = (int16_t)details[i];
    }
    return bits < SHORT;
}

LODE_INLINE __m256i load_shorts(const int16_t *from) {
    return _mm256_loadu_si256((const __m256i *)(const void *)from);
}

LODE_INLINE __m256i times_taps(__m256i sums, int32_t taps) {
    return _mm256_madd_epi16(sums, _mm256_set1_epi32(taps));
}

LODE_INLINE __m256i rise_of(__m256i low, __m256i high) {
    return _mm256_srai_epi32(_mm256_add_epi32(high, _mm256_srai_epi32(low, 11)), 13);
}

LODE_INLINE void raise(int32_t *nodes, __m256i rise, bool inverse) {
    __m256i *place = (__m256i *)(void *)nodes, node = _mm256_loadu_si256(place);
    _mm256_storeu_si256(place, inverse ? _mm256_sub_epi32(node, rise) : _mm256_add_epi32(node, rise));
}

/* `update_small` of so many nodes that they fill whole registers; returns how many. */
LODE_INLINE int64_t update_shorts(const int16_t *d, int32_t *nodes, int64_t count, int64_t gap, bool inverse) {
    int64_t i = 0;
    for (; i + SHORTS <= count; i += SHORTS) {
        /* Neighbouring sums are brought together in halves of registers: of nodes 0 to 3 and 8 to 11, and the others.
         */
        __m256i low[2] = {_mm256_set1_epi32(BIAS), _mm256_set1_epi32(BIAS)}, high[2] = {{0}};
        for (int64_t j = 0; j < REACH; j += 2) {
            __m256i even = _mm256_add_epi16(load_shorts(d + i + j * gap), load_shorts(d + i - (j + 1) * gap));
            __m256i odd = _mm256_add_epi16(load_shorts(d + i + (j + 1) * gap), load_shorts(d + i - (j + 2) * gap));
            __m256i sums[2] = {_mm256_unpacklo_epi16(even, odd), _mm256_unpackhi_epi16(even, odd)};
            for (int k = 0; k < 2; k++) {
                low[k] = _mm256_add_epi32(low[k], times_taps(sums[k], LOW_TAPS[j / 2]));
                if (j < 4)
                    high[k] = _mm256_add_epi32(high[k], times_taps(sums[k], HIGH_TAPS[j / 2]));
            }
        }
        __m256i rises[2] = {rise_of(low[0], high[0]), rise_of(low[1], high[1])};
        raise(nodes + i, _mm256_permute2x128_si256(rises[0], rises[1], 0x20), inverse);
        raise(nodes + i + SHORTS / 2, _mm256_permute2x128_si256(rises[0], rises[1], 0x31), inverse);
    }
    return i;
}

/* `update_small` of nodes `from` to `to` - 1 of a chunk; whether their details were short enough. */
LODE_INLINE bool update_short(const struct bundle *w, int64_t from, int64_t to, int64_t gap, bool inverse) {
    int16_t *shorts = (int16_t *)(void *)w->room;
    int64_t lines = to - from, beyond = 2 * REACH - 1;
    struct spans all = spans_of(w, from, to + beyond), own = spans_of(w, from, to);
    const int32_t *d = w->details + (from - REACH) * gap;
    if (lines < 1)
        return false;
    for (int64_t k = 0; k < all.spans; k++)
        if (!shorten(d + k * gap, shorts + k * gap, all.count))
            return false;
    for (int64_t k = 0; k < own.spans; k++) {
        int32_t *c = w->nodes + (from + k) * gap;
        int64_t done = update_shorts(shorts + (REACH + k) * gap, c, own.count, gap, inverse);
        struct spans rest = {1, own.count - done};
        update_small(w->details + (from + k) * gap + done, c + done, rest, gap, inverse);
    }
    return true;
}

#else

LODE_INLINE bool update_short(const struct bundle *w, int64_t from, int64_t to, int64_t gap, bool inverse) {
    (void)w, (void)from, (void)to, (void)gap, (void)inverse;
    return false;
}

#endif

LODE_INLINE void update_at(const struct bundle *w, int64_t from, int64_t to, int64_t gap, bool inverse) {
    if (update_short(w, from, to, gap, inverse))
        return;
    const int32_t *d = w->details + from * gap;
    int32_t *c = w->nodes + from * gap;
    struct spans of = spans_of(w, from, to);
    if (magnitude(d - REACH * gap, spans_of(w, from - REACH, to + REACH - 1), gap) <= SMALL)
        update_small(d, c, of, gap, inverse);
    else
        update_wide(d, c, of, gap, inverse);
}

/* Add the update to nodes `from` to `to` - 1, or subtract it. */
static void update(const struct bundle *w, int64_t from, int64_t to, bool inverse) {
    if (w->gap == 1 && inverse)
        update_at(w, from, to, 1, true);
    else if (w->gap == 1)
        update_at(w, from, to, 1, false);
    else if (inverse)
        update_at(w, from, to, STRIP, true);
    else
        update_at(w, from, to, STRIP, false);
}

/* Fill the REACH places before the details, or those after them. */
static void extend(const struct bundle *w, bool after) {
    const int64_t *table = w->table + (after ? 2 * REACH : 0);
    int32_t *places = w->details + (after ? w->midpoints : -REACH) * w->gap;
    for (int64_t i = 0; i < REACH; i++) {
        const int32_t *from = w->details + table[2 * i] * w->gap;
        int32_t sign = (int32_t)table[2 * i + 1];
        if (w->gap == 1)
            places[i] = times(sign, *from);
        else
            for (int64_t j = 0; j < w->width; j++)
                places[i * STRIP + j] = times(sign, from[j]);
    }
}

/* A node that may lie up to two places beyond an end of the run, where nodes are extrapolated quadratically. */
LODE_INLINE int64_t node_at(const int32_t *n, int64_t k, int64_t run, int64_t gap) {
    int64_t inside = k < 0 ? 0 : k < run ? k : run - 1, beyond = k < 0 ? -k : k - inside;
    if (beyond == 0)
        return n[k * gap];
    int64_t inwards = k < 0 ? gap : -gap;
    const int32_t *at = n + inside * gap;
    int64_t first = at[0], second = at[inwards], third = at[2 * inwards];
    return beyond == 1 ? 3 * first - 3 * second + third : 6 * first - 8 * second + 3 * third;
}

/* Fill the places before the nodes, or those after them. */
static void surround(const struct bundle *w, bool after) {
    int64_t gap = w->gap, run = w->run;
    int32_t *n = w->nodes;
    if (!has_third_step(w))
        return;
    for (int64_t k = after ? run : -BEFORE; k < (after ? run + AFTER - !wraps(w) : 0); k++)
        for (int64_t j = 0; j < w->width; j++) {
            if (wraps(w))
                n[k * gap + j] = n[(after ? k - run : k + run) * gap + j];
            else
                n[k * gap + j] = (int32_t)(uint32_t)(uint64_t)node_at(n + j, k, run, gap);
        }
}

/* Rises from each of some nodes to the next one; something at least as large as their magnitudes and less than twice
 * the largest is returned. */
LODE_INLINE int64_t rise_between(const int32_t *restrict nodes, int32_t *restrict rises, struct spans of, int64_t gap) {
    int32_t bits = 0;
    for (int64_t k = 0; k < of.spans; k++)
        for (int64_t i = k * gap; i < k * gap + of.count; i++) {
            int32_t rise = minus(nodes[i + gap], nodes[i]);
            rises[i] = rise;
            bits |= rise ^ (rise >> 31);
        }
    return (int64_t)bits + 1;
}

LODE_INLINE void surplus_small(const int32_t *restrict rises, int32_t *restrict details, struct spans of, int64_t gap,
                               int32_t a, int32_t b, bool inverse) {
    for (int64_t k = 0; k < of.spans; k++) {
        const int32_t *r = rises + k * gap;
        int32_t *d = details + k * gap;
        for (int64_t i = 0; i < of.count; i++) {
            int32_t inner = minus(r[i - gap], r[i + gap]), outer = minus(r[i - 2 * gap], r[i + 2 * gap]);
            int32_t rise = plus(plus(times(a + b, inner), times(b, outer)), 128) >> 8;
            d[i] = inverse ? within(plus(d[i], rise), LARGEST_DETAIL) : minus(d[i], rise);
        }
    }
}

/* Where inner and outer sums fit int32, as they do inside the run, but v does not. */
LODE_INLINE void surplus_wide(const int32_t *restrict nodes, int32_t *restrict details, struct spans of, int64_t gap,
                              int32_t a, int32_t b, bool inverse) {
    for (int64_t k = 0; k < of.spans; k++) {
        const int32_t *n = nodes + k * gap;
        int32_t *d = details + k * gap;
        for (int64_t i = 0; i < of.count; i++) {
            int32_t near = plus(n[i], n[i + gap]);
            int32_t inner = minus(near, plus(n[i - gap], n[i + 2 * gap]));
            int32_t outer = minus(near, plus(n[i - 2 * gap], n[i + 3 * gap]));
            int64_t v = (int64_t)a * inner + (int64_t)b * outer + 128;
            int32_t rise = (int32_t)(uint32_t)((uint64_t)v >> 8); /* |a| + |b| < 256 */
            d[i] =
                inverse ? within(plus(d[i], within(rise, 4 * LARGEST_DETAIL - 1)), LARGEST_DETAIL) : minus(d[i], rise);
        }
    }
}

/* Details `from` to `to` - 1, where nodes beyond the ends are so far out that they do not fit int32. */
static void surplus_outside(const struct bundle *w, int64_t from, int64_t to, bool inverse) {
    int64_t a = w->a, b = w->b, limit = inverse ? LARGEST_DETAIL : INT32_MAX;
    for (int64_t k = from; k < to; k++)
        for (int64_t j = 0; j < w->width; j++) {
            int64_t c[BEFORE + 1 + AFTER];
            for (int64_t i = 0; i < BEFORE + 1 + AFTER; i++)
                c[i] = node_at(w->nodes + j, k - BEFORE + i, w->run, w->gap);
            int64_t near = c[2] + c[3], rise = (a * (near - c[1] - c[4]) + b * (near - c[0] - c[5]) + 128) >> 8;
            int32_t *d = w->details + k * w->gap + j;
            int64_t value = inverse ? *d + rise : *d - rise;
            *d = (int32_t)(value < -limit ? -limit : value > limit ? limit : value);
        }
}

LODE_INLINE void surplus_at(const struct bundle *w, int64_t from, int64_t to, int64_t gap, bool inverse) {
    const int32_t *n = w->nodes + from * gap;
    int32_t *d = w->details + from * gap;
    struct spans rises = spans_of(w, from - BEFORE, to + AFTER - 1);
    /* Sums modulo 2^32 are right where v fits int32: two rises make up an inner sum, four an outer. A rise beyond an
     * end is at most five times as large as those inside, so that none has left int32 where all are below 2^28. */
    int64_t weight = 2 * (w->a < 0 ? -w->a : w->a) + 4 * (w->b < 0 ? -w->b : w->b);
    if (rise_between(n - BEFORE * gap, w->room, rises, gap) * (weight < 8 ? 8 : weight) < INT32_MAX - 127) {
        surplus_small(w->room + BEFORE * gap, d, spans_of(w, from, to), gap, w->a, w->b, inverse);
        return;
    }
    int64_t inner = from, outer = to;
    if (!wraps(w)) {
        inner = least(from < BEFORE ? BEFORE : from, to);
        outer = least(to, w->run - AFTER) < inner ? inner : least(to, w->run - AFTER);
        surplus_outside(w, from, inner, inverse);
        surplus_outside(w, outer, to, inverse);
    }
    int64_t ahead = (inner - from) * gap;
    surplus_wide(n + ahead, d + ahead, spans_of(w, inner, outer), gap, w->a, w->b, inverse);
}

/* Subtract from details `from` to `to` - 1 what the third step predicts, or add it and clamp them. */
static void surplus(const struct bundle *w, int64_t from, int64_t to, bool inverse) {
    if (to <= from || !has_third_step(w))
        return;
    if (w->gap == 1 && inverse)
        surplus_at(w, from, to, 1, true);
    else if (w->gap == 1)
        surplus_at(w, from, to, 1, false);
    else if (inverse)
        surplus_at(w, from, to, STRIP, true);
    else
        surplus_at(w, from, to, STRIP, false);
}

/* The step, for nodes `from` to `to` - 1 and what they complete. */
static void forward_chunk(const struct bundle *w, int64_t from, int64_t to) {
    int64_t gap = w->gap, run = w->run, midpoints = w->midpoints;
    bool first = from == 0, last = to == run, closed = wraps(w);
    split(w, from, to);
    if (first && closed)
        move(w, true, 0, w->nodes + run * gap, 1);
    if (first && closed && !last) {
        /* The details before the first are the last ones, computed ahead of their turn. */
        split(w, run - REACH, run);
        predict(w, run - REACH, run);
    }
    int64_t predicted = last ? midpoints : to - 1, updated = last ? run : predicted - (REACH - 1);
    predict(w, first ? 0 : from - 1, predicted);
    if (first)
        extend(w, false);
    if (closed ? first : last)
        extend(w, true);
    int64_t begun = first ? 0 : from - REACH;
    update(w, begun, updated, false);
    move(w, false, begun, w->nodes + begun * gap, updated - begun);
    /* The third step waits until no update looks at the details, and until the nodes around are known. */
    if (first && !closed)
        surround(w, false);
    if (last)
        surround(w, true);
    int64_t ahead = closed ? least(BEFORE, midpoints) : 0;
    surplus(w, first ? ahead : begun - REACH, last ? midpoints : updated - REACH, false);
    if (last && closed) {
        surround(w, false);
        surplus(w, 0, ahead, false);
    }
}

/* Details `from` to `to` - 1 into the buffer. */
static void load_details(const struct bundle *w, int64_t from, int64_t to) {
    if (w->bare && to > from)
        memset(w->details + from * w->gap, 0, (size_t)((to - from) * w->gap) * sizeof *w->details);
    else
        move(w, true, w->length - w->midpoints + from, w->details + from * w->gap, to - from);
}

/* The step undone, for details `from` to `to` - 1 and what they complete; all nodes have been loaded. */
static void inverse_chunk(const struct bundle *w, int64_t from, int64_t to) {
    int64_t gap = w->gap, run = w->run, midpoints = w->midpoints;
    bool first = from == 0, last = to == run, closed = wraps(w);
    int64_t predicted = last ? midpoints : to, updated = last ? run : to - (REACH - 1);
    load_details(w, from, predicted);
    surplus(w, from, predicted, true);
    if (first && closed && !last) {
        load_details(w, midpoints - REACH, midpoints);
        surplus(w, midpoints - REACH, midpoints, true);
    }
    if (first)
        extend(w, false);
    if (closed ? first : last)
        extend(w, true);
    update(w, first ? 0 : from - (REACH - 1), updated, true);
    if (last && closed)
        memcpy(w->nodes + run * gap, w->nodes, (size_t)w->width * sizeof *w->nodes);
    join(w, first ? 0 : from - REACH, last ? midpoints : updated - 1);
}

/* The step of a bundle or its inverse, for nodes from `from` to about `end`; returns where the next ones begin. */
static int64_t lift(const struct bundle *w, bool inverse, int64_t from, int64_t end) {
    int64_t gap = w->gap, run = w->run, coarse = w->length - w->midpoints;
    int32_t *single = w->nodes + (run + 2) * gap; /* nothing else stands there where there is such a sample */
    if (inverse && from == 0) {
        move(w, true, 0, w->nodes, run);
        surround(w, false);
        surround(w, true);
        if (run < coarse)
            move(w, true, run, single, 1);
    }
    while (from < run && from < end) {
        int64_t to = run - from < CHUNK / gap + 2 * REACH ? run : from + CHUNK / gap;
        if (inverse)
            inverse_chunk(w, from, to);
        else
            forward_chunk(w, from, to);
        from = to;
    }
    if (from < run)
        return from;
    if (inverse) {
        if (run > w->midpoints)
            put(w, 2 * w->midpoints, w->nodes + w->midpoints * gap);
        if (run < coarse)
            put(w, w->length - 1, single);
    } else {
        if (run < coarse)
            move(w, true, w->length - 1, single, 1);
        move(w, false, coarse, w->details, w->midpoints);
        if (run < coarse)
            move(w, false, run, single, 1);
    }
    return run;
}

/* Whether a row holds zeros only. */
static bool nothing(const int32_t *row, int64_t columns) {
    int32_t found = row[0];
    for (int64_t i = 0; found == 0 && i < columns; i += ALIGNED)
        for (int64_t j = i; j < least(i + ALIGNED, columns); j++)
            found |= row[j];
    return found == 0;
}

int64_t lode_lift(int64_t inverse, int64_t axis, const struct lode_lift *arguments) {
    const struct lode_lift call = *arguments;
    bool along_rows = axis == 1;
    int64_t length = along_rows ? call.columns : call.rows, across = along_rows ? call.rows : call.columns;
    int64_t gap = along_rows || across < NARROW ? 1 : STRIP;
    if (call.rows < 1 || call.columns < 1 || length > INT32_MAX || (call.rows > 1 && call.pitch < call.columns) ||
        call.midpoints < 1 || call.midpoints > length || call.run < call.midpoints || call.run > call.midpoints + 1)
        return LODE_REFUSED;
    int64_t places = call.run + BEFORE + AFTER + call.midpoints + 2 * REACH, coarse = length - call.midpoints;
    if (call.run > coarse || coarse > call.run + 1 || (call.run == call.midpoints && call.run != coarse) ||
        call.table_count != 4 * REACH || call.a < -127 || call.a > 127 || call.b < -127 || call.b > 127 ||
        call.from < 0 || call.from >= call.run || call.from % (CHUNK / gap) || (call.from > 0 && across > gap) ||
        call.work_count < places * gap + ALIGNED)
        return LODE_REFUSED;
    for (int64_t i = 0; i < 4 * REACH; i += 2)
        if (call.table[i] < 0 || call.table[i] >= call.midpoints || call.table[i + 1] < -1 || call.table[i + 1] > 1)
            return LODE_REFUSED;
    int64_t shift = (int64_t)(-(uintptr_t)call.work / sizeof *call.work % ALIGNED);
    int32_t *nodes = call.work + shift + BEFORE * gap;
    _Alignas(64) int32_t room[MOST];
    struct bundle w = {
        .along = along_rows ? 1 : call.pitch, .length = length, .midpoints = call.midpoints, .run = call.run};
    w.room = room, w.bare = inverse == LODE_LIFT_BARE, w.table = call.table, w.a = (int32_t)call.a,
    w.b = (int32_t)call.b;
    w.nodes = nodes, w.details = nodes + (call.run + AFTER + REACH) * gap;
    int64_t end = across > gap ? call.run : call.from + AT_ONCE / gap, reached = call.run;
    for (int64_t i = 0; i < across; i += w.width) {
        w.x = call.x + (along_rows ? i * call.pitch : i);
        w.gap = across - i < NARROW ? 1 : gap;
        w.width = least(w.gap, across - i);
        if (!along_rows || call.from > 0 || !nothing(w.x, call.columns))
            reached = lift(&w, inverse, call.from, end);
    }
    return reached;
}
