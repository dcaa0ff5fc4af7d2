/* What the library says of itself, and what it takes from a compiler for granted. */
#include <float.h>
#if defined(__x86_64__)
#include <cpuid.h>
#endif

#include "lodestream.h"

#ifndef LODE_SOURCES
#error "compile with build.py, which defines LODE_SOURCES"
#endif

/* 32-bit x86 computes in 80 bits unless it is told -msse2 -mfpmath=sse. Where float32 is computed in float64, as on
 * s390x, nothing differs: the kernels only convert to it and from it. */
#if FLT_EVAL_METHOD != 0 && FLT_EVAL_METHOD != 1
#error "expected a compiler that computes float64 in float64"
#endif

const char *lode_sources(void) {
    return LODE_SOURCES;
}

#if defined(__x86_64__)

/* Whether a register of the answer to cpuid, 0 to 3 for eax to edx, has all bits that are wanted. */
static int processor(uint32_t leaf, int which, uint32_t wanted) {
    uint32_t answer[4] = {0, 0, 0, 0};
    return __get_cpuid_count(leaf, 0, &answer[0], &answer[1], &answer[2], &answer[3]) &&
           (answer[which] & wanted) == wanted;
}

/* Which registers the system keeps for each thread. */
static uint32_t kept_registers(void) {
    uint32_t low, high;
    __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    return low;
}

int lode_runs_v3(void) {
    enum { EBX = 1, ECX = 2, VECTORS = 6 };
    uint32_t fma = 1u << 12, movbe = 1u << 22, osxsave = 1u << 27, avx = 1u << 28, f16c = 1u << 29;
    uint32_t bmi1 = 1u << 3, avx2 = 1u << 5, bmi2 = 1u << 8, lzcnt = 1u << 5;
    return processor(1, ECX, fma | movbe | osxsave | avx | f16c) && processor(7, EBX, bmi1 | avx2 | bmi2) &&
           processor(0x80000001u, ECX, lzcnt) && (kept_registers() & VECTORS) == VECTORS;
}

#else

int lode_runs_v3(void) {
    return 0;
}

#endif

#if defined(_WIN32) && defined(LODE_WITHOUT_LIBC)

/* What Windows calls when the library is loaded, and a C library would define: there is nothing to prepare. */
int __stdcall DllMainCRTStartup(void *library, unsigned long reason, void *reserved) {
    (void)library, (void)reason, (void)reserved;
    return 1;
}

#endif
