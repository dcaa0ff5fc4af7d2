/* The forward step of one line (docs/format.md, section 8), by which sides of parts take their details from curves.
 * core/kernels/lifting.c does the same for planes, in five times as much code. */
#include "reading.h"

enum { REACH = 10, BEFORE = 2 };

static const int64_t TAPS[REACH] = {4913933, -843098, 144653, -24818, 4258, -731, 125, -21, 4, -1};

/* A node that may lie up to three places beyond an end of the run, where nodes are extrapolated. */
static int64_t node_at(const int32_t *nodes, int32_t k, int32_t run, int32_t wraps) {
    if (k >= 0 && k < run)
        return nodes[k];
    if (wraps)
        return nodes[k < 0 ? k + run : k - run];
    int32_t beyond = k < 0 ? -k : k - (run - 1);
    const int32_t *at = nodes + (k < 0 ? 0 : run - 1);
    int64_t first = at[0], second = at[k < 0 ? 1 : -1], third = at[k < 0 ? 2 : -2];
    return beyond == 1 ? 3 * first - 3 * second + third : 6 * first - 8 * second + 3 * third;
}

/* `x`: `length` samples in, nodes and then details out; `table`: as lode_lift takes it; `work`: room for `length` + 20.
 * At least one midpoint. Exact for samples within +-2^27. */
EXPORTED(forward)
void forward_line(int32_t *x, int32_t length, int32_t midpoints, int32_t run, const int64_t *table, int32_t a,
                  int32_t b, int32_t *work) {
    int32_t *details = work + REACH, *nodes = work + midpoints + 2 * REACH, coarse = length - midpoints;
    int32_t wraps = run == midpoints;
    for (int32_t k = 0; k < midpoints; k++)
        details[k] = x[2 * k + 1] - ((x[2 * k] + x[wraps && k == run - 1 ? 0 : 2 * k + 2]) >> 1);
    for (int32_t i = 0; i < 2 * REACH; i++) {
        int32_t place = i < REACH ? i - REACH : midpoints + i - REACH;
        details[place] = (int32_t)table[2 * i + 1] * details[table[2 * i]];
    }
    for (int32_t k = 0; k < run; k++) {
        int64_t sum = 3 << 21;
        for (int32_t j = 0; j < REACH; j++)
            sum += TAPS[j] * ((int64_t)details[k + j] + details[k - 1 - j]);
        nodes[k] = x[2 * k] + (int32_t)(sum >> 24);
    }
    if (run < coarse)
        nodes[run] = x[length - 1];
    for (int32_t k = 0; k < midpoints; k++) {
        int64_t v = 0;
        if (run >= 3 && (a || b)) {
            int64_t inner = node_at(nodes, k + 1, run, wraps) + node_at(nodes, k, run, wraps);
            v = a * (inner - node_at(nodes, k + 2, run, wraps) - node_at(nodes, k - 1, run, wraps)) +
                b * (inner - node_at(nodes, k + 3, run, wraps) - node_at(nodes, k - 2, run, wraps));
        }
        x[coarse + k] = details[k] - (int32_t)((v + 128) >> 8);
    }
    for (int32_t k = 0; k < coarse; k++)
        x[k] = nodes[k];
}
