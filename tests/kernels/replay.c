/* Makes recorded calls of kernels again, and compares what they return and what they leave in memory, bit for bit.
 *
 * usage: replay FILE; 0 where all is the same, 1 where something differs.
 */
#include <stdlib.h>
#include <string.h>

#include "calls.h"

enum { MOST_COMPLAINTS = 5 };

static void compare(const struct call *call, int64_t number, int64_t region, const uint8_t *found, int64_t *wrong) {
    const struct region *expected = &call->regions[region];
    for (int64_t i = 0; i < expected->bytes; i++)
        if (found[i] != expected->after[i]) {
            printf("call %lld, %s: memory %lld of %lld differs from byte %lld of %lld on\n", (long long)number,
                   call->kernel->name, (long long)region, (long long)call->region_count, (long long)i,
                   (long long)expected->bytes);
            ++*wrong;
            return;
        }
}

/* Make one call; returns how much of it differs, and adds the bytes that were compared. */
static int64_t again(const struct call *call, int64_t number, int64_t *compared) {
    uint8_t *kept[MOST_ARGUMENTS], *regions[MOST_ARGUMENTS];
    struct value values[MOST_ARGUMENTS];
    for (int64_t i = 0; i < call->region_count; i++) {
        /* A kernel may work from the next address on that suits its vectors. */
        kept[i] = memory(call->regions[i].bytes + 2 * ALIGNED);
        regions[i] = kept[i] + ALIGNED - (uintptr_t)kept[i] % ALIGNED + call->regions[i].address;
        memcpy(regions[i], call->regions[i].before, (size_t)call->regions[i].bytes);
    }
    for (int i = 0; i < call->kernel->arguments; i++) {
        values[i] = call->values[i];
        if (call->kernel->declared[i].kind >= ARRAY)
            values[i].at = regions[call->places[i].region] + call->places[i].first;
    }
    int64_t result = call->kernel->call(values), wrong = 0;
    if (result != call->result) {
        printf("call %lld, %s: returned %lld, expected %lld\n", (long long)number, call->kernel->name,
               (long long)result, (long long)call->result);
        wrong++;
    }
    for (int64_t i = 0; i < call->region_count; i++) {
        if (call->regions[i].after) {
            compare(call, number, i, regions[i], &wrong);
            *compared += call->regions[i].bytes;
        }
        free(kept[i]);
    }
    return wrong;
}

int main(int count, char **arguments) {
    if (count != 2)
        give_up("usage: replay FILE");
    struct calls *calls = open_calls(arguments[1]);
    struct call call;
    int64_t number = 0, wrong = 0, compared = 0;
    for (; wrong < MOST_COMPLAINTS && next_call(calls, &call); number++)
        wrong += again(&call, number, &compared);
    if (number == 0)
        give_up("no calls in %s", arguments[1]);
    printf("%lld calls, %lld bytes compared: %s\n", (long long)number, (long long)compared,
           wrong ? "DIFFERENT" : "the same");
    return wrong ? 1 : 0;
}
