/* LZF, the compression of PCD files: runs of literal bytes, and back references of up to 264 bytes within the last
 * 8 KiB.
 *
 * Source: M. Lehmann, LibLZF 3.6, the format as lzf_d.c reads it.
 */

#include "copying.h"
#include "lodestream.h"

enum { LITERALS = 32, LONG = 7 };

/* Write the bytes that stand `distance` before, over and over where that is less than their number: what is there by
 * then is twice as much each time. */
static void repeat(uint8_t *to, int64_t distance, int64_t length) {
    const uint8_t *from = to - distance;
    while (length > 0) {
        int64_t count = to - from < length ? to - from : length;
        memcpy(to, from, (size_t)count);
        to += count;
        length -= count;
    }
}

int64_t lode_lzf(const uint8_t *source, int64_t source_count, uint8_t *target, int64_t target_count, int64_t budget,
                 int64_t *state, int64_t state_count) {
    if (state_count != 2 || budget < 0)
        return LODE_REFUSED;
    int64_t place = state[0], made = state[1];
    if (place < 0 || place > source_count || made < 0 || made > target_count)
        return LODE_REFUSED;
    int64_t enough = target_count - made > budget ? made + budget : INT64_MAX;
    while (place < source_count && made < enough) {
        int64_t control = source[place++];
        int64_t length;
        if (control < LITERALS) {
            length = control + 1;
            if (length > source_count - place || length > target_count - made)
                return 0;
            memcpy(target + made, source + place, (size_t)length);
            place += length;
        } else {
            length = control >> 5;
            if (length == LONG) {
                if (place >= source_count)
                    return 0;
                length += source[place++];
            }
            length += 2;
            if (place >= source_count)
                return 0;
            int64_t distance = ((control & 31) << 8) + source[place++] + 1;
            if (distance > made || length > target_count - made)
                return 0;
            repeat(target + made, distance, length);
        }
        made += length;
    }
    state[0] = place;
    state[1] = made;
    return 1;
}
