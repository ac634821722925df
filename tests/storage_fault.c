/* Storage that fails: reads of LEAST bytes or more from files whose path holds FAULT_NAME end with FAULT_ERRNO while the
   file FAULT_FLAG exists, and so do opens where FAULT_OPEN is set. To be preloaded. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/uio.h>
#include <unistd.h>

static int failing(const char *path) {
  const char *flag = getenv("FAULT_FLAG"), *name = getenv("FAULT_NAME"), *number = getenv("FAULT_ERRNO");
  if (!flag || !name || !strstr(path, name) || access(flag, F_OK)) return 0;
  errno = number ? atoi(number) : EIO;
  return 1;
}

static int reading(int file, size_t bytes) {
  const char *least = getenv("FAULT_LEAST");
  char link[64], path[4096];
  if (bytes < (size_t)(least ? atoi(least) : 1)) return 0;
  snprintf(link, sizeof link, "/proc/self/fd/%d", file);
  ssize_t length = readlink(link, path, sizeof path - 1);
  if (length < 0) return 0;
  path[length] = 0;
  return failing(path);
}

#define READ(NAME, TYPES, ...)                                  \
  ssize_t NAME TYPES {                                          \
    static ssize_t(*real) TYPES;                                \
    if (!real) real = dlsym(RTLD_NEXT, #NAME);                  \
    return reading(file, bytes) ? -1 : real(__VA_ARGS__);       \
  }
READ(read, (int file, void *to, size_t bytes), file, to, bytes)
READ(pread, (int file, void *to, size_t bytes, off_t from), file, to, bytes, from)
READ(pread64, (int file, void *to, size_t bytes, off64_t from), file, to, bytes, from)

static size_t total(const struct iovec *to, int count) { return count ? to->iov_len + total(to + 1, count - 1) : 0; }

/* Python's os.preadv calls the second form. */
#define READV(NAME, OFFSET)                                                               \
  ssize_t NAME(int file, const struct iovec *to, int count, OFFSET from, int how) {       \
    static ssize_t (*real)(int, const struct iovec *, int, OFFSET, int);                  \
    if (!real) real = dlsym(RTLD_NEXT, #NAME);                                            \
    return reading(file, total(to, count)) ? -1 : real(file, to, count, from, how);       \
  }
READV(preadv2, off_t)
READV(preadv64v2, off64_t)

#define OPEN(NAME)                                              \
  int NAME(const char *path, int how, ...) {                    \
    static int (*real)(const char *, int, ...);                 \
    if (!real) real = dlsym(RTLD_NEXT, #NAME);                  \
    va_list more;                                               \
    va_start(more, how);                                        \
    int mode = va_arg(more, int);                               \
    va_end(more);                                               \
    return getenv("FAULT_OPEN") && failing(path) ? -1 : real(path, how, mode); \
  }
OPEN(open)
OPEN(open64)
