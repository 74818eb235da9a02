/* Let one disk operation fail, or kill the process there.
 *
 * LD_PRELOAD loads this library before every other one, so it sees the file operations of Python,
 * Arrow, torch, rerun and the processes they start. A file that all processes and the test map says
 * what to count, which operation fails and how; see disk.py.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

struct orders {
    int64_t count;      /* operations below the folder so far */
    int64_t fail_at;    /* number of the operation that fails, from 0; below 0: none */
    int32_t error;      /* errno; 0: the process is killed */
    int32_t stays;      /* whether all later operations fail too */
    char folder[1024];  /* where to count; empty: nowhere */
    char failed[1024];  /* the first operation that failed */
};

static struct orders *orders;

__attribute__((constructor)) static void begin(void)
{
    const char *name = getenv("DMRL_TEST_DISK");
    if (name == NULL)
        return;
    int held = (int)syscall(SYS_openat, AT_FDCWD, name, O_RDWR | O_CLOEXEC);
    if (held < 0)
        return;
    void *found = mmap(NULL, sizeof *orders, PROT_READ | PROT_WRITE, MAP_SHARED, held, 0);
    if (found != MAP_FAILED)
        orders = found;
    syscall(SYS_close, held);
}

static int mine(const char *path)
{
    size_t length = strlen(orders->folder);
    return length && strncmp(path, orders->folder, length) == 0;
}

/* Return the full path of a name in an open folder. */
static const char *whole(int folder, const char *path, char *into, size_t size)
{
    if (path == NULL || path[0] == '/')
        return path == NULL ? "" : path;
    char link[40];
    ssize_t n;
    if (folder == AT_FDCWD)
        strcpy(link, "/proc/self/cwd");
    else
        snprintf(link, sizeof link, "/proc/self/fd/%d", folder);
    n = syscall(SYS_readlinkat, AT_FDCWD, link, into, size - 1);
    if (n < 0)
        return "";
    into[n] = 0;
    if (path[0])
        snprintf(into + n, size - (size_t)n, "/%s", path);
    return into;
}

static int fails_now(const char *what, const char *path)
{
    int64_t number = __atomic_fetch_add(&orders->count, 1, __ATOMIC_SEQ_CST);
    int64_t at = orders->fail_at;
    if (at < 0 || number < at || (number > at && !orders->stays))
        return 0;
    if (number == at)
        snprintf(orders->failed, sizeof orders->failed, "%s %s", what, path);
    if (orders->error == 0)
        kill(getpid(), SIGKILL);
    errno = orders->error;
    return 1;
}

/* Return whether an operation fails. `changes`: a full or read-only disk would refuse it. */
static int fails(const char *what, int folder, const char *path, int changes)
{
    char into[4096];
    if (orders == NULL || orders->folder[0] == 0)
        return 0;
    int before = errno;
    const char *name = whole(folder, path, into, sizeof into);
    int only_reads = !changes && orders->stays && orders->error != EIO;
    if (!mine(name) || only_reads || !fails_now(what, name)) {
        errno = before;
        return 0;
    }
    return 1;
}

static int fails_on(const char *what, int held)
{
    return fails(what, held, "", 1);
}

/* Return whether the disk refuses to remove a file. Removing is not counted as an operation. */
static int keeps(int folder, const char *path)
{
    char into[4096];
    if (orders == NULL || orders->folder[0] == 0 || !orders->stays || orders->fail_at < 0)
        return 0;
    if (orders->error != EIO && orders->error != EROFS)
        return 0;
    int before = errno;
    int broken = mine(whole(folder, path, into, sizeof into)) &&
                 __atomic_load_n(&orders->count, __ATOMIC_SEQ_CST) > orders->fail_at;
    errno = broken ? orders->error : before;
    return broken;
}

#define WRITES (O_WRONLY | O_RDWR | O_CREAT | O_TRUNC)

static int open_at(int folder, const char *path, int flags, mode_t mode)
{
    if (fails("open", folder, path, (flags & WRITES) != 0))
        return -1;
    return (int)syscall(SYS_openat, folder, path, flags, mode);
}

#define MODE(flags)                                   \
    mode_t mode = 0;                                  \
    if ((flags) & (O_CREAT | __O_TMPFILE)) {          \
        va_list more;                                 \
        va_start(more, flags);                        \
        mode = va_arg(more, mode_t);                  \
        va_end(more);                                 \
    }

int open(const char *path, int flags, ...) { MODE(flags) return open_at(AT_FDCWD, path, flags, mode); }
int open64(const char *path, int flags, ...) { MODE(flags) return open_at(AT_FDCWD, path, flags, mode); }
int openat(int folder, const char *path, int flags, ...) { MODE(flags) return open_at(folder, path, flags, mode); }
int openat64(int folder, const char *path, int flags, ...) { MODE(flags) return open_at(folder, path, flags, mode); }
int creat(const char *path, mode_t mode) { return open_at(AT_FDCWD, path, O_CREAT | O_WRONLY | O_TRUNC, mode); }

typedef FILE *(*opener)(const char *, const char *);

FILE *fopen(const char *path, const char *mode)
{
    static opener real;
    if (real == NULL)
        real = (opener)dlsym(RTLD_NEXT, "fopen");
    return fails("open", AT_FDCWD, path, strpbrk(mode, "wa+") != NULL) ? NULL : real(path, mode);
}

FILE *fopen64(const char *path, const char *mode)
{
    return fopen(path, mode);
}

/* Return how many bytes a disk that fills up still takes of a write: half of them. */
static size_t part(int held, size_t size)
{
    if (orders == NULL || !orders->stays || orders->error != ENOSPC || size < 2)
        return 0;
    char into[4096];
    if (__atomic_load_n(&orders->count, __ATOMIC_SEQ_CST) != orders->fail_at)
        return 0;
    return mine(whole(held, "", into, sizeof into)) ? size / 2 : 0;
}

ssize_t write(int held, const void *data, size_t size)
{
    size_t some = part(held, size);
    if (fails_on("write", held)) {
        if (some)
            return syscall(SYS_write, held, data, some);
        return -1;
    }
    return syscall(SYS_write, held, data, size);
}

ssize_t pwrite64(int held, const void *data, size_t size, off_t at)
{
    return fails_on("pwrite", held) ? -1 : syscall(SYS_pwrite64, held, data, size, at);
}

ssize_t pwrite(int held, const void *data, size_t size, off_t at) { return pwrite64(held, data, size, at); }

ssize_t writev(int held, const struct iovec *parts, int count)
{
    return fails_on("writev", held) ? -1 : syscall(SYS_writev, held, parts, count);
}

ssize_t sendfile64(int to, int from, off_t *at, size_t size)
{
    return fails_on("sendfile", to) ? -1 : syscall(SYS_sendfile, to, from, at, size);
}

ssize_t sendfile(int to, int from, off_t *at, size_t size) { return sendfile64(to, from, at, size); }

ssize_t copy_file_range(int from, off_t *start, int to, off_t *at, size_t size, unsigned flags)
{
    if (fails_on("copy_file_range", to))
        return -1;
    return syscall(SYS_copy_file_range, from, start, to, at, size, flags);
}

int ftruncate64(int held, off_t size)
{
    return fails_on("ftruncate", held) ? -1 : (int)syscall(SYS_ftruncate, held, size);
}

int ftruncate(int held, off_t size) { return ftruncate64(held, size); }

int fsync(int held)
{
    return fails_on("fsync", held) ? -1 : (int)syscall(SYS_fsync, held);
}

int fdatasync(int held)
{
    return fails_on("fdatasync", held) ? -1 : (int)syscall(SYS_fdatasync, held);
}

/* A network disk may report a failed write only on close; the file is closed anyway. */
int close(int held)
{
    int writes = (fcntl(held, F_GETFL) & O_ACCMODE) != O_RDONLY;
    int failed = orders != NULL && orders->folder[0] && writes && fails_on("close", held);
    int why = errno;
    int ended = (int)syscall(SYS_close, held);
    if (failed && ended == 0)
        errno = why;
    return failed ? -1 : ended;
}

void *mmap64(void *at, size_t size, int may, int kind, int held, off_t start)
{
    if (held >= 0 && fails("mmap", held, "", 0))
        return MAP_FAILED;
    return (void *)syscall(SYS_mmap, at, size, may, kind, held, start);
}

void *mmap(void *at, size_t size, int may, int kind, int held, off_t start)
{
    return mmap64(at, size, may, kind, held, start);
}

int renameat2(int from, const char *old, int to, const char *new, unsigned flags)
{
    return fails("rename", to, new, 1) ? -1 : (int)syscall(SYS_renameat2, from, old, to, new, flags);
}

int renameat(int from, const char *old, int to, const char *new) { return renameat2(from, old, to, new, 0); }
int rename(const char *old, const char *new) { return renameat2(AT_FDCWD, old, AT_FDCWD, new, 0); }

int linkat(int from, const char *old, int to, const char *new, int flags)
{
    return fails("link", to, new, 1) ? -1 : (int)syscall(SYS_linkat, from, old, to, new, flags);
}

int link(const char *old, const char *new) { return linkat(AT_FDCWD, old, AT_FDCWD, new, 0); }

int symlinkat(const char *old, int to, const char *new)
{
    return fails("symlink", to, new, 1) ? -1 : (int)syscall(SYS_symlinkat, old, to, new);
}

int symlink(const char *old, const char *new) { return symlinkat(old, AT_FDCWD, new); }

int mkdirat(int folder, const char *path, mode_t mode)
{
    return fails("mkdir", folder, path, 1) ? -1 : (int)syscall(SYS_mkdirat, folder, path, mode);
}

int mkdir(const char *path, mode_t mode) { return mkdirat(AT_FDCWD, path, mode); }

int unlinkat(int folder, const char *path, int flags)
{
    return keeps(folder, path) ? -1 : (int)syscall(SYS_unlinkat, folder, path, flags);
}

int unlink(const char *path) { return unlinkat(AT_FDCWD, path, 0); }
int rmdir(const char *path) { return unlinkat(AT_FDCWD, path, AT_REMOVEDIR); }
