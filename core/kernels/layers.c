/* Which coding passes are worth their bits: see core/lodestream/encoding/allocation.py. */

#include "lodestream.h"

enum { MOST_PASSES = 64 };

/* Passes that come together. */
struct run {
    double bits, gain;
    int64_t passes;
};

/* What two runs must save to be two, by the slope of the first. */
struct worth {
    const double *falling, *known;
    int64_t count;
    double share, most;
};

static double worth_of(const struct worth *worth, double slope) {
    if (worth->count == 0)
        return 0.0;
    int64_t low = 0, high = worth->count;
    while (low < high) {
        int64_t middle = low + (high - low) / 2;
        if (worth->falling[middle] < -slope)
            low = middle + 1;
        else
            high = middle;
    }
    double own = worth->share * worth->known[low < worth->count ? low : worth->count - 1];
    return own < worth->most ? own : worth->most;
}

/* Whether the places of a curve lie in its arrays, and its passes are not too many. */
static int fits(const int64_t *ends, int64_t number, int64_t passes) {
    int64_t start = number ? ends[number - 1] : 0, end = ends[number];
    return start >= 0 && start <= end && end <= passes && end - start <= MOST_PASSES;
}

static void slopes_of(const double *bits, const double *gains, int64_t count, const struct worth *worth, double share,
                      double *slopes) {
    struct run runs[MOST_PASSES];
    int64_t length = 0;
    double known = 0.0;
    for (int64_t pass = count - 1; pass >= 0; pass--) {
        struct run run = {bits[pass] > 1e-9 ? bits[pass] : 1e-9, gains[pass] > 0.0 ? gains[pass] : 0.0, 1};
        known += run.bits;
        while (length > 0) {
            const struct run *last = runs + length - 1;
            double saved = last->gain * run.bits - run.gain * last->bits;
            if (saved > 0.0) {
                double least = worth_of(worth, last->gain / last->bits), of_tile = share * known;
                if (saved >= (of_tile > least ? of_tile : least) * (last->gain + run.gain))
                    break;
            }
            run.bits += last->bits;
            run.gain += last->gain;
            run.passes += last->passes;
            length--;
        }
        runs[length++] = run;
    }
    int64_t pass = count;
    for (int64_t number = 0; number < length; number++) {
        double slope = runs[number].gain / runs[number].bits;
        for (int64_t end = pass - runs[number].passes; pass > end;)
            slopes[--pass] = slope;
    }
}

int64_t lode_pass_slopes(const struct lode_pass_slopes *arguments) {
    const struct lode_pass_slopes call = *arguments;
    if (call.gains_count != call.bits_count || call.slopes_count != call.bits_count ||
        call.known_count != call.falling_count || call.first < 0 || call.last > call.ends_count)
        return LODE_REFUSED;
    struct worth worth = {call.falling, call.known, call.falling_count, call.share_of_stream, call.segment};
    for (int64_t number = call.first; number < call.last; number++) {
        if (!fits(call.ends, number, call.bits_count))
            return LODE_REFUSED;
        int64_t start = number ? call.ends[number - 1] : 0;
        slopes_of(call.bits + start, call.gains + start, call.ends[number] - start, &worth, call.share_of_tile,
                  call.slopes + start);
    }
    return 0;
}

static double larger(double a, double b) {
    return b > a ? b : a;
}

static void lift(double *parent, int64_t above, const double *own, int64_t count) {
    double most = 0.0;
    for (int64_t pass = 0; pass < count; pass++)
        most = larger(most, own[pass]);
    /* A plane's passes have the numbers 2 p + 1 and 2 p: the parent's second comes before the child's first. */
    for (int64_t pass = 0; pass < above; pass += 2) {
        double both = pass < count ? larger(0.0, own[pass]) : 0.0;
        both = pass + 1 < count ? larger(both, own[pass + 1]) : both;
        parent[pass] = larger(parent[pass], both);
    }
    for (int64_t pass = count; pass < above; pass++)
        parent[pass] = larger(parent[pass], most);
    for (int64_t pass = 1; pass < above; pass++)
        parent[pass] = larger(parent[pass], parent[pass - 1]);
}

int64_t lode_lift_slopes(const int64_t *ends, int64_t ends_count, const int64_t *parents, int64_t parents_count,
                         int64_t first, int64_t last, double *slopes, int64_t slopes_count) {
    if (parents_count != ends_count || first < 0 || last > ends_count)
        return LODE_REFUSED;
    for (int64_t number = last; number > first;) {
        int64_t parent = parents[--number];
        if (parent >= number || !fits(ends, number, slopes_count))
            return LODE_REFUSED;
        if (parent < 0)
            continue;
        if (!fits(ends, parent, slopes_count))
            return LODE_REFUSED;
        int64_t start = number ? ends[number - 1] : 0, above = parent ? ends[parent - 1] : 0;
        /* Places that rise do not overlap; those of anything else may. */
        if (ends[parent] > start)
            return LODE_REFUSED;
        lift(slopes + above, ends[parent] - above, slopes + start, ends[number] - start);
    }
    return 0;
}
