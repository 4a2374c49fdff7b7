/* A library for LD_PRELOAD that counts the calls which change files below a folder, and lets one of them fail.
 *
 * Counted are calls whose path lies below the folder, or whose file does: opening for writing, writing, fsync, renaming,
 * making and removing files, folders and links, cutting off, locking, times and modes. `shim_arm` says at which call,
 * and how; the environment says the same for a program that cannot be asked (SHIM_ROOT, SHIM_AT, SHIM_HOW, SHIM_LOG).
 *
 *   cc -shared -fPIC -O2 -o shim.so shim.c -ldl
 */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/time.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>
#include <utime.h>

enum { ONCE = 0, FROM_NOW_ON = 1 };
enum { HALF = -1, KILL = -2 }; /* other values of `how` are an errno */

static char root[PATH_MAX];
static size_t root_length;
static long calls, at;
static int how, lasting, log_fd = -1, halved;

void shim_arm(const char *folder, long number, int kind, int from_now_on, int log)
{
    snprintf(root, sizeof root, "%s", folder);
    root_length = strlen(root);
    calls = halved = 0;
    at = number, how = kind, lasting = from_now_on, log_fd = log;
}

long shim_calls(void) { return calls; }

__attribute__((constructor)) static void from_environment(void)
{
    const char *folder = getenv("SHIM_ROOT"), *number = getenv("SHIM_AT"), *kind = getenv("SHIM_HOW");
    const char *lasts = getenv("SHIM_LASTS"), *log = getenv("SHIM_LOG");
    if (folder)
        shim_arm(folder, number ? atol(number) : 0, kind ? atoi(kind) : EIO, lasts && *lasts == '1',
                 log ? open(log, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0666) : -1);
}

static int below(const char *path)
{
    return root_length && !strncmp(path, root, root_length) && (path[root_length] == '/' || !path[root_length]);
}

static int named(int folder, const char *path, char *found)
{
    char link[64], start[PATH_MAX];
    ssize_t length;
    if (!root_length || !path)
        return 0;
    if (path[0] == '/') {
        snprintf(found, PATH_MAX, "%s", path);
        return below(found);
    }
    if (folder == AT_FDCWD)
        snprintf(link, sizeof link, "/proc/self/cwd");
    else
        snprintf(link, sizeof link, "/proc/self/fd/%d", folder);
    length = readlink(link, start, sizeof start - 1);
    if (length < 0)
        return 0;
    start[length] = 0;
    if (snprintf(found, PATH_MAX, "%s/%s", start, path) >= PATH_MAX)
        return 0;
    return below(found);
}

static int opened(int fd, char *found)
{
    char link[64];
    ssize_t length;
    if (!root_length || fd == log_fd)
        return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    length = readlink(link, found, PATH_MAX - 1);
    if (length < 0)
        return 0;
    found[length] = 0;
    return below(found);
}

static ssize_t (*plain_write)(int, const void *, size_t);

/* Count a call; nonzero, with errno, when it is to fail. `bytes` (0: none are written) lets a write be halved: then
 * *bytes is what may still be written, and the next write fails. */
static int fails(const char *call, const char *path, size_t *bytes)
{
    char line[PATH_MAX + 64];
    int saved = errno;
    calls++;
    if (log_fd >= 0) {
        int length = snprintf(line, sizeof line, "%ld %s %s\n", calls, call, path);
        plain_write = plain_write ? plain_write : dlsym(RTLD_NEXT, "write");
        if (plain_write(log_fd, line, length) < 0)
            log_fd = -1;
    }
    errno = saved;
    if (halved && bytes) {
        halved = lasting;
        errno = ENOSPC;
        return 1;
    }
    if (!at || calls < at || (calls > at && !lasting))
        return 0;
    if (how == HALF) {
        if (bytes && *bytes > 1 && calls == at) {
            *bytes /= 2;
            halved = 1;
        }
        return 0;
    }
    if (how == KILL) {
        if (bytes && *bytes > 1) {
            *bytes /= 2;
            halved = KILL;
            return 0;
        }
        kill(getpid(), SIGKILL);
    }
    /* A full disk and a folder that is closed let go what is there. */
    if (lasting && how == ENOSPC && (strstr(call, "unlink") || strstr(call, "rmdir") || !strcmp(call, "flock")))
        return 0;
    errno = how;
    return 1;
}

static void after_half(void)
{
    if (halved == KILL)
        kill(getpid(), SIGKILL);
}

#define REAL(type, name, ...) static type (*real)(__VA_ARGS__); if (!real) real = dlsym(RTLD_NEXT, #name)
#define WRITING (O_WRONLY | O_RDWR | O_CREAT | O_TRUNC)

#define OPEN(name)                                                                                                  \
    int name(const char *path, int flags, ...)                                                                      \
    {                                                                                                               \
        char found[PATH_MAX];                                                                                       \
        va_list more;                                                                                               \
        va_start(more, flags);                                                                                      \
        mode_t mode = va_arg(more, mode_t);                                                                         \
        va_end(more);                                                                                               \
        REAL(int, name, const char *, int, ...);                                                                    \
        if (flags & WRITING && named(AT_FDCWD, path, found) && fails(#name, found, NULL))                           \
            return -1;                                                                                              \
        return real(path, flags, mode);                                                                             \
    }
OPEN(open)
OPEN(open64)

#define OPENAT(name)                                                                                                \
    int name(int folder, const char *path, int flags, ...)                                                          \
    {                                                                                                               \
        char found[PATH_MAX];                                                                                       \
        va_list more;                                                                                               \
        va_start(more, flags);                                                                                      \
        mode_t mode = va_arg(more, mode_t);                                                                         \
        va_end(more);                                                                                               \
        REAL(int, name, int, const char *, int, ...);                                                               \
        if (flags & WRITING && named(folder, path, found) && fails(#name, found, NULL))                             \
            return -1;                                                                                              \
        return real(folder, path, flags, mode);                                                                     \
    }
OPENAT(openat)
OPENAT(openat64)

#define FOPEN(name)                                                                                                 \
    FILE *name(const char *path, const char *mode)                                                                  \
    {                                                                                                               \
        char found[PATH_MAX];                                                                                       \
        REAL(FILE *, name, const char *, const char *);                                                             \
        if (strpbrk(mode, "wa+") && named(AT_FDCWD, path, found) && fails(#name, found, NULL))                      \
            return NULL;                                                                                            \
        return real(path, mode);                                                                                    \
    }
FOPEN(fopen)
FOPEN(fopen64)

/* Calls that write `count` bytes to a file. */
#define WRITE(name, type, parameters, types, count, ...)                                                            \
    type name parameters                                                                                            \
    {                                                                                                               \
        char found[PATH_MAX];                                                                                       \
        REAL(type, name, types);                                                                                    \
        if (opened(fd, found) && fails(#name, found, &count))                                                       \
            return -1;                                                                                              \
        type done = real(__VA_ARGS__);                                                                              \
        after_half();                                                                                               \
        return done;                                                                                                \
    }
#define TYPES(...) __VA_ARGS__
WRITE(write, ssize_t, (int fd, const void *data, size_t count), TYPES(int, const void *, size_t), count, fd, data, count)
WRITE(pwrite, ssize_t, (int fd, const void *data, size_t count, off_t place), TYPES(int, const void *, size_t, off_t),
      count, fd, data, count, place)
WRITE(pwrite64, ssize_t, (int fd, const void *data, size_t count, off64_t place),
      TYPES(int, const void *, size_t, off64_t), count, fd, data, count, place)
WRITE(sendfile, ssize_t, (int fd, int from, off_t *place, size_t count), TYPES(int, int, off_t *, size_t), count, fd,
      from, place, count)
WRITE(sendfile64, ssize_t, (int fd, int from, off64_t *place, size_t count), TYPES(int, int, off64_t *, size_t), count,
      fd, from, place, count)
WRITE(copy_file_range, ssize_t, (int from, off64_t *start, int fd, off64_t *place, size_t count, unsigned flags),
      TYPES(int, off64_t *, int, off64_t *, size_t, unsigned), count, from, start, fd, place, count, flags)

/* Calls of an open file. */
#define OF_FILE(name, parameters, types, ...)                                                                       \
    int name parameters                                                                                             \
    {                                                                                                               \
        char found[PATH_MAX];                                                                                       \
        REAL(int, name, types);                                                                                     \
        return opened(fd, found) && fails(#name, found, NULL) ? -1 : real(__VA_ARGS__);                             \
    }
OF_FILE(fsync, (int fd), TYPES(int), fd)
OF_FILE(fdatasync, (int fd), TYPES(int), fd)
OF_FILE(ftruncate, (int fd, off_t length), TYPES(int, off_t), fd, length)
OF_FILE(ftruncate64, (int fd, off64_t length), TYPES(int, off64_t), fd, length)
OF_FILE(flock, (int fd, int kind), TYPES(int, int), fd, kind)
OF_FILE(futimens, (int fd, const struct timespec *times), TYPES(int, const struct timespec *), fd, times)
OF_FILE(fchmod, (int fd, mode_t mode), TYPES(int, mode_t), fd, mode)

ssize_t writev(int fd, const struct iovec *parts, int count)
{
    char found[PATH_MAX];
    REAL(ssize_t, writev, int, const struct iovec *, int);
    return opened(fd, found) && fails("writev", found, NULL) ? -1 : real(fd, parts, count);
}

/* Calls of a path. */
#define OF_PATH(name, folder, parameters, types, ...)                                                               \
    int name parameters                                                                                             \
    {                                                                                                               \
        char found[PATH_MAX];                                                                                       \
        REAL(int, name, types);                                                                                     \
        return named(folder, path, found) && fails(#name, found, NULL) ? -1 : real(__VA_ARGS__);                    \
    }
OF_PATH(creat, AT_FDCWD, (const char *path, mode_t mode), TYPES(const char *, mode_t), path, mode)
OF_PATH(creat64, AT_FDCWD, (const char *path, mode_t mode), TYPES(const char *, mode_t), path, mode)
OF_PATH(mkdir, AT_FDCWD, (const char *path, mode_t mode), TYPES(const char *, mode_t), path, mode)
OF_PATH(mkdirat, at, (int at, const char *path, mode_t mode), TYPES(int, const char *, mode_t), at, path, mode)
OF_PATH(unlink, AT_FDCWD, (const char *path), TYPES(const char *), path)
OF_PATH(unlinkat, at, (int at, const char *path, int flags), TYPES(int, const char *, int), at, path, flags)
OF_PATH(rmdir, AT_FDCWD, (const char *path), TYPES(const char *), path)
OF_PATH(truncate, AT_FDCWD, (const char *path, off_t length), TYPES(const char *, off_t), path, length)
OF_PATH(truncate64, AT_FDCWD, (const char *path, off64_t length), TYPES(const char *, off64_t), path, length)
OF_PATH(utime, AT_FDCWD, (const char *path, const struct utimbuf *times), TYPES(const char *, const struct utimbuf *),
        path, times)
OF_PATH(utimes, AT_FDCWD, (const char *path, const struct timeval *times), TYPES(const char *, const struct timeval *),
        path, times)
OF_PATH(utimensat, at, (int at, const char *path, const struct timespec *times, int flags),
        TYPES(int, const char *, const struct timespec *, int), at, path, times, flags)
OF_PATH(chmod, AT_FDCWD, (const char *path, mode_t mode), TYPES(const char *, mode_t), path, mode)
OF_PATH(fchmodat, at, (int at, const char *path, mode_t mode, int flags), TYPES(int, const char *, mode_t, int), at,
        path, mode, flags)
/* Where something is moved or linked to. */
OF_PATH(rename, AT_FDCWD, (const char *from, const char *path), TYPES(const char *, const char *), from, path)
OF_PATH(renameat, at, (int start, const char *from, int at, const char *path),
        TYPES(int, const char *, int, const char *), start, from, at, path)
OF_PATH(renameat2, at, (int start, const char *from, int at, const char *path, unsigned flags),
        TYPES(int, const char *, int, const char *, unsigned), start, from, at, path, flags)
OF_PATH(link, AT_FDCWD, (const char *from, const char *path), TYPES(const char *, const char *), from, path)
OF_PATH(linkat, at, (int start, const char *from, int at, const char *path, int flags),
        TYPES(int, const char *, int, const char *, int), start, from, at, path, flags)
OF_PATH(symlink, AT_FDCWD, (const char *from, const char *path), TYPES(const char *, const char *), from, path)
OF_PATH(symlinkat, at, (const char *from, int at, const char *path), TYPES(const char *, int, const char *), from, at,
        path)
