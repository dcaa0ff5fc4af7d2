/* Calls of kernels as data: what recording.py writes, and what replay.c and fuzz.c make calls of again.
 *
 * A file is a row of little-endian int64: "LODECALL", a hash of the declarations, and then records that begin with
 * their kind.
 *
 *   BLOB  size of an element, bytes, and the bytes, filled up to a multiple of 8
 *   CALL  kernel, result, regions, and for each region: size of an element, address modulo ALIGNED, blob before, blob
 *         after or -1;
 *         for each argument: the integer; the bits of the real; region, first byte and elements of an array; those and
 *         the type of values; region, first byte, rows, columns and pitch of a plane
 *
 * A region is memory in one piece that one argument holds, or several that overlap. Elements stand little-endian, so a
 * machine of the other order swaps them when it loads the file. A result of UNKNOWN is none: the call was not made.
 */
#ifndef CALLS_H
#define CALLS_H

#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>

enum kind { INTEGER, REAL, ARRAY, VALUES, PLANE };

/* What kernels.py says of an argument: of an element its size in bytes, and whether it is a float. Elements of VALUES
 * have the type that their `integer` is the number of. */
struct declared {
    enum kind kind;
    int size;
    bool is_float;
    bool written;
};

/* What a kernel is called with. */
struct value {
    int64_t integer;
    double real;
    void *at;
    int64_t count;
    int64_t rows, columns, pitch;
};

struct kernel {
    const char *name;
    int arguments;
    const struct declared *declared;
    int64_t (*call)(const struct value *values);
};

/* Made by declared.py of what kernels.py declares. */
extern const struct kernel KERNELS[];
extern const int64_t KERNEL_COUNT;
extern const uint64_t DECLARED;

enum { MOST_ARGUMENTS = 64, ALIGNED = 64, BLOB = 1, CALL = 2 };
#define UNKNOWN (INT64_MIN + 1)

struct region {
    int64_t size, bytes, address;
    const uint8_t *before, *after; /* after: NULL where nothing was written */
};

struct place {
    int64_t region, first;
};

struct call {
    const struct kernel *kernel;
    int64_t result;
    int64_t region_count;
    struct region regions[MOST_ARGUMENTS];
    struct value values[MOST_ARGUMENTS]; /* without their pointers */
    struct place places[MOST_ARGUMENTS];
};

struct calls;

/* A file, at its first call; ends the program where it cannot be read. */
struct calls *open_calls(const char *path);

/* Whether there is another call, which is then in `call`; its bytes stay where they are until the program ends. */
bool next_call(struct calls *calls, struct call *call);

enum { VALUE_TYPES = 10 };

/* Of an element of a value: its size in bytes, and whether it is a float. */
int64_t element_size(const struct declared *declared, const struct value *value);
bool holds_floats(const struct declared *declared, const struct value *value);

/* Elements that a value spans, the gaps of a plane's rows included. */
int64_t spanned(const struct declared *declared, const struct value *value);

/* Ends the program with a line on stderr. */
void give_up(const char *format, ...) __attribute__((format(printf, 1, 2), noreturn));

/* malloc that ends the program where there is no memory. */
void *memory(int64_t bytes);

#endif
