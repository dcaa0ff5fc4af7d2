/* Calls one kernel with anything, very many times, and keeps the cases that reach new code.
 *
 * usage: fuzz KERNEL SECONDS CASES SEED FILE FAULT
 *
 * FILE holds recorded calls, with which it begins. Linked with kernels that are compiled with the sanitizers: the first
 * fault ends the program with their words on stderr and the case in FAULT, a file of one call. A case that takes two
 * seconds of processor time is a fault too. KERNEL may be "-" and SECONDS 0, to make just the calls of FILE.
 *
 * What a kernel may rely on, since Python sees to it, holds for every case: pointers and lengths belong together, and
 * rows do not run backwards. All else is the kernel's to check.
 */
#define _DEFAULT_SOURCE
#include <fcntl.h>
#include <sanitizer/asan_interface.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

#include "fuzz.h"

enum { MAP = 1 << 14, MOST_KEPT = 4096, TICKS = 4, REPAIRS = 6, LATEST = 64 };

/* Looked up by the sanitizers' libraries. */
#define SEEN __attribute__((visibility("default")))
SEEN const char *__asan_default_options(void);
SEEN const char *__ubsan_default_options(void);
void __sanitizer_cov_trace_pc(void);

const char *__asan_default_options(void) {
    return "abort_on_error=1:handle_abort=0:detect_leaks=0:quarantine_size_mb=4:allocator_may_return_null=1";
}

const char *__ubsan_default_options(void) {
    return "abort_on_error=1:print_stacktrace=1";
}

/* Which branches a case has taken, as pairs of places in the code, and how often in powers of two. */
static uint8_t taken[MAP], seen[MAP];
static uintptr_t last_place;
static int64_t work; /* places that a case has passed */

void __sanitizer_cov_trace_pc(void) {
    uintptr_t place = (uintptr_t)__builtin_return_address(0);
    uint8_t *count = &taken[((place * 31) ^ last_place) % MAP];
    *count = (uint8_t)(*count + (*count < 255));
    last_place = place * 7;
    work++;
}

struct comparison comparisons[COMPARISONS];
uint64_t comparison_count;

static void compared(int64_t left, int64_t right) {
    if (left != right)
        comparisons[comparison_count++ % COMPARISONS] = (struct comparison){left, right};
}

#define COMPARED(name, type, whole)                                                                                    \
    void __sanitizer_cov_trace_##name(type left, type right);                                                          \
    void __sanitizer_cov_trace_##name(type left, type right) {                                                         \
        compared((whole)left, (whole)right);                                                                           \
    }
COMPARED(cmp4, uint32_t, int32_t)
COMPARED(const_cmp4, uint32_t, int32_t)
COMPARED(cmp8, uint64_t, int64_t)
COMPARED(const_cmp8, uint64_t, int64_t)

/* No length is compared in these. */
#define NOT_COMPARED(name, left_type, right_type)                                                                      \
    void __sanitizer_cov_trace_##name(left_type left, right_type right);                                               \
    void __sanitizer_cov_trace_##name(left_type left, right_type right) {                                              \
        (void)left, (void)right;                                                                                       \
    }
NOT_COMPARED(cmp1, uint8_t, uint8_t)
NOT_COMPARED(const_cmp1, uint8_t, uint8_t)
NOT_COMPARED(cmp2, uint16_t, uint16_t)
NOT_COMPARED(const_cmp2, uint16_t, uint16_t)
NOT_COMPARED(cmpf, float, float)
NOT_COMPARED(cmpd, double, double)
NOT_COMPARED(switch, uint64_t, void *)

static const struct kernel *kernel;
static const struct subject *current; /* what a fault is said of */
static const char *fault_path;
static int64_t case_count;

static void write_words(int to, const int64_t *words, int count) {
    if (write(to, words, (size_t)count * 8) != count * 8)
        _exit(3);
}

/* The case as a file of one call. */
static void write_fault(void) {
    int to = open(fault_path, O_WRONLY | O_CREAT | O_TRUNC, 0666);
    int64_t words[8], regions = 0;
    memcpy(words, "LODECALL", 8);
    memcpy(words + 1, &DECLARED, 8);
    write_words(to, words, 2);
    for (int i = 0; i < kernel->arguments; i++) {
        const struct declared *declared = &kernel->declared[i];
        if (declared->kind < ARRAY)
            continue;
        int64_t size = element_size(declared, &current->values[i]);
        int64_t bytes = spanned(declared, &current->values[i]) * size, zero = 0;
        write_words(to, (int64_t[]){BLOB, size, bytes}, 3);
        if (write(to, current->values[i].at, (size_t)bytes) != bytes || write(to, &zero, (size_t)(-bytes & 7)) < 0)
            _exit(3);
        regions++;
    }
    write_words(to, (int64_t[]){CALL, kernel - KERNELS, UNKNOWN, regions}, 4);
    for (int64_t i = 0, region = 0; i < kernel->arguments; i++)
        if (kernel->declared[i].kind >= ARRAY)
            write_words(to, (int64_t[]){element_size(&kernel->declared[i], &current->values[i]), 0, region++, -1}, 4);
    for (int64_t i = 0, region = 0; i < kernel->arguments; i++) {
        const struct value *value = &current->values[i];
        int64_t bits;
        memcpy(&bits, &value->real, 8);
        if (kernel->declared[i].kind == INTEGER)
            write_words(to, &value->integer, 1);
        else if (kernel->declared[i].kind == REAL)
            write_words(to, &bits, 1);
        else if (kernel->declared[i].kind == ARRAY)
            write_words(to, (int64_t[]){region++, 0, value->count}, 3);
        else if (kernel->declared[i].kind == VALUES)
            write_words(to, (int64_t[]){region++, 0, value->count, value->integer}, 4);
        else
            write_words(to, (int64_t[]){region++, 0, value->rows, value->columns, value->pitch}, 5);
    }
    close(to);
}

/* The case in a line: integers, reals, and the shapes of arrays. */
static void say_case(void) {
    fprintf(stderr, "%s(", kernel->name);
    for (int i = 0; i < kernel->arguments; i++) {
        const struct value *value = &current->values[i];
        const char *comma = i ? ", " : "";
        if (kernel->declared[i].kind == INTEGER)
            fprintf(stderr, "%s%lld", comma, (long long)value->integer);
        else if (kernel->declared[i].kind == REAL)
            fprintf(stderr, "%s%g", comma, value->real);
        else if (kernel->declared[i].kind == PLANE)
            fprintf(stderr, "%s[%lld x %lld of %lld]", comma, (long long)value->rows, (long long)value->columns,
                    (long long)value->pitch);
        else
            fprintf(stderr, "%s[%lld]", comma, (long long)value->count);
    }
    fprintf(stderr, ")\n");
}

static void on_fault(int signal_number) {
    (void)signal_number;
    if (current) {
        say_case();
        write_fault();
    }
    _exit(1);
}

/* Half a second of processor time has gone by; whether in the same case as the last ones. */
static void on_tick(int signal_number) {
    static int64_t last_case = -1;
    static int ticks;
    ticks = last_case == case_count ? ticks + 1 : 0;
    last_case = case_count;
    if (ticks >= TICKS && current) {
        fprintf(stderr, "a case takes longer than two seconds\n");
        on_fault(signal_number);
    }
}

static void watch(void) {
    signal(SIGABRT, on_fault);
    signal(SIGPROF, on_tick);
    struct itimerval half = {{0, 500000}, {0, 500000}};
    setitimer(ITIMER_PROF, &half, NULL);
}

/* Bytes between the rows of a plane are nobody's. */
static void forbid_gaps(const struct declared *declared, const struct value *value, bool forbid) {
    if (declared->kind != PLANE || value->pitch <= value->columns || spanned(declared, value) == 0)
        return;
    for (int64_t row = 0; row + 1 < value->rows; row++) {
        uint8_t *gap = (uint8_t *)value->at + (row * value->pitch + value->columns) * declared->size;
        size_t bytes = (size_t)((value->pitch - value->columns) * declared->size);
        if (forbid)
            __asan_poison_memory_region(gap, bytes);
        else
            __asan_unpoison_memory_region(gap, bytes);
    }
}

/* Memory for an argument that ends where the argument ends: the last case's, where that had as many bytes. */
static void *exactly(int argument, int64_t bytes) {
    static uint8_t *kept[MOST_ARGUMENTS];
    static int64_t sizes[MOST_ARGUMENTS];
    if (kept[argument] && sizes[argument] == bytes)
        return kept[argument];
    free(kept[argument]);
    kept[argument] = memory(bytes ? bytes : 8);
    sizes[argument] = bytes;
    if (bytes == 0)
        __asan_poison_memory_region(kept[argument], 8);
    return kept[argument];
}

/* Call the kernel; `results`, where it is not NULL, is a copy of the subject that takes what is then in its arrays. */
static int64_t run(const struct subject *subject, struct subject *results) {
    struct value values[MOST_ARGUMENTS];
    for (int i = 0; i < kernel->arguments; i++) {
        const struct declared *declared = &kernel->declared[i];
        values[i] = subject->values[i];
        if (declared->kind < ARRAY)
            continue;
        int64_t bytes = spanned(declared, &values[i]) * element_size(declared, &values[i]);
        values[i].at = exactly(i, bytes);
        memcpy(values[i].at, subject->values[i].at, (size_t)bytes);
        forbid_gaps(declared, &values[i], true);
    }
    current = subject;
    case_count++;
    memset(taken, 0, sizeof taken);
    last_place = 0, comparison_count = 0, work = 0;
    int64_t result = kernel->call(values);
    current = NULL;
    for (int i = 0; i < kernel->arguments; i++) {
        const struct declared *declared = &kernel->declared[i];
        if (declared->kind < ARRAY)
            continue;
        forbid_gaps(declared, &values[i], false);
        if (results && declared->written)
            put(declared, &results->values[i], values[i].at);
    }
    return result;
}

/* Whether the last case has done what none before has. */
static bool is_new(void) {
    bool found = false;
    for (int i = 0; i < MAP; i += 8) {
        uint64_t eight;
        memcpy(&eight, taken + i, 8);
        for (int j = i; eight && j < i + 8; j++) {
            if (!taken[j])
                continue;
            uint8_t often = (uint8_t)(1 << (31 - __builtin_clz((unsigned)taken[j])));
            found |= !(seen[j] & often);
            seen[j] |= often;
        }
    }
    return found;
}

static struct subject kept[MOST_KEPT];
static int64_t works[MOST_KEPT];
static int64_t kept_count, accepted_count;

static void keep(const struct subject *subject) {
    bool full = kept_count == MOST_KEPT;
    int64_t place = full ? below(MOST_KEPT) : kept_count++;
    if (full)
        discard(kernel, &kept[place]);
    kept[place] = copied(kernel, subject);
    works[place] = work;
}

static void begin_with(const char *path, bool all) {
    struct calls *calls = open_calls(path);
    struct call call;
    while (next_call(calls, &call)) {
        if (!all && call.kernel != kernel)
            continue;
        kernel = call.kernel;
        struct subject subject = subject_of(&call);
        accepted_count += run(&subject, NULL) != INT64_MIN;
        if (!all && is_new())
            keep(&subject);
        discard(kernel, &subject);
    }
}

/* Any of those kept, or of the latest; of two mostly that which takes less time. */
static const struct subject *some_kept(void) {
    int64_t latest = kept_count < LATEST ? kept_count : LATEST;
    int64_t one = below(2) ? below(kept_count) : kept_count - 1 - below(latest), other = below(kept_count);
    return &kept[below(4) && works[other] < works[one] ? other : one];
}

static void one_case(void) {
    struct subject subject = copied(kernel, some_kept());
    if (below(8) == 0) {
        /* What the kernel has made of it, as where a caller hands its state on. */
        struct subject results = copied(kernel, &subject);
        run(&subject, &results);
        discard(kernel, &subject);
        subject = results;
    }
    mutate(kernel, &subject, some_kept());
    int64_t result = run(&subject, NULL);
    for (int tries = 0; result == INT64_MIN && tries < REPAIRS && repair(kernel, &subject); tries++)
        result = run(&subject, NULL);
    accepted_count += result != INT64_MIN;
    if (is_new())
        keep(&subject);
    discard(kernel, &subject);
}

static double now(void) {
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return (double)time.tv_sec + (double)time.tv_nsec * 1e-9;
}

int main(int count, char **arguments) {
    if (count != 7)
        give_up("usage: fuzz KERNEL SECONDS CASES SEED FILE FAULT");
    double until = now() + atof(arguments[2]);
    int64_t most = atoll(arguments[3]);
    seed_numbers((uint64_t)atoll(arguments[4]));
    fault_path = arguments[6];
    bool all = strcmp(arguments[1], "-") == 0;
    for (int64_t i = 0; i < KERNEL_COUNT; i++)
        if (strcmp(KERNELS[i].name, arguments[1]) == 0)
            kernel = &KERNELS[i];
    if (!kernel && !all)
        give_up("no kernel %s", arguments[1]);
    watch();
    begin_with(arguments[5], all);
    if (!all && kept_count == 0)
        give_up("no call of %s in %s", arguments[1], arguments[5]);
    while (!all && now() < until && case_count < most)
        one_case();
    int branches = 0;
    for (int i = 0; i < MAP; i++)
        branches += seen[i] != 0;
    printf("%lld %lld %lld %d\n", (long long)case_count, (long long)accepted_count, (long long)kept_count, branches);
    return 0;
}
