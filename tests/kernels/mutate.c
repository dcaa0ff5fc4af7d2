/* Changes of cases: numbers, lengths, and elements of arrays. */
#include <stdlib.h>
#include <string.h>

#include "fuzz.h"

static uint64_t state = 1;

void seed_numbers(uint64_t seed) {
    state = seed * 2 + 1;
}

static uint64_t number(void) {
    /* splitmix64 */
    uint64_t z = (state += UINT64_C(0x9E3779B97F4A7C15));
    z = (z ^ (z >> 30)) * UINT64_C(0xBF58476D1CE4E5B9);
    z = (z ^ (z >> 27)) * UINT64_C(0x94D049BB133111EB);
    return z ^ (z >> 31);
}

int64_t below(int64_t limit) {
    return (int64_t)(number() % (uint64_t)limit);
}

/* A number at which programs go wrong, or a small one, or any. */
static int64_t edge(void) {
    static const int64_t edges[] = {0,         1,         -1,        INT64_MAX,  INT64_MIN, INT32_MAX, INT32_MIN,
                                    1LL << 32, 1LL << 31, 127,       128,        255,       256,       32767,
                                    32768,     65535,     1LL << 62, -(1 << 20), 1LL << 53, 1LL << 40};
    switch (below(4)) {
    case 0:
        return below(40) - 4;
    case 1:
        return (int64_t)(number() >> below(64));
    default:
        return edges[below(sizeof edges / sizeof *edges)];
    }
}

static double real_edge(void) {
    static const double edges[] = {0.0,     -0.0,   1.0,    -1.0,   0.5,     1e300,  -1e300, 5e-324, 0x1p31,
                                   -0x1p31, 0x1p32, 0x1p53, 0x1p63, -0x1p63, 0x1p64, 1e-300, 3.0,    1e10};
    uint64_t bits;
    double found;
    switch (below(4)) {
    case 0:
        bits = number();
        memcpy(&found, &bits, 8);
        return found;
    case 1:
        return below(2) ? __builtin_inf() : below(2) ? -__builtin_inf() : __builtin_nan("");
    default:
        return edges[below(sizeof edges / sizeof *edges)];
    }
}

static int64_t load(const struct declared *declared, const struct value *value, int64_t i) {
    int64_t found = 0;
    int64_t size = element_size(declared, value);
    const uint8_t *at = (const uint8_t *)value->at + i * size;
    if (size == 8) {
        memcpy(&found, at, 8);
    } else if (size == 4) {
        int32_t narrow;
        memcpy(&narrow, at, 4);
        found = narrow;
    } else if (size == 2) {
        int16_t narrow;
        memcpy(&narrow, at, 2);
        found = narrow;
    } else {
        found = (int8_t)*at;
    }
    return found;
}

/* The lower bytes of a number, which stand first on the machines that fuzz. */
static void store(const struct declared *declared, struct value *value, int64_t i, int64_t wanted) {
    int64_t size = element_size(declared, value);
    memcpy((uint8_t *)value->at + i * size, &wanted, (size_t)size);
}

static void store_real(const struct declared *declared, struct value *value, int64_t i, double wanted) {
    float narrow;
    uint64_t bits;
    memcpy(&bits, &wanted, 8);
    if (element_size(declared, value) == 4) {
        narrow = wanted > 3e38 || wanted < -3e38 ? (float)__builtin_inf() : (float)wanted;
        bits = 0;
        memcpy(&bits, &narrow, 4);
    }
    store(declared, value, i, (int64_t)bits);
}

static int64_t size_of(const struct declared *declared, const struct value *value) {
    return spanned(declared, value) * element_size(declared, value);
}

/* Memory that several subjects hold: before it stands how many. */
enum { BEFORE = 16 };

static int64_t *holders(const void *at) {
    return (int64_t *)((uintptr_t)at - BEFORE);
}

static void *held(int64_t bytes) {
    uint8_t *at = (uint8_t *)memory(bytes + BEFORE) + BEFORE;
    *holders(at) = 1;
    return at;
}

static void let_go(void *at) {
    if (--*holders(at) == 0)
        free(holders(at));
}

/* Make the memory of a value its own, to be changed. */
static void own(const struct declared *declared, struct value *value) {
    if (*holders(value->at) == 1)
        return;
    void *at = held(size_of(declared, value));
    memcpy(at, value->at, (size_t)size_of(declared, value));
    let_go(value->at);
    value->at = at;
}

/* Give a value another shape, with what was there before and zeros behind; not where that were too large. */
static void resize(const struct declared *declared, struct value *value, struct value wanted) {
    if (wanted.count < 0 || wanted.rows < 0 || wanted.columns < 0 || wanted.count > MOST_BYTES ||
        wanted.rows > MOST_BYTES || wanted.columns > MOST_BYTES || wanted.pitch > MOST_BYTES)
        return;
    /* As Python's arrays are: rows do not run backwards, and where they are written they do not overlap. */
    if (declared->kind == PLANE && (wanted.pitch < 0 || (declared->written && wanted.pitch < wanted.columns)))
        wanted.pitch = wanted.columns;
    int64_t before = size_of(declared, value), bytes = size_of(declared, &wanted);
    if (bytes > MOST_BYTES)
        return;
    wanted.at = held(bytes);
    memset(wanted.at, 0, (size_t)bytes);
    memcpy(wanted.at, value->at, (size_t)(bytes < before ? bytes : before));
    let_go(value->at);
    *value = wanted;
}

struct subject subject_of(const struct call *call) {
    struct subject found = {0};
    for (int i = 0; i < call->kernel->arguments; i++) {
        found.values[i] = call->values[i];
        if (call->kernel->declared[i].kind < ARRAY)
            continue;
        int64_t bytes = size_of(&call->kernel->declared[i], &call->values[i]);
        found.values[i].at = held(bytes);
        memcpy(found.values[i].at, call->regions[call->places[i].region].before + call->places[i].first, (size_t)bytes);
    }
    return found;
}

struct subject copied(const struct kernel *kernel, const struct subject *subject) {
    for (int i = 0; i < kernel->arguments; i++)
        if (kernel->declared[i].kind >= ARRAY)
            ++*holders(subject->values[i].at);
    return *subject;
}

void discard(const struct kernel *kernel, struct subject *subject) {
    for (int i = 0; i < kernel->arguments; i++)
        if (kernel->declared[i].kind >= ARRAY)
            let_go(subject->values[i].at);
}

void put(const struct declared *declared, struct value *value, const void *bytes) {
    own(declared, value);
    memcpy(value->at, bytes, (size_t)size_of(declared, value));
}

/* The whole numbers of a value: an integer, or the lengths of an array; NULL where there is no such part. */
static int64_t *whole(struct value *value, const struct declared *declared, int part) {
    if (declared->kind == INTEGER)
        return part == 0 ? &value->integer : NULL;
    if (declared->kind == ARRAY || declared->kind == VALUES)
        return part == 0 ? &value->count : NULL;
    if (declared->kind == PLANE)
        return part == 0 ? &value->rows : part == 1 ? &value->columns : part == 2 ? &value->pitch : NULL;
    return NULL;
}

static void set_whole(const struct declared *declared, struct value *value, int part, int64_t wanted) {
    struct value changed = *value;
    *whole(&changed, declared, part) = wanted;
    if (declared->kind == INTEGER)
        *value = changed;
    else
        resize(declared, value, changed);
}

/* Give all whole numbers that are equal to one of them the same other value: lengths that belong together. */
static void change_together(const struct kernel *kernel, struct subject *subject, int64_t from, int64_t to) {
    for (int i = 0; i < kernel->arguments; i++)
        for (int part = 0; part < 3; part++) {
            int64_t *found = whole(&subject->values[i], &kernel->declared[i], part);
            if (found && *found == from)
                set_whole(&kernel->declared[i], &subject->values[i], part, to);
        }
}

static void change_number(const struct kernel *kernel, struct subject *subject, int i) {
    const struct declared *declared = &kernel->declared[i];
    struct value *value = &subject->values[i];
    if (declared->kind == REAL) {
        value->real = below(2) ? real_edge() : value->real * (1.0 + (double)below(5) - 2.0);
        return;
    }
    if (declared->kind == VALUES && below(2)) {
        struct value changed = *value;
        changed.integer = below(VALUE_TYPES);
        resize(declared, value, changed);
        return;
    }
    int part = declared->kind == PLANE ? (int)below(3) : 0;
    int64_t before = *whole(value, declared, part);
    int64_t step = (int64_t)((uint64_t)before + (uint64_t)(below(9) - 4));
    int64_t to = below(2)                    ? step
                 : declared->kind == INTEGER ? edge()
                                             : below(1 + 2 * (before < MOST_BYTES ? before : 1));
    if (below(3) == 0)
        change_together(kernel, subject, before, to);
    else
        set_whole(declared, value, part, to);
}

static void change_elements(const struct declared *declared, struct value *value, const struct value *other) {
    int64_t count = spanned(declared, value), others = spanned(declared, other);
    if (count == 0)
        return;
    /* At either end stands what matters most: tables begin there, and what is handed on is kept behind the rest. */
    int64_t ends = below(count < 16 ? count : 16);
    int64_t at = below(2) ? below(count) : below(2) ? ends : count - 1 - ends;
    int64_t length = 1 + below(below(2) ? 4 : 64);
    length = length < count - at ? length : count - at;
    int64_t from = below(count), wanted = edge(), step = below(9) - 4;
    double real = real_edge();
    int kind = (int)below(6);
    int64_t size = element_size(declared, value);
    own(declared, value);
    for (int64_t i = 0; i < length; i++) {
        int64_t place = at + i;
        if (kind == 0)
            ((uint8_t *)value->at)[place * size + below(size)] ^= (uint8_t)(1 << below(8));
        else if (kind == 1 && holds_floats(declared, value))
            store_real(declared, value, place, real);
        else if (kind == 1)
            store(declared, value, place, wanted);
        else if (kind == 2)
            store(declared, value, place, (int64_t)((uint64_t)load(declared, value, place) + (uint64_t)step));
        else if (kind == 3)
            store(declared, value, place, load(declared, value, (from + i) % count));
        else if (kind == 4 && others > 0)
            store(declared, value, place, load(declared, other, place % others));
        else
            store(declared, value, place, (int64_t)number());
    }
}

void mutate(const struct kernel *kernel, struct subject *subject, const struct subject *other) {
    int64_t changes = (int64_t)1 << below(4);
    for (int64_t change = 0; change < changes; change++) {
        int i = (int)below(kernel->arguments);
        if (kernel->declared[i].kind < ARRAY || below(6) == 0)
            change_number(kernel, subject, i);
        else
            change_elements(&kernel->declared[i], &subject->values[i], &other->values[i]);
    }
}

/* One of the places that hold `from`, which is set to `to`; whether there was one. */
static bool replace(const struct kernel *kernel, struct subject *subject, int64_t from, int64_t to) {
    int found = 0, chosen_argument = -1;
    int64_t chosen = 0;
    for (int i = 0; i < kernel->arguments; i++) {
        const struct declared *declared = &kernel->declared[i];
        struct value *value = &subject->values[i];
        for (int part = 0; part < 3; part++) {
            int64_t *number_ = whole(value, declared, part);
            if (number_ && *number_ == from && below(++found) == 0)
                chosen_argument = i, chosen = -1 - part;
        }
        if (declared->kind < ARRAY || holds_floats(declared, value))
            continue;
        int64_t count = spanned(declared, value);
        for (int64_t j = 0; j < count && j < 256; j++)
            if (load(declared, value, j) == from && below(++found) == 0)
                chosen_argument = i, chosen = j;
    }
    if (chosen_argument < 0)
        return false;
    const struct declared *declared = &kernel->declared[chosen_argument];
    struct value *value = &subject->values[chosen_argument];
    if (chosen < 0) {
        set_whole(declared, value, (int)(-1 - chosen), to);
    } else {
        own(declared, value);
        store(declared, value, chosen, to);
    }
    return true;
}

bool repair(const struct kernel *kernel, struct subject *subject) {
    uint64_t latest = comparison_count < COMPARISONS ? comparison_count : COMPARISONS;
    if (latest == 0)
        return false;
    /* Mostly the last one, which has decided. */
    uint64_t back = below(2) ? 1 : 1 + (uint64_t)below((int64_t)latest);
    struct comparison chosen = comparisons[(comparison_count - back) % COMPARISONS];
    int64_t step = below(4) ? 0 : below(3) - 1;
    bool left = below(2);
    int64_t from = left ? chosen.left : chosen.right, to = left ? chosen.right : chosen.left;
    return replace(kernel, subject, from, (int64_t)((uint64_t)to + (uint64_t)step)) ||
           replace(kernel, subject, to, (int64_t)((uint64_t)from + (uint64_t)step));
}
