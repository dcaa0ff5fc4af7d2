/* What the library says of itself, and what it takes from a compiler for granted. */
#include <float.h>

#include "lodestream.h"

#ifndef LODE_SOURCES
#error "compile with build.py, which defines LODE_SOURCES"
#endif

/* 32-bit x86 computes in 80 bits unless it is told -msse2 -mfpmath=sse. */
#if FLT_EVAL_METHOD != 0
#error "expected a compiler that computes float64 in float64"
#endif

const char *lode_sources(void) {
    return LODE_SOURCES;
}
