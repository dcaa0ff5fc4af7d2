/* The kernels of core/kernels as they are wanted here: for reading alone, with lengths of 32 bits.
 *
 * Each file declares its kernel static before it includes it. So the compiler sees that the direction never changes
 * and leaves out what writes, two thirds of the code; and JavaScript, where integers of 64 bits are slow, need not make
 * them. core/kernels/lodestream.h says what the arguments mean. A refusal is -2^31.
 */
#ifndef LODE_READING_H
#define LODE_READING_H

#include <stdint.h>

#define EXPORTED(name) __attribute__((export_name(#name)))

static inline int32_t answer(int64_t result) {
    return result < INT32_MIN ? INT32_MIN : (int32_t)result;
}

#endif
