/* Makes the n-th call of the operating system that writes fail: loaded before libc by the tests of the store. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stddef.h>
#include <sys/types.h>
#include <unistd.h>

static long counted, failing = -1;
static int code, persistent, shortened, armed;

void fault_arm(long n, int error, int stays, int short_write) {
    counted = 0; failing = n; code = error; persistent = stays; shortened = short_write; armed = 1;
}
long fault_disarm(void) { armed = 0; return counted; }

static int fails(void) {
    if (!armed) return 0;
    counted++;
    return persistent ? counted >= failing : counted == failing;
}

#define REAL(name) static __typeof__(name) *real; if (!real) real = (__typeof__(name) *)dlsym(RTLD_NEXT, #name)
#define REFUSE do { errno = code; return -1; } while (0)

ssize_t write(int fd, const void *data, size_t size) {
    REAL(write);
    if (fails()) { if (shortened && size > 1) return real(fd, data, size / 2); REFUSE; }
    return real(fd, data, size);
}
ssize_t pwrite(int fd, const void *data, size_t size, off_t at) {
    REAL(pwrite);
    if (fails()) { if (shortened && size > 1) return real(fd, data, size / 2, at); REFUSE; }
    return real(fd, data, size, at);
}
ssize_t pwrite64(int fd, const void *data, size_t size, off64_t at) {
    REAL(pwrite64);
    if (fails()) { if (shortened && size > 1) return real(fd, data, size / 2, at); REFUSE; }
    return real(fd, data, size, at);
}
int fsync(int fd) { REAL(fsync); if (!shortened && fails()) REFUSE; return real(fd); }
int fdatasync(int fd) { REAL(fdatasync); if (!shortened && fails()) REFUSE; return real(fd); }
int ftruncate(int fd, off_t size) { REAL(ftruncate); if (!shortened && fails()) REFUSE; return real(fd, size); }
int ftruncate64(int fd, off64_t size) { REAL(ftruncate64); if (!shortened && fails()) REFUSE; return real(fd, size); }
int rename(const char *a, const char *b) { REAL(rename); if (!shortened && fails()) REFUSE; return real(a, b); }
int link(const char *a, const char *b) { REAL(link); if (!shortened && fails()) REFUSE; return real(a, b); }
int linkat(int x, const char *a, int y, const char *b, int flags) {
    REAL(linkat);
    if (!shortened && fails()) REFUSE;
    return real(x, a, y, b, flags);
}
int unlink(const char *a) { REAL(unlink); if (!shortened && fails()) REFUSE; return real(a); }
int chmod(const char *a, mode_t mode) { REAL(chmod); if (!shortened && fails()) REFUSE; return real(a, mode); }
int mkdir(const char *a, mode_t mode) { REAL(mkdir); if (!shortened && fails()) REFUSE; return real(a, mode); }

static int creating(int flags) { return (flags & (O_WRONLY | O_RDWR)) && !shortened; }
int open(const char *path, int flags, ...) {
    REAL(open);
    va_list rest; va_start(rest, flags); int mode = va_arg(rest, int); va_end(rest);
    if (creating(flags) && fails()) REFUSE;
    return real(path, flags, mode);
}
int open64(const char *path, int flags, ...) {
    REAL(open64);
    va_list rest; va_start(rest, flags); int mode = va_arg(rest, int); va_end(rest);
    if (creating(flags) && fails()) REFUSE;
    return real(path, flags, mode);
}
