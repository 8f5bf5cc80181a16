/* Records what a process does to the files under $DISK_ROOT, and makes one of these calls fail: LD_PRELOAD this.
 *
 * $DISK_LOG gets one entry a call: kind, length of path, length of data, offset, path, data. Writes to $DISK_ACKS are
 * entries of kind 'a': what the process takes for safe. Call number $DISK_FAIL_AT (and those after it, when
 * $DISK_FAIL_ALL is set) fails with $DISK_FAIL_ERRNO and is not recorded.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static int log_fd = -1;
static long calls = 0;

static int under(const char *path) {
    const char *root = getenv("DISK_ROOT");
    size_t n = root ? strlen(root) : 0;
    return n && strncmp(path, root, n) == 0 && (path[n] == '/' || path[n] == 0) && !strstr(path, "-shm");
}

static int is_acks(const char *path) {
    const char *acks = getenv("DISK_ACKS");
    return acks && strcmp(path, acks) == 0;
}

static int path_of(int fd, char *path) {
    char link[64];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(link, path, PATH_MAX - 1);
    path[n < 0 ? 0 : n] = 0;
    return n > 0;
}

static void note(char kind, const char *path, const void *data, uint32_t size, int64_t offset) {
    uint32_t length = strlen(path);
    if (log_fd < 0) {
        const char *file = getenv("DISK_LOG");
        log_fd = file ? syscall(SYS_openat, AT_FDCWD, file, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600) : -1;
        if (log_fd < 0) return;
    }
    pthread_mutex_lock(&lock);
    syscall(SYS_write, log_fd, &kind, 1);
    syscall(SYS_write, log_fd, &length, 4);
    syscall(SYS_write, log_fd, &size, 4);
    syscall(SYS_write, log_fd, &offset, 8);
    syscall(SYS_write, log_fd, path, length);
    if (size) syscall(SYS_write, log_fd, data, size);
    pthread_mutex_unlock(&lock);
}

/* Whether this call is the one to fail; sets errno. */
static int fails(void) {
    const char *at = getenv("DISK_FAIL_AT"), *number = getenv("DISK_FAIL_ERRNO");
    long now = __sync_add_and_fetch(&calls, 1);
    if (!at || !(now == atol(at) || (getenv("DISK_FAIL_ALL") && now > atol(at)))) return 0;
    errno = number ? atoi(number) : EIO;
    return 1;
}

static int open_noted(int dir, const char *path, int flags, mode_t mode) {
    char full[PATH_MAX];
    int creates = 0, truncates = 0;
    if (under(path) && (flags & O_CREAT)) {
        creates = access(path, F_OK) != 0;
        truncates = !creates && (flags & O_TRUNC);
        if ((creates || truncates) && fails()) return -1;
    }
    int fd = syscall(SYS_openat, dir, path, flags, mode);
    if (fd >= 0 && (creates || truncates) && path_of(fd, full)) note(creates ? 'c' : 't', full, NULL, 0, 0);
    return fd;
}

#define MODE(flags) mode_t mode = 0; if ((flags) & (O_CREAT | O_TMPFILE)) { va_list l; va_start(l, flags); mode = va_arg(l, mode_t); va_end(l); }
int open(const char *path, int flags, ...) { MODE(flags) return open_noted(AT_FDCWD, path, flags, mode); }
int open64(const char *path, int flags, ...) { MODE(flags) return open_noted(AT_FDCWD, path, flags, mode); }
int openat(int dir, const char *path, int flags, ...) { MODE(flags) return open_noted(dir, path, flags, mode); }
int openat64(int dir, const char *path, int flags, ...) { MODE(flags) return open_noted(dir, path, flags, mode); }

ssize_t write(int fd, const void *data, size_t size) {
    char path[PATH_MAX];
    int known = path_of(fd, path);
    if (known && is_acks(path)) { note('a', path, data, size, 0); return size; }
    if (!known || !under(path)) return syscall(SYS_write, fd, data, size);
    if (fails()) return -1;
    int64_t at = lseek(fd, 0, SEEK_CUR);
    ssize_t done = syscall(SYS_write, fd, data, size);
    if (done > 0) note('w', path, data, done, at);
    return done;
}

static ssize_t pwrite_noted(int fd, const void *data, size_t size, off64_t at) {
    char path[PATH_MAX];
    int mine = path_of(fd, path) && under(path);
    if (mine && fails()) return -1;
    ssize_t done = syscall(SYS_pwrite64, fd, data, size, at);
    if (mine && done > 0) note('w', path, data, done, at);
    return done;
}
ssize_t pwrite(int fd, const void *data, size_t size, off_t at) { return pwrite_noted(fd, data, size, at); }
ssize_t pwrite64(int fd, const void *data, size_t size, off64_t at) { return pwrite_noted(fd, data, size, at); }

static int sync_noted(long call, int fd) {
    char path[PATH_MAX];
    int mine = path_of(fd, path) && under(path);
    if (mine && fails()) return -1;
    int found = syscall(call, fd);
    if (mine && found == 0) note('s', path, NULL, 0, 0);
    return found;
}
int fsync(int fd) { return sync_noted(SYS_fsync, fd); }
int fdatasync(int fd) { return sync_noted(SYS_fdatasync, fd); }

static int truncate_noted(int fd, off64_t size) {
    char path[PATH_MAX];
    int mine = path_of(fd, path) && under(path);
    if (mine && fails()) return -1;
    int found = syscall(SYS_ftruncate, fd, size);
    if (mine && found == 0) note('t', path, NULL, 0, size);
    return found;
}
int ftruncate(int fd, off_t size) { return truncate_noted(fd, size); }
int ftruncate64(int fd, off64_t size) { return truncate_noted(fd, size); }

int rename(const char *from, const char *to) {
    if (!under(from)) return syscall(SYS_renameat, AT_FDCWD, from, AT_FDCWD, to);
    if (fails()) return -1;
    int found = syscall(SYS_renameat, AT_FDCWD, from, AT_FDCWD, to);
    if (found == 0) note('r', from, to, strlen(to), 0);
    return found;
}

static int remove_noted(const char *path, int flags) {
    if (under(path) && access(path, F_OK) == 0 && fails()) return -1;
    int found = syscall(SYS_unlinkat, AT_FDCWD, path, flags);
    if (found == 0 && under(path)) note('u', path, NULL, 0, 0);
    return found;
}
int unlink(const char *path) { return remove_noted(path, 0); }

int mkdir(const char *path, mode_t mode) {
    if (under(path) && access(path, F_OK) != 0 && fails()) return -1;
    int found = syscall(SYS_mkdirat, AT_FDCWD, path, mode);
    if (found == 0 && under(path)) note('m', path, NULL, 0, 0);
    return found;
}
