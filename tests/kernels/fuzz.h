/* Cases of the fuzzer: calls of one kernel whose every number and element can be changed. */
#ifndef FUZZ_H
#define FUZZ_H

#include "calls.h"

/* Arguments, arrays that overlapped apart. Copies share memory until it is changed. */
struct subject {
    struct value values[MOST_ARGUMENTS];
};

/* Compared numbers that were not equal, the latest last; where a kernel refuses lengths, those that it wanted. */
enum { COMPARISONS = 32 };
struct comparison {
    int64_t left, right;
};
extern struct comparison comparisons[COMPARISONS];
extern uint64_t comparison_count;

/* More would take long, which is a fault. */
enum { MOST_BYTES = 1 << 19 };

/* A number below `limit`, which is at least 1. */
int64_t below(int64_t limit);
void seed_numbers(uint64_t seed);

struct subject subject_of(const struct call *call);
struct subject copied(const struct kernel *kernel, const struct subject *subject);
/* Give an argument of a subject other bytes, of which it has as many as before. */
void put(const struct declared *declared, struct value *value, const void *bytes);
void discard(const struct kernel *kernel, struct subject *subject);

/* Change a few things at random; some of what is put in comes from `other`. */
void mutate(const struct kernel *kernel, struct subject *subject, const struct subject *other);

/* Change a number or an element so that one of the latest comparisons comes out otherwise; whether there was one. */
bool repair(const struct kernel *kernel, struct subject *subject);

#endif
