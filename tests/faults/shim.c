/* Makes calls of libc fail on purpose: for LD_PRELOAD, on Linux with glibc.
 *
 * A page of memory that all processes share, the file that LODE_FAULT_CONTROL names, says what to do: pass everything,
 * count the calls on paths beneath a folder by call and by place, or count them and let one fail. Counters and orders
 * are the same for a server and for the processes that it starts, so a fault that is to happen once happens once.
 *
 * While calls are counted, each is written into the file that LODE_FAULT_CALLS names, one line for each. Where SIGUSR2 has
 * a handler (Python's faulthandler, which needs no lock) it follows, and adds from which lines of Python the call came.
 *
 * A call that fails does nothing: no byte is written, no name is changed. close alone closes, as Linux does after an
 * error. The one that falls short reads or writes less than it was asked to, as POSIX allows.
 */
#define _GNU_SOURCE
#undef _FORTIFY_SOURCE

#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <sched.h>
#include <signal.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/mman.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/statfs.h>
#include <sys/statvfs.h>
#include <sys/time.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>
#include <utime.h>

/* ---- what is counted ---- */

#define CALLS(X) \
    X(OPEN_READ, "open to read") X(OPEN_WRITE, "open to write") X(READ, "read") X(PREAD, "pread") X(WRITE, "write") \
    X(FSYNC, "fsync") X(RENAME, "rename") X(UNLINK, "unlink") X(RMDIR, "rmdir") X(MKDIR, "mkdir") \
    X(OPENDIR, "opendir") X(READDIR, "readdir") X(STAT, "stat") X(FSTAT, "fstat") X(ACCESS, "access") \
    X(LINK, "link") X(SYMLINK, "symlink") X(READLINK, "readlink") X(TRUNCATE, "truncate") X(FLOCK, "flock") \
    X(STATVFS, "statvfs") X(SENDFILE, "sendfile") X(COPY_RANGE, "copy_file_range") X(UTIME, "utime") \
    X(CHMOD, "chmod") X(CHOWN, "chown") X(CLOSE, "close")

/* What lies in the folder; the first is the folder, the last whatever has another name. tests/faults/shim.py gives it. */
#ifndef TOPS
#error "expected TOPS(X), such as X(\"\") X(\"uploads\") X(\"other\")"
#endif

/* Itself; below it what is called by an id, by another name, or is being written; below that a number, another name. */
#define KINDS(X) X("") X("/ID") X("/name") X("/*.new") X("/*/N") X("/*/name")

enum {
#define X(name, words) CALL_##name,
    CALLS(X)
#undef X
        CALL_COUNT
};
enum { KIND_SELF, KIND_ID, KIND_NAME, KIND_NEW, KIND_DEEP_NUMBER, KIND_DEEP_NAME, KIND_COUNT };

static const char *const call_names[] = {
#define X(name, words) words,
    CALLS(X)
#undef X
};
#define X(words) words,
static const char *const top_names[] = {TOPS(X)};
static const char *const kind_names[] = {KINDS(X)};
#undef X

#define TOP_COUNT ((int)(sizeof top_names / sizeof *top_names))
#define PLACE_COUNT (TOP_COUNT * KIND_COUNT)

/* ---- the page; tests/faults/shim.py has the same ---- */

enum { MODE_PASS, MODE_COUNT, MODE_FAIL };
enum { NO_FAULT = 0, SHORT = -1 };

struct control {
    uint32_t mode;
    int32_t call, place; /* what fails, */
    uint32_t number;     /* from which occurrence on, the first being 0, */
    uint32_t times;      /* how often, */
    int32_t error;       /* and with which errno; SHORT falls short */
    uint32_t hits;       /* how often it has failed */
    uint32_t writing;    /* somebody writes into the file of calls */
    uint32_t counts[CALL_COUNT][PLACE_COUNT];
    char root[PATH_MAX]; /* real path of the folder */
    char hit[PATH_MAX];  /* the path of the last call that has failed */
};

static struct control *page;
static int calls = -1; /* the file of calls */

/* For tests/faults/shim.py, which loads this library to ask for names. */
extern const char *lode_call(int number);
/* For tests/faults/forking.py, whose processes write from which lines a call comes into the same file. */
extern int lode_calls(void);
int lode_calls(void) { return calls; }
extern const char *lode_place(int number);
extern size_t lode_size(void);
extern int lode_leave_signal_stack(void);
const char *lode_call(int number) { return number < CALL_COUNT ? call_names[number] : NULL; }
size_t lode_size(void) { return sizeof(struct control); }
const char *lode_place(int number)
{
    static char name[64];
    if (number >= PLACE_COUNT)
        return NULL;
    snprintf(name, sizeof name, "%s%s", top_names[number / KIND_COUNT], kind_names[number % KIND_COUNT]);
    return name;
}

/* For tests/faults/forking.py: handlers of signals then run on the stack of whoever is interrupted. faulthandler has taken
 * 10 KB of the heap for all of them. A handler that writes (Python's, which wakes a loop) needs more than that here, with
 * a path and with names of libc that are looked up for the first time, and would overwrite what lies beneath. */
int lode_leave_signal_stack(void)
{
    stack_t none = {.ss_flags = SS_DISABLE};
    return sigaltstack(&none, NULL);
}

static void *next(const char *name)
{
    static const char *const older[] = {"GLIBC_2.2.5", "GLIBC_2.17"};
    void *found = dlsym(RTLD_NEXT, name);
    for (size_t number = 0; found == NULL && number < sizeof older / sizeof *older; number++)
        found = dlvsym(RTLD_NEXT, name, older[number]);
    if (found == NULL)
        abort();
    return found;
}

#define REAL(name) \
    static __typeof__(name) *real; \
    if (real == NULL) \
    real = (__typeof__(name) *)next(#name)

__attribute__((constructor)) static void begin(void)
{
    const char *path = getenv("LODE_FAULT_CONTROL");
    struct stat status;
    if (path == NULL)
        return;
    int handle = open(path, O_RDWR | O_CLOEXEC);
    if (handle < 0)
        return;
    if (fstat(handle, &status) == 0 && status.st_size >= (off_t)sizeof(struct control)) {
        void *shared = mmap(NULL, sizeof(struct control), PROT_READ | PROT_WRITE, MAP_SHARED, handle, 0);
        if (shared != MAP_FAILED)
            page = shared;
    }
    close(handle);
    path = getenv("LODE_FAULT_CALLS");
    if (path != NULL)
        calls = open(path, O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0644);
}

/* ---- which place a path is ---- */

static int is_hex(char letter)
{
    return (letter >= '0' && letter <= '9') || (letter >= 'a' && letter <= 'f');
}

static int ends_in_new(const char *name)
{
    size_t length = strlen(name);
    return length >= 4 && strcmp(name + length - 4, ".new") == 0;
}

static int kind_of(const char *below)
{
    const char *name = strrchr(below, '/') + 1;
    size_t count = 0;
    if (ends_in_new(name))
        return KIND_NEW;
    if (name != below + 1)
        return name[0] != '\0' && strspn(name, "0123456789") == strlen(name) ? KIND_DEEP_NUMBER : KIND_DEEP_NAME;
    while (is_hex(name[count]))
        count++;
    return count >= 8 ? KIND_ID : KIND_NAME;
}

/* The place of a real path, -1 for one outside the folder. */
static int place_of(const char *path)
{
    size_t length = strlen(page->root);
    if (length == 0 || strncmp(path, page->root, length) != 0 || (path[length] != '/' && path[length] != '\0'))
        return -1;
    path += length;
    while (*path == '/')
        path++;
    if (*path == '\0')
        return 0;
    const char *below = path + strcspn(path, "/");
    int top = TOP_COUNT - 1;
    for (int number = 1; number < TOP_COUNT - 1; number++) {
        size_t size = strlen(top_names[number]);
        /* With it go files beside it whose names only add to it: one that is being written, those of a database. */
        if (strncmp(path, top_names[number], size) == 0 && (path[size] == '\0' || strchr("/.-", path[size]) != NULL)) {
            top = number;
            below = path + size + strcspn(path + size, "/");
        }
    }
    if (*below == '\0' || below[1] == '\0')
        return top * KIND_COUNT + (ends_in_new(path) ? KIND_NEW : KIND_SELF);
    return top * KIND_COUNT + kind_of(below);
}

static int path_of_handle(int handle, char *path)
{
    char link[32];
    static ssize_t (*real)(const char *, char *, size_t);
    if (real == NULL)
        real = (ssize_t(*)(const char *, char *, size_t))next("readlink");
    snprintf(link, sizeof link, "/proc/self/fd/%d", handle);
    ssize_t length = real(link, path, PATH_MAX - 1);
    if (length <= 0 || path[0] != '/')
        return -1;
    path[length] = '\0';
    return 0;
}

/* ---- whether a call fails ---- */

static int watched(int call)
{
    if (page == NULL)
        return 0;
    uint32_t mode = __atomic_load_n(&page->mode, __ATOMIC_ACQUIRE);
    return mode == MODE_COUNT || (mode == MODE_FAIL && page->call == call);
}

/* One at a time, so that lines stay together; but nobody waits for one who was killed. */
static void tell(int call, int place, uint32_t number)
{
    struct sigaction handler;
    uint32_t nobody = 0;
    for (int turn = 0; turn < 20000; turn++, nobody = 0) {
        if (__atomic_compare_exchange_n(&page->writing, &nobody, 1, 0, __ATOMIC_ACQUIRE, __ATOMIC_RELAXED))
            break;
        sched_yield();
    }
    dprintf(calls, "= %d %d %u\n", call, place, number);
    if (sigaction(SIGUSR2, NULL, &handler) == 0 && handler.sa_handler != SIG_DFL && handler.sa_handler != SIG_IGN)
        raise(SIGUSR2);
    __atomic_store_n(&page->writing, 0, __ATOMIC_RELEASE);
}

static int verdict(int call, const char *path)
{
    int place = place_of(path);
    if (place < 0)
        return NO_FAULT;
    uint32_t number = __atomic_fetch_add(&page->counts[call][place], 1, __ATOMIC_ACQ_REL);
    if (page->mode == MODE_COUNT && calls >= 0)
        tell(call, place, number);
    if (page->mode != MODE_FAIL || page->place != place || number < page->number || number - page->number >= page->times)
        return NO_FAULT;
    snprintf(page->hit, sizeof page->hit, "%s", path);
    __atomic_fetch_add(&page->hits, 1, __ATOMIC_ACQ_REL);
    return page->error;
}

static int handle_fault(int call, int handle)
{
    if (!watched(call))
        return NO_FAULT;
    char path[PATH_MAX];
    int before = errno;
    int fault = path_of_handle(handle, path) == 0 ? verdict(call, path) : NO_FAULT;
    errno = fault > 0 ? fault : before;
    return fault;
}

static int whole_path(int folder, const char *name, char path[2 * PATH_MAX])
{
    size_t length = 0;
    if (name[0] != '/') {
        if (folder == AT_FDCWD ? getcwd(path, PATH_MAX) == NULL : path_of_handle(folder, path) != 0)
            return -1;
        length = strlen(path);
        path[length++] = '/';
    }
    snprintf(path + length, 2 * PATH_MAX - length, "%s", name);
    return 0;
}

static int path_fault(int call, int folder, const char *name)
{
    if (!watched(call) || (uintptr_t)name == 0)
        return NO_FAULT;
    char path[2 * PATH_MAX];
    int before = errno, fault = NO_FAULT;
    if (name[0] == '\0') { /* AT_EMPTY_PATH */
        fault = handle_fault(call, folder);
    } else if (whole_path(folder, name, path) == 0) {
        fault = verdict(call, path);
    }
    errno = fault > 0 ? fault : before;
    return fault;
}

static int place_at(int folder, const char *name)
{
    char path[2 * PATH_MAX];
    int before = errno;
    int place = whole_path(folder, name, path) == 0 ? place_of(path) : -1;
    errno = before;
    return place;
}

/* Two names: it counts at the second one, where something is to come into being, else at the first. */
static int names_fault(int call, int from, const char *old, int to, const char *new)
{
    if (page == NULL)
        return NO_FAULT;
    int place = place_at(to, new);
    return place >= 0 ? path_fault(call, to, new) : path_fault(call, from, old);
}

/* Less than was asked for: so little that it is less than the file has, too. */
static size_t less(size_t size)
{
    return size > 32 ? 16 : size > 1 ? size / 2 : size;
}

/* ---- the calls ---- */

#define PATH_CALL(call, type, name, parameters, arguments, folder, path) \
    type name parameters \
    { \
        REAL(name); \
        return path_fault(CALL_##call, folder, path) > 0 ? -1 : real arguments; \
    }

#define HANDLE_CALL(call, type, name, parameters, arguments, handle) \
    type name parameters \
    { \
        REAL(name); \
        return handle_fault(CALL_##call, handle) > 0 ? -1 : real arguments; \
    }

#define OPEN_CALL(flags) ((flags) & (O_WRONLY | O_RDWR | O_CREAT) ? CALL_OPEN_WRITE : CALL_OPEN_READ)

#define MODE_ARGUMENT \
    mode_t mode = 0; \
    if (flags & (O_CREAT | O_TMPFILE)) { \
        va_list rest; \
        va_start(rest, flags); \
        mode = (mode_t)va_arg(rest, unsigned int); \
        va_end(rest); \
    }

#define OPEN(name) \
    int name(const char *path, int flags, ...) \
    { \
        MODE_ARGUMENT \
        REAL(name); \
        return path_fault(OPEN_CALL(flags), AT_FDCWD, path) > 0 ? -1 : real(path, flags, mode); \
    }
#define OPENAT(name) \
    int name(int folder, const char *path, int flags, ...) \
    { \
        MODE_ARGUMENT \
        REAL(name); \
        return path_fault(OPEN_CALL(flags), folder, path) > 0 ? -1 : real(folder, path, flags, mode); \
    }
OPEN(open)
OPEN(open64)
OPENAT(openat)
OPENAT(openat64)
PATH_CALL(OPEN_WRITE, int, creat, (const char *path, mode_t mode), (path, mode), AT_FDCWD, path)
PATH_CALL(OPEN_WRITE, int, creat64, (const char *path, mode_t mode), (path, mode), AT_FDCWD, path)

extern int __open_2(const char *path, int flags);
extern int __open64_2(const char *path, int flags);
extern int __openat_2(int folder, const char *path, int flags);
extern int __openat64_2(int folder, const char *path, int flags);
PATH_CALL(OPEN_READ, int, __open_2, (const char *path, int flags), (path, flags), AT_FDCWD, path)
PATH_CALL(OPEN_READ, int, __open64_2, (const char *path, int flags), (path, flags), AT_FDCWD, path)
PATH_CALL(OPEN_READ, int, __openat_2, (int folder, const char *path, int flags), (folder, path, flags), folder, path)
PATH_CALL(OPEN_READ, int, __openat64_2, (int folder, const char *path, int flags), (folder, path, flags), folder, path)

#define FOPEN(name) \
    FILE *name(const char *path, const char *mode) \
    { \
        REAL(name); \
        int call = strpbrk(mode, "wa+") != NULL ? CALL_OPEN_WRITE : CALL_OPEN_READ; \
        return path_fault(call, AT_FDCWD, path) > 0 ? NULL : real(path, mode); \
    }
FOPEN(fopen)
FOPEN(fopen64)

/* Calls that may fall short. */
#define MOVE(call, name, parameters, handle, size, whole, part) \
    ssize_t name parameters \
    { \
        REAL(name); \
        int fault = handle_fault(CALL_##call, handle); \
        if (fault > 0) \
            return -1; \
        if (fault == SHORT) { \
            size = less(size); \
            return real part; \
        } \
        return real whole; \
    }
#define MOVE_SAME(call, name, parameters, handle, size, whole) MOVE(call, name, parameters, handle, size, whole, whole)

MOVE_SAME(READ, read, (int handle, void *data, size_t size), handle, size, (handle, data, size))
MOVE_SAME(WRITE, write, (int handle, const void *data, size_t size), handle, size, (handle, data, size))
MOVE_SAME(PREAD, pread, (int handle, void *data, size_t size, off_t at), handle, size, (handle, data, size, at))
MOVE_SAME(PREAD, pread64, (int handle, void *data, size_t size, off64_t at), handle, size, (handle, data, size, at))
MOVE_SAME(WRITE, pwrite, (int handle, const void *data, size_t size, off_t at), handle, size, (handle, data, size, at))
MOVE_SAME(WRITE, pwrite64, (int handle, const void *data, size_t size, off64_t at), handle, size, (handle, data, size, at))

extern ssize_t __read_chk(int handle, void *data, size_t size, size_t room);
extern ssize_t __pread_chk(int handle, void *data, size_t size, off_t at, size_t room);
extern ssize_t __pread64_chk(int handle, void *data, size_t size, off64_t at, size_t room);
MOVE_SAME(READ, __read_chk, (int handle, void *data, size_t size, size_t room), handle, size, (handle, data, size, room))
MOVE_SAME(PREAD, __pread_chk, (int handle, void *data, size_t size, off_t at, size_t room), handle, size,
          (handle, data, size, at, room))
MOVE_SAME(PREAD, __pread64_chk, (int handle, void *data, size_t size, off64_t at, size_t room), handle, size,
          (handle, data, size, at, room))

/* Of several buffers the first that holds anything, and not all of it. */
static struct iovec part_of(const struct iovec *vector, int count)
{
    struct iovec part = {NULL, 0};
    for (int number = 0; part.iov_len == 0 && number < count; number++)
        part = vector[number];
    return part;
}
#define MOVE_VECTOR(call, name, parameters, whole, part) \
    ssize_t name parameters \
    { \
        REAL(name); \
        int fault = handle_fault(CALL_##call, handle); \
        if (fault > 0) \
            return -1; \
        if (fault == SHORT) { \
            struct iovec one = part_of(vector, count); \
            one.iov_len = less(one.iov_len); \
            return real part; \
        } \
        return real whole; \
    }
#define VECTOR int handle, const struct iovec *vector, int count
MOVE_VECTOR(READ, readv, (VECTOR), (handle, vector, count), (handle, &one, 1))
MOVE_VECTOR(WRITE, writev, (VECTOR), (handle, vector, count), (handle, &one, 1))
MOVE_VECTOR(PREAD, preadv, (VECTOR, off_t at), (handle, vector, count, at), (handle, &one, 1, at))
MOVE_VECTOR(PREAD, preadv64, (VECTOR, off64_t at), (handle, vector, count, at), (handle, &one, 1, at))
MOVE_VECTOR(WRITE, pwritev, (VECTOR, off_t at), (handle, vector, count, at), (handle, &one, 1, at))
MOVE_VECTOR(WRITE, pwritev64, (VECTOR, off64_t at), (handle, vector, count, at), (handle, &one, 1, at))
MOVE_VECTOR(PREAD, preadv2, (VECTOR, off_t at, int how), (handle, vector, count, at, how), (handle, &one, 1, at, how))
MOVE_VECTOR(PREAD, preadv64v2, (VECTOR, off64_t at, int how), (handle, vector, count, at, how),
            (handle, &one, 1, at, how))
MOVE_VECTOR(WRITE, pwritev2, (VECTOR, off_t at, int how), (handle, vector, count, at, how), (handle, &one, 1, at, how))
MOVE_VECTOR(WRITE, pwritev64v2, (VECTOR, off64_t at, int how), (handle, vector, count, at, how),
            (handle, &one, 1, at, how))

MOVE_SAME(SENDFILE, sendfile, (int to, int from, off_t *at, size_t size), from, size, (to, from, at, size))
MOVE_SAME(SENDFILE, sendfile64, (int to, int from, off64_t *at, size_t size), from, size, (to, from, at, size))
MOVE_SAME(COPY_RANGE, copy_file_range,
          (int from, off64_t *at, int to, off64_t *to_at, size_t size, unsigned int flags), from, size,
          (from, at, to, to_at, size, flags))

HANDLE_CALL(FSYNC, int, fsync, (int handle), (handle), handle)
HANDLE_CALL(FSYNC, int, fdatasync, (int handle), (handle), handle)
HANDLE_CALL(TRUNCATE, int, ftruncate, (int handle, off_t size), (handle, size), handle)
HANDLE_CALL(TRUNCATE, int, ftruncate64, (int handle, off64_t size), (handle, size), handle)
HANDLE_CALL(FLOCK, int, flock, (int handle, int how), (handle, how), handle)
HANDLE_CALL(CHMOD, int, fchmod, (int handle, mode_t mode), (handle, mode), handle)
HANDLE_CALL(CHOWN, int, fchown, (int handle, uid_t user, gid_t group), (handle, user, group), handle)
HANDLE_CALL(UTIME, int, futimens, (int handle, const struct timespec times[2]), (handle, times), handle)
HANDLE_CALL(STATVFS, int, fstatvfs, (int handle, struct statvfs *status), (handle, status), handle)
HANDLE_CALL(STATVFS, int, fstatvfs64, (int handle, struct statvfs64 *status), (handle, status), handle)
HANDLE_CALL(STATVFS, int, fstatfs, (int handle, struct statfs *status), (handle, status), handle)
HANDLE_CALL(STATVFS, int, fstatfs64, (int handle, struct statfs64 *status), (handle, status), handle)

/* The file of calls stays open where a process that begins a build closes everything that it has not been given. */
extern int close_range(unsigned int first, unsigned int last, int flags);
int close_range(unsigned int first, unsigned int last, int flags)
{
    REAL(close_range);
    unsigned int kept = (unsigned int)calls;
    if (calls < 0 || kept < first || kept > last)
        return real(first, last, flags);
    if (kept > first && real(first, kept - 1, flags) != 0)
        return -1;
    return kept < last ? real(kept + 1, last, flags) : 0;
}

int close(int handle)
{
    if (handle >= 0 && handle == calls)
        return 0;
    REAL(close);
    int fault = handle_fault(CALL_CLOSE, handle);
    int result = real(handle);
    if (fault > 0) {
        errno = fault;
        return -1;
    }
    return result;
}

#define NAMES_CALL(call, name, parameters, arguments, from, old, to, new) \
    int name parameters \
    { \
        REAL(name); \
        return names_fault(CALL_##call, from, old, to, new) > 0 ? -1 : real arguments; \
    }
NAMES_CALL(RENAME, rename, (const char *old, const char *new), (old, new), AT_FDCWD, old, AT_FDCWD, new)
NAMES_CALL(RENAME, renameat, (int from, const char *old, int to, const char *new), (from, old, to, new), from, old, to,
           new)
NAMES_CALL(RENAME, renameat2, (int from, const char *old, int to, const char *new, unsigned int flags),
           (from, old, to, new, flags), from, old, to, new)
NAMES_CALL(LINK, link, (const char *old, const char *new), (old, new), AT_FDCWD, old, AT_FDCWD, new)
NAMES_CALL(LINK, linkat, (int from, const char *old, int to, const char *new, int flags), (from, old, to, new, flags),
           from, old, to, new)

PATH_CALL(SYMLINK, int, symlink, (const char *text, const char *path), (text, path), AT_FDCWD, path)
PATH_CALL(SYMLINK, int, symlinkat, (const char *text, int folder, const char *path), (text, folder, path), folder, path)
PATH_CALL(UNLINK, int, unlink, (const char *path), (path), AT_FDCWD, path)
PATH_CALL(RMDIR, int, rmdir, (const char *path), (path), AT_FDCWD, path)
PATH_CALL(MKDIR, int, mkdir, (const char *path, mode_t mode), (path, mode), AT_FDCWD, path)
PATH_CALL(MKDIR, int, mkdirat, (int folder, const char *path, mode_t mode), (folder, path, mode), folder, path)
PATH_CALL(TRUNCATE, int, truncate, (const char *path, off_t size), (path, size), AT_FDCWD, path)
PATH_CALL(TRUNCATE, int, truncate64, (const char *path, off64_t size), (path, size), AT_FDCWD, path)
PATH_CALL(CHMOD, int, chmod, (const char *path, mode_t mode), (path, mode), AT_FDCWD, path)
PATH_CALL(CHMOD, int, fchmodat, (int folder, const char *path, mode_t mode, int flags), (folder, path, mode, flags),
          folder, path)
PATH_CALL(CHOWN, int, chown, (const char *path, uid_t user, gid_t group), (path, user, group), AT_FDCWD, path)
PATH_CALL(CHOWN, int, lchown, (const char *path, uid_t user, gid_t group), (path, user, group), AT_FDCWD, path)
PATH_CALL(UTIME, int, utimensat, (int folder, const char *path, const struct timespec times[2], int flags),
          (folder, path, times, flags), folder, path)
PATH_CALL(UTIME, int, utime, (const char *path, const struct utimbuf *times), (path, times), AT_FDCWD, path)
PATH_CALL(UTIME, int, utimes, (const char *path, const struct timeval times[2]), (path, times), AT_FDCWD, path)
PATH_CALL(STATVFS, int, statvfs, (const char *path, struct statvfs *status), (path, status), AT_FDCWD, path)
PATH_CALL(STATVFS, int, statvfs64, (const char *path, struct statvfs64 *status), (path, status), AT_FDCWD, path)
PATH_CALL(STATVFS, int, statfs, (const char *path, struct statfs *status), (path, status), AT_FDCWD, path)
PATH_CALL(STATVFS, int, statfs64, (const char *path, struct statfs64 *status), (path, status), AT_FDCWD, path)
PATH_CALL(ACCESS, int, access, (const char *path, int mode), (path, mode), AT_FDCWD, path)
PATH_CALL(ACCESS, int, faccessat, (int folder, const char *path, int mode, int flags), (folder, path, mode, flags),
          folder, path)
PATH_CALL(READLINK, ssize_t, readlink, (const char *path, char *text, size_t size), (path, text, size), AT_FDCWD, path)
PATH_CALL(READLINK, ssize_t, readlinkat, (int folder, const char *path, char *text, size_t size),
          (folder, path, text, size), folder, path)

int unlinkat(int folder, const char *path, int flags)
{
    REAL(unlinkat);
    int call = flags & AT_REMOVEDIR ? CALL_RMDIR : CALL_UNLINK;
    return path_fault(call, folder, path) > 0 ? -1 : real(folder, path, flags);
}

PATH_CALL(STAT, int, stat, (const char *path, struct stat *status), (path, status), AT_FDCWD, path)
PATH_CALL(STAT, int, stat64, (const char *path, struct stat64 *status), (path, status), AT_FDCWD, path)
PATH_CALL(STAT, int, lstat, (const char *path, struct stat *status), (path, status), AT_FDCWD, path)
PATH_CALL(STAT, int, lstat64, (const char *path, struct stat64 *status), (path, status), AT_FDCWD, path)
PATH_CALL(STAT, int, fstatat, (int folder, const char *path, struct stat *status, int flags),
          (folder, path, status, flags), folder, path)
PATH_CALL(STAT, int, fstatat64, (int folder, const char *path, struct stat64 *status, int flags),
          (folder, path, status, flags), folder, path)
PATH_CALL(STAT, int, statx, (int folder, const char *path, int flags, unsigned int mask, struct statx *status),
          (folder, path, flags, mask, status), folder, path)
HANDLE_CALL(FSTAT, int, fstat, (int handle, struct stat *status), (handle, status), handle)
HANDLE_CALL(FSTAT, int, fstat64, (int handle, struct stat64 *status), (handle, status), handle)

/* What programs that were linked with glibc before 2.33 call. */
extern int __xstat(int version, const char *path, struct stat *status);
extern int __xstat64(int version, const char *path, struct stat64 *status);
extern int __lxstat(int version, const char *path, struct stat *status);
extern int __lxstat64(int version, const char *path, struct stat64 *status);
extern int __fxstat(int version, int handle, struct stat *status);
extern int __fxstat64(int version, int handle, struct stat64 *status);
extern int __fxstatat(int version, int folder, const char *path, struct stat *status, int flags);
extern int __fxstatat64(int version, int folder, const char *path, struct stat64 *status, int flags);
PATH_CALL(STAT, int, __xstat, (int version, const char *path, struct stat *status), (version, path, status), AT_FDCWD,
          path)
PATH_CALL(STAT, int, __xstat64, (int version, const char *path, struct stat64 *status), (version, path, status),
          AT_FDCWD, path)
PATH_CALL(STAT, int, __lxstat, (int version, const char *path, struct stat *status), (version, path, status), AT_FDCWD,
          path)
PATH_CALL(STAT, int, __lxstat64, (int version, const char *path, struct stat64 *status), (version, path, status),
          AT_FDCWD, path)
PATH_CALL(STAT, int, __fxstatat, (int version, int folder, const char *path, struct stat *status, int flags),
          (version, folder, path, status, flags), folder, path)
PATH_CALL(STAT, int, __fxstatat64, (int version, int folder, const char *path, struct stat64 *status, int flags),
          (version, folder, path, status, flags), folder, path)
HANDLE_CALL(FSTAT, int, __fxstat, (int version, int handle, struct stat *status), (version, handle, status), handle)
HANDLE_CALL(FSTAT, int, __fxstat64, (int version, int handle, struct stat64 *status), (version, handle, status), handle)

DIR *opendir(const char *path)
{
    REAL(opendir);
    return path_fault(CALL_OPENDIR, AT_FDCWD, path) > 0 ? NULL : real(path);
}

DIR *fdopendir(int handle)
{
    REAL(fdopendir);
    return handle_fault(CALL_OPENDIR, handle) > 0 ? NULL : real(handle);
}

struct dirent *readdir(DIR *folder)
{
    REAL(readdir);
    return handle_fault(CALL_READDIR, dirfd(folder)) > 0 ? NULL : real(folder);
}

struct dirent64 *readdir64(DIR *folder)
{
    REAL(readdir64);
    return handle_fault(CALL_READDIR, dirfd(folder)) > 0 ? NULL : real(folder);
}
