/* Preloaded by torture.py: counts what changes files below a folder, and lets one such call fail or kill.

   The control is a file that all processes of a trial map: torture_map(path) maps it here, and a program that is
   started with KERV_TORTURE=path maps it by itself. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <time.h>
#include <unistd.h>

enum kind { COUNT, KILL, TORN, NO_SPACE, BROKEN, FULL, KILL_FIRST, SLOW, CLOCK }; /* as Fault.KINDS in torture_runs.py */

struct control {
    atomic_int done;  /* calls so far, of all processes */
    int at;           /* the one that fails, from 1 */
    int kind, first;  /* first: the process that is the command */
    char root[1000];
};

static struct control *control;

void torture_map(const char *path) {
    int file = open(path, O_RDWR | O_CLOEXEC);
    void *there = mmap(NULL, sizeof *control, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    close(file);
    control = there == MAP_FAILED ? NULL : there;
}

__attribute__((constructor)) static void begin(void) {
    if (getenv("KERV_TORTURE")) torture_map(getenv("KERV_TORTURE"));
}

static int below(int folder, const char *path) {
    char whole[9000], link[64];
    ssize_t length = 0;
    if (!control) return 0;
    if (path == NULL || path[0] != '/') {
        if (folder == AT_FDCWD) strcpy(link, "/proc/self/cwd");
        else snprintf(link, sizeof link, "/proc/self/fd/%d", folder);
        length = readlink(link, whole, 4000);
        if (length < 0) return 0;
        whole[length++] = '/';
    }
    snprintf(whole + length, 4096, "%s", path ? path : "");
    return strncmp(whole, control->root, strlen(control->root)) == 0;
}

/* What becomes of this call: 0, an error number, or the end of this process. torn: half of it is done first. */
static int verdict(int folder, const char *path, int *torn) {
    if (!below(folder, path)) return 0;
    int number = atomic_fetch_add(&control->done, 1) + 1, kind = control->kind;
    if (kind == FULL && control->at && number >= control->at) return ENOSPC;
    if (kind == SLOW && control->at && number >= control->at) usleep(50000);
    if (number != control->at) return 0;
    if (kind == NO_SPACE) return ENOSPC;
    if (kind == BROKEN) return EIO;
    if (kind == TORN && torn) return *torn = 1, 0;
    if (kind == KILL_FIRST) kill(control->first, SIGKILL);
    else if (kind == KILL || kind == TORN) kill(getpid(), SIGKILL);
    return 0;
}

static void jump(time_t *seconds) {
    if (control && control->kind == CLOCK && control->done >= control->at) *seconds += control->at % 2 ? 90000 : -90000;
}

#define REAL(name) \
    static __typeof__(&name) real; \
    if (!real) real = (__typeof__(&name))dlsym(RTLD_NEXT, #name)
#define GUARDED(type, name, parameters, arguments, folder, path) \
    type name parameters { \
        REAL(name); \
        int error = verdict(folder, path, NULL); \
        return error ? (errno = error, -1) : real arguments; \
    }
#define OPENING(name, parameters, folder, path, ...) \
    int name parameters { \
        REAL(name); \
        va_list rest; \
        va_start(rest, flags); \
        int mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(rest, int) : 0; \
        va_end(rest); \
        int writes = flags & (O_CREAT | O_WRONLY | O_RDWR | O_TRUNC); \
        int error = writes ? verdict(folder, path, NULL) : 0; \
        return error ? (errno = error, -1) : real(__VA_ARGS__, mode); \
    }
#define WRITING(name, parameters, size, whole, half) \
    ssize_t name parameters { \
        REAL(name); \
        int torn = 0, error = verdict(file, NULL, &torn); \
        if (torn) real half, kill(getpid(), SIGKILL); \
        return error ? (errno = error, -1) : real whole; \
    }

OPENING(open, (const char *path, int flags, ...), AT_FDCWD, path, path, flags)
OPENING(open64, (const char *path, int flags, ...), AT_FDCWD, path, path, flags)
OPENING(openat, (int folder, const char *path, int flags, ...), folder, path, folder, path, flags)
OPENING(openat64, (int folder, const char *path, int flags, ...), folder, path, folder, path, flags)
WRITING(write, (int file, const void *from, size_t size), size, (file, from, size), (file, from, size / 2))
WRITING(writev, (int file, const struct iovec *parts, int count), count, (file, parts, count), (file, parts, count / 2))
WRITING(pwrite, (int file, const void *from, size_t size, off_t at), size, (file, from, size, at), (file, from, size / 2, at))
WRITING(pwrite64, (int file, const void *from, size_t size, off64_t at), size, (file, from, size, at),
        (file, from, size / 2, at))
int clock_gettime(clockid_t which, struct timespec *now) {
    REAL(clock_gettime);
    int failed = real(which, now);
    if (which == CLOCK_REALTIME) jump(&now->tv_sec);
    return failed;
}
GUARDED(int, rename, (const char *a, const char *b), (a, b), AT_FDCWD, b)
GUARDED(int, renameat, (int x, const char *a, int y, const char *b), (x, a, y, b), y, b)
GUARDED(int, renameat2, (int x, const char *a, int y, const char *b, unsigned f), (x, a, y, b, f), y, b)
GUARDED(int, link, (const char *a, const char *b), (a, b), AT_FDCWD, b)
GUARDED(int, linkat, (int x, const char *a, int y, const char *b, int f), (x, a, y, b, f), y, b)
GUARDED(int, symlink, (const char *a, const char *b), (a, b), AT_FDCWD, b)
GUARDED(int, unlink, (const char *a), (a), AT_FDCWD, a)
GUARDED(int, unlinkat, (int x, const char *a, int f), (x, a, f), x, a)
GUARDED(int, rmdir, (const char *a), (a), AT_FDCWD, a)
GUARDED(int, mkdir, (const char *a, mode_t m), (a, m), AT_FDCWD, a)
GUARDED(int, mkdirat, (int x, const char *a, mode_t m), (x, a, m), x, a)
GUARDED(int, ftruncate, (int file, off_t size), (file, size), file, NULL)
GUARDED(int, ftruncate64, (int file, off64_t size), (file, size), file, NULL)
GUARDED(int, fsync, (int file), (file), file, NULL)
GUARDED(int, fdatasync, (int file), (file), file, NULL)
