/* What the library says of itself. */
#include "lodestream.h"

#ifndef LODE_SOURCES
#error "compile with build.py, which defines LODE_SOURCES"
#endif

const char *lode_sources(void) {
    return LODE_SOURCES;
}
