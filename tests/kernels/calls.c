/* Reads files of calls. */
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>

#include "calls.h"

void give_up(const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    vfprintf(stderr, format, arguments);
    va_end(arguments);
    fputc('\n', stderr);
    exit(2);
}

void *memory(int64_t bytes) {
    void *found = malloc((size_t)bytes);
    if (!found)
        give_up("no memory for %lld bytes", (long long)bytes);
    return found;
}

int64_t element_size(const struct declared *declared, const struct value *value) {
    static const int8_t sizes[VALUE_TYPES] = {1, 2, 4, 8, 1, 2, 4, 8, 4, 8};
    return declared->kind == VALUES ? sizes[value->integer] : declared->size;
}

bool holds_floats(const struct declared *declared, const struct value *value) {
    return declared->kind == VALUES ? value->integer >= 8 : declared->is_float;
}

int64_t spanned(const struct declared *declared, const struct value *value) {
    if (declared->kind == ARRAY || declared->kind == VALUES)
        return value->count;
    if (declared->kind == PLANE && value->rows > 0 && value->columns > 0)
        return (value->rows - 1) * value->pitch + value->columns;
    return 0;
}

static bool is_big_endian(void) {
    const uint16_t one = 1;
    uint8_t first;
    memcpy(&first, &one, 1);
    return first == 0;
}

static void swap(uint8_t *at, int64_t bytes, int64_t size) {
    for (int64_t first = 0; first + size <= bytes; first += size)
        for (int64_t i = 0; i < size / 2; i++) {
            uint8_t kept = at[first + i];
            at[first + i] = at[first + size - 1 - i];
            at[first + size - 1 - i] = kept;
        }
}

struct blob {
    int64_t size, bytes;
    uint8_t *at;
};

struct calls {
    uint8_t *at;
    int64_t bytes, place;
    struct blob *blobs;
    int64_t blob_count;
};

static int64_t next(struct calls *file) {
    if (file->place + 8 > file->bytes)
        give_up("the file of calls ends within a record");
    int64_t word;
    swap(file->at + file->place, 8, is_big_endian() ? 8 : 1);
    memcpy(&word, file->at + file->place, 8);
    file->place += 8;
    return word;
}

static int64_t next_below(struct calls *file, int64_t limit) {
    int64_t word = next(file);
    if (word < 0 || word >= limit)
        give_up("%lld in a file of calls, expected less than %lld", (long long)word, (long long)limit);
    return word;
}

static const uint8_t *blob_at(const struct calls *file, int64_t number, int64_t size, int64_t *bytes) {
    if (number < 0 || number >= file->blob_count || file->blobs[number].size != size)
        give_up("blob %lld is no blob of elements of %lld bytes", (long long)number, (long long)size);
    *bytes = file->blobs[number].bytes;
    return file->blobs[number].at;
}

static void read_blob(struct calls *file, struct blob *blob) {
    blob->size = next_below(file, 17);
    blob->bytes = next_below(file, file->bytes - file->place + 1);
    blob->at = file->at + file->place;
    if (is_big_endian())
        swap(blob->at, blob->bytes, blob->size);
    file->place += (blob->bytes + 7) / 8 * 8;
}

static void read_region(struct calls *file, struct region *region) {
    region->size = next(file);
    region->address = next_below(file, ALIGNED);
    region->before = blob_at(file, next(file), region->size, &region->bytes);
    int64_t after = next(file), bytes = region->bytes;
    region->after = after < 0 ? NULL : blob_at(file, after, region->size, &bytes);
    if (bytes != region->bytes)
        give_up("a region has %lld bytes before and %lld after", (long long)region->bytes, (long long)bytes);
}

static void read_value(struct calls *file, const struct call *call, int argument, struct value *value,
                       struct place *place) {
    const struct declared *declared = &call->kernel->declared[argument];
    memset(value, 0, sizeof *value);
    if (declared->kind == INTEGER) {
        value->integer = next(file);
    } else if (declared->kind == REAL) {
        int64_t bits = next(file);
        memcpy(&value->real, &bits, 8);
    } else {
        place->region = next_below(file, call->region_count);
        const struct region *region = &call->regions[place->region];
        place->first = next_below(file, region->bytes + 1);
        if (declared->kind != PLANE) {
            value->count = next_below(file, INT32_MAX);
            value->integer = declared->kind == VALUES ? next_below(file, VALUE_TYPES) : 0;
        } else {
            value->rows = next_below(file, INT32_MAX);
            value->columns = next_below(file, INT32_MAX);
            value->pitch = next_below(file, INT32_MAX);
        }
        int64_t size = element_size(declared, value);
        if (place->first + spanned(declared, value) * size > region->bytes || size != region->size)
            give_up("argument %d of a call of %s leaves its region", argument, call->kernel->name);
    }
}

static void read_call(struct calls *file, struct call *call) {
    call->kernel = &KERNELS[next_below(file, KERNEL_COUNT)];
    call->result = next(file);
    call->region_count = next_below(file, MOST_ARGUMENTS + 1);
    for (int64_t i = 0; i < call->region_count; i++)
        read_region(file, &call->regions[i]);
    for (int i = 0; i < call->kernel->arguments; i++)
        read_value(file, call, i, &call->values[i], &call->places[i]);
}

struct calls *open_calls(const char *path) {
    FILE *stream = fopen(path, "rb");
    if (!stream || fseek(stream, 0, SEEK_END))
        give_up("cannot open %s", path);
    long bytes = ftell(stream);
    struct calls *file = memory(sizeof *file);
    /* No blob takes less than three numbers. */
    *file = (struct calls){memory(bytes + 8), bytes, 0, memory(bytes / 24 * (int64_t)sizeof(struct blob) + 8), 0};
    rewind(stream);
    if (fread(file->at, 1, (size_t)bytes, stream) != (size_t)bytes)
        give_up("cannot read %s", path);
    fclose(stream);
    if (bytes < 16 || memcmp(file->at, "LODECALL", 8))
        give_up("%s is no file of calls", path);
    file->place = 8;
    if ((uint64_t)next(file) != DECLARED)
        give_up("%s was written for other declarations of kernels", path);
    return file;
}

bool next_call(struct calls *calls, struct call *call) {
    while (calls->place < calls->bytes) {
        int64_t kind = next(calls);
        if (kind == CALL) {
            read_call(calls, call);
            return true;
        }
        if (kind != BLOB)
            give_up("a record of kind %lld in a file of calls", (long long)kind);
        read_blob(calls, &calls->blobs[calls->blob_count++]);
    }
    return false;
}
