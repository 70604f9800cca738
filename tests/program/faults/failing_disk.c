/* Makes calls on files fail when told, for tests of what a service does then: preloaded into its process.
 *
 * FAILING_DISK_FILES is how the paths of the files begin. FAILING_DISK_ORDERS is a file with at most one order:
 * which call (write, sync, truncate), the errno that it fails with, and how many calls pass before. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/types.h>
#include <unistd.h>

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static char last_order[64];
static int n_passed;

/* The errno that this call on this file is to fail with; 0 if it is not. */
static int order(const char *call, int fd) {
    const char *files = getenv("FAILING_DISK_FILES"), *orders = getenv("FAILING_DISK_ORDERS");
    char link[64], path[4096], text[64] = "", name[16];
    int code = 0, n_passing = 0, fails = 0;
    if (!files || !orders) return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(link, path, sizeof path - 1);
    if (n < 0) return 0;
    path[n] = 0;
    if (strncmp(path, files, strlen(files)) != 0) return 0;
    int file = open(orders, O_RDONLY | O_CLOEXEC);
    if (file < 0) return 0;
    n = read(file, text, sizeof text - 1);
    close(file);
    text[n < 0 ? 0 : n] = 0;
    pthread_mutex_lock(&lock);
    if (strcmp(text, last_order) != 0) {
        strcpy(last_order, text);
        n_passed = 0;
    }
    if (sscanf(text, "%15s %d %d", name, &code, &n_passing) >= 2 && strcmp(name, call) == 0)
        fails = n_passed++ >= n_passing;
    pthread_mutex_unlock(&lock);
    return fails ? code : 0;
}

#define FAIL_IF_TOLD(call, fd)           \
    do {                                 \
        int code = order(call, fd);      \
        if (code) {                      \
            errno = code;                \
            return -1;                   \
        }                                \
    } while (0)

#define REAL(name, type) ((type)dlsym(RTLD_NEXT, name))

ssize_t write(int fd, const void *bytes, size_t n) {
    FAIL_IF_TOLD("write", fd);
    return REAL("write", ssize_t (*)(int, const void *, size_t))(fd, bytes, n);
}

ssize_t pwrite(int fd, const void *bytes, size_t n, off_t at) {
    FAIL_IF_TOLD("write", fd);
    return REAL("pwrite", ssize_t (*)(int, const void *, size_t, off_t))(fd, bytes, n, at);
}

ssize_t pwrite64(int fd, const void *bytes, size_t n, off64_t at) {
    FAIL_IF_TOLD("write", fd);
    return REAL("pwrite64", ssize_t (*)(int, const void *, size_t, off64_t))(fd, bytes, n, at);
}

int fsync(int fd) {
    FAIL_IF_TOLD("sync", fd);
    return REAL("fsync", int (*)(int))(fd);
}

int fdatasync(int fd) {
    FAIL_IF_TOLD("sync", fd);
    return REAL("fdatasync", int (*)(int))(fd);
}

int ftruncate(int fd, off_t n) {
    FAIL_IF_TOLD("truncate", fd);
    return REAL("ftruncate", int (*)(int, off_t))(fd, n);
}

int ftruncate64(int fd, off64_t n) {
    FAIL_IF_TOLD("truncate", fd);
    return REAL("ftruncate64", int (*)(int, off64_t))(fd, n);
}
