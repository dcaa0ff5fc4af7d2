/* Copies that the compiler itself supplies: <string.h> belongs to a C library, and the kernels are compiled without. */
#ifndef LODE_COPYING_H
#define LODE_COPYING_H

#include <stddef.h>

#define memcpy __builtin_memcpy
#define memmove __builtin_memmove
#define memset __builtin_memset

#endif
