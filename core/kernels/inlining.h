/* Functions that are compiled for each constant with which they are called. */
#ifndef LODE_INLINING_H
#define LODE_INLINING_H

#define LODE_INLINE static inline __attribute__((always_inline))
/* Functions that stay alone. */
#define LODE_ALONE __attribute__((noinline))

#endif
