/* Masks of surfaces with holes, without loss (docs/format.md, "Masks").
 *
 * Points are coded in raster order, each in the context of the ten nearest points before it. Where all that surrounds a
 * group of sixteen points in a row is equal, one bit says whether they are equal to that too.
 */
#include "binary_coder.h"

enum {
    GROUP = LODE_MASK_GROUP,
    ABOVE = 2,
    BESIDE = 2,
    GROUPS = 1 << 10, /* first of the contexts of groups: by their surroundings and the last group's answer */
};

/* Groups of a row; the last one may be shorter. */
static int64_t groups_across(int64_t columns) {
    return (columns + GROUP - 1) / GROUP;
}

/* Whether all around a group is 1 or all is 0: then its value, else -1. */
static int surroundings(const uint8_t *at, int64_t stride, int64_t count) {
    int64_t sum = at[-1] + at[-2];
    for (int64_t j = -2; j < count + 2; j++)
        sum += at[j - stride] + at[j - 2 * stride];
    return sum == 0 ? 0 : sum == 2 * (count + 4) + 2 ? 1 : -1;
}

LODE_INLINE void code_points(bool reads, struct coder *coder, uint8_t *at, int64_t stride, int64_t count,
                             int32_t *model) {
    /* Five points of the row above, three of the one above that and two before, which move on with the point. */
    const uint8_t *up = at - stride, *far_up = at - 2 * stride;
    int32_t above = 0, further = 0, before = 2 * at[-2] + at[-1];
    for (int64_t j = -2; j < 2; j++)
        above = 2 * above + up[j];
    for (int64_t j = -1; j < 1; j++)
        further = 2 * further + far_up[j];
    for (int64_t j = 0; j < count; j++) {
        above = (above << 1 | up[j + 2]) & 31;
        further = (further << 1 | far_up[j + 1]) & 7;
        int bit = code_bit(reads, coder, at[j] != 0, &model[further << 7 | above << 2 | before]);
        at[j] = (uint8_t)bit;
        before = (before << 1 | bit) & 3;
    }
}

LODE_INLINE int code_groups(bool reads, struct coder *coder, int64_t columns, int64_t first, int64_t last,
                            uint8_t *field, int32_t *model, int answer) {
    int64_t stride = columns + 2 * BESIDE, across = groups_across(columns);
    int64_t row = first / across, left = first % across * GROUP;
    for (int64_t group = first; group < last; group++, left += GROUP) {
        if (left >= columns) {
            row++;
            left = 0;
        }
        int64_t count = columns - left < GROUP ? columns - left : GROUP;
        uint8_t *at = field + (row + ABOVE) * stride + BESIDE + left;
        int around = surroundings(at, stride, count);
        if (around >= 0) {
            int same = 1;
            for (int64_t j = 0; !reads && j < count; j++)
                same &= at[j] == around;
            answer = code_bit(reads, coder, same, &model[GROUPS + 2 * around + answer]);
            if (answer) {
                for (int64_t j = 0; j < count; j++)
                    at[j] = (uint8_t)around;
                continue;
            }
        }
        code_points(reads, coder, at, stride, count, model);
    }
    return answer;
}

int64_t lode_mask(int64_t reads, int64_t rows, int64_t columns, int64_t first, int64_t last,
                  const struct lode_mask *arguments) {
    const struct lode_mask call = *arguments;
    if (rows < 1 || columns < 1 || rows > INT32_MAX || columns > INT32_MAX || first < 0 || last < first ||
        last > rows * groups_across(columns) || call.field_count != (rows + ABOVE) * (columns + 2 * BESIDE) ||
        call.model_count != LODE_MASK_MODEL || call.state_count != 4)
        return LODE_REFUSED;
    struct coder coder = {(uint64_t)call.state[0], (uint32_t)call.state[1], call.state[2], call.data, call.data_count};
    int answer = call.state[3] & 1;
    if (first > 0 && ((uint64_t)call.state[1] > WIDEST || !coder_can_go_on(reads, &coder)))
        return LODE_REFUSED;
    if (first == 0) {
        coder = coder_start(reads, call.data, call.data_count);
        answer = 0;
        for (int i = 0; i < LODE_MASK_MODEL; i++)
            call.model[i] = LODE_NEW_CONTEXT;
    }
    answer = reads ? code_groups(true, &coder, columns, first, last, call.field, call.model, answer)
                   : code_groups(false, &coder, columns, first, last, call.field, call.model, answer);
    call.state[0] = (int64_t)coder.low;
    call.state[1] = coder.width;
    call.state[2] = coder.place;
    call.state[3] = answer;
    return reads || last < rows * groups_across(columns) ? coder.place : coder_finish(&coder);
}
