/* A wall clock that can be set while a process runs: preloaded (LD_PRELOAD), it adds to CLOCK_REALTIME what stands in the file
 * CLOCK_SHIFT, int64 nanoseconds: entry 0 for every process, entry PID for one. Other clocks go on, as they do where a clock is set.
 */
#define _GNU_SOURCE
#include <fcntl.h>
#include <pthread.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static volatile int64_t *all, *own;

static void find(void) { own = all + getpid(); }

__attribute__((constructor)) static void begin(void) {
    const char *path = getenv("CLOCK_SHIFT");
    int file = path ? open(path, O_RDONLY | O_CLOEXEC) : -1;
    int64_t *shift = file < 0 ? MAP_FAILED : mmap(0, 8ul << 22, PROT_READ, MAP_SHARED, file, 0);
    if (shift == MAP_FAILED) return;
    all = shift;
    find();
    pthread_atfork(0, 0, find); /* a service may be forked */
}

int clock_gettime(clockid_t clock, struct timespec *t) {
    long failed = syscall(SYS_clock_gettime, clock, t);
    if (failed || !all || (clock != CLOCK_REALTIME && clock != CLOCK_REALTIME_COARSE)) return (int)failed;
    int64_t ns = t->tv_sec * 1000000000ll + t->tv_nsec + *all + *own;
    t->tv_sec = ns / 1000000000ll, t->tv_nsec = ns % 1000000000ll;
    return 0;
}

int gettimeofday(struct timeval *restrict v, void *restrict zone) {
    struct timespec t;
    (void)zone, clock_gettime(CLOCK_REALTIME, &t);
    v->tv_sec = t.tv_sec, v->tv_usec = t.tv_nsec / 1000;
    return 0;
}

time_t time(time_t *out) { struct timespec t; clock_gettime(CLOCK_REALTIME, &t); return out ? (*out = t.tv_sec) : t.tv_sec; }
