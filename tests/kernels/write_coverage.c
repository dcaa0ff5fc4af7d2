/* Writes which lines have run, for processes that end without it. */
#include <stdint.h>

void __gcov_dump(void);

__attribute__((visibility("default"))) int64_t lode_write_coverage(void);

int64_t lode_write_coverage(void) {
    __gcov_dump();
    return 0;
}
