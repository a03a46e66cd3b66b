/* Preloaded into a game (LD_PRELOAD), so that it can be filmed frame by frame however slowly it renders.
 *
 * - The clock of the main thread stands still within a frame and moves by 1/FPS at every buffer swap: the game believes
 *   that it runs at exactly that rate. A sleep moves the clock instead of waiting.
 * - rand() and random() are seeded from the number of the frame alone, so that what one resolution draws more often than
 *   another does not move its world apart.
 * - Before a swap, from frame SKIP on, the picture is read back, averaged over SUPERSAMPLE x SUPERSAMPLE pixels, converted to
 *   I420 (BT.709, limited range, left-sited chroma) and written to the descriptor FD. After COUNT pictures the process ends.
 *   Until shortly before that nothing is rasterized, which makes the way to the scene cheap.
 *
 * Environment, each as GAMESR_...: PROCESS (name of the executable; any other is left alone), FD, FPS, SKIP, COUNT, WIDTH and HEIGHT (of
 * the picture that is read back, in the lower left corner of the window), SUPERSAMPLE, DRAWABLE (1: tell an SDL game that its window has that
 * size, for games that refuse small windows), PACE_MS (real time that a frame lasts at least before SKIP, for games whose other threads load
 * the world meanwhile). COUNT=0 films nothing, rasterizes nothing and never ends the game.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/select.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

enum { UNRENDERED_UNTIL = 8 }; /* frames before the first picture that are rendered again: some effects look back */

static struct {
    int active, fd, supersample, drawable, width, height;
    long skip, count, pace_ms;
    double fps;
} want;
static long frame, taken;

static long number(const char *name, long otherwise) {
    const char *text = getenv(name);
    return text ? atol(text) : otherwise;
}

__attribute__((constructor)) static void begin(void) {
    const char *process = getenv("GAMESR_PROCESS");
    if (!process || strcmp(process, program_invocation_short_name)) return; /* a shell on the way to the game */
    want.fd = (int)number("GAMESR_FD", -1);
    want.fps = (double)number("GAMESR_FPS", 60);
    want.skip = number("GAMESR_SKIP", 0);
    want.count = number("GAMESR_COUNT", 0);
    want.width = (int)number("GAMESR_WIDTH", 0);
    want.height = (int)number("GAMESR_HEIGHT", 0);
    want.supersample = (int)number("GAMESR_SUPERSAMPLE", 1);
    want.drawable = (int)number("GAMESR_DRAWABLE", 0);
    want.pace_ms = number("GAMESR_PACE_MS", 0);
    want.active = 1;
}

static void *next(const char *name) {
    void *found = dlsym(RTLD_NEXT, name);
    if (found) return found;
    const char *library = strncmp(name, "SDL", 3) ? "libGL.so.1" : "libSDL2-2.0.so.0"; /* loaded by the game itself, later than us */
    return dlsym(dlopen(library, RTLD_NOW), name);
}

static int directed(void) { /* the thread whose time and dice are ours */
    static __thread int main_thread = -1;
    if (main_thread < 0) main_thread = syscall(SYS_gettid) == getpid();
    return want.active && main_thread;
}

/* ---- the clock ---- */

static const int64_t SECOND = 1000000000, MONOTONIC_ZERO = 1000 * SECOND, REALTIME_ZERO = 1700000000 * SECOND;
static int64_t now_ns;
static long questions;

static int64_t ask(void) {
    if (++questions % 10000 == 0) now_ns += 1000000; /* a loop that waits for time to pass has to end */
    return now_ns;
}

static int64_t zero_of(clockid_t clock) {
    return clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE ? REALTIME_ZERO : MONOTONIC_ZERO;
}

static void pass(int64_t ns) { now_ns += ns > 0 ? ns : 1000; }

int clock_gettime(clockid_t clock, struct timespec *time) {
    if (!directed() || clock == CLOCK_PROCESS_CPUTIME_ID || clock == CLOCK_THREAD_CPUTIME_ID) return (int)syscall(SYS_clock_gettime, clock, time);
    int64_t ns = zero_of(clock) + ask();
    time->tv_sec = ns / SECOND;
    time->tv_nsec = ns % SECOND;
    return 0;
}

int gettimeofday(struct timeval *restrict time, void *restrict zone) {
    (void)zone;
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    time->tv_sec = now.tv_sec;
    time->tv_usec = now.tv_nsec / 1000;
    return 0;
}

time_t time(time_t *out) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (out) *out = now.tv_sec;
    return now.tv_sec;
}

int clock_nanosleep(clockid_t clock, int flags, const struct timespec *request, struct timespec *left) {
    if (!directed()) return (int)syscall(SYS_clock_nanosleep, clock, flags, request, left) ? errno : 0;
    int64_t ns = request->tv_sec * SECOND + request->tv_nsec;
    pass(flags & TIMER_ABSTIME ? ns - zero_of(clock) - now_ns : ns);
    return 0;
}

int nanosleep(const struct timespec *request, struct timespec *left) {
    int error = clock_nanosleep(CLOCK_REALTIME, 0, request, left);
    if (!error) return 0;
    errno = error;
    return -1;
}

int usleep(useconds_t us) {
    struct timespec request = {us / 1000000, (us % 1000000) * 1000};
    return nanosleep(&request, NULL);
}

void SDL_Delay(uint32_t ms) { usleep(ms * 1000); }

int select(int count, fd_set *restrict read, fd_set *restrict write, fd_set *restrict except, struct timeval *restrict timeout) {
    static int (*real)(int, fd_set *, fd_set *, fd_set *, struct timeval *);
    if (!real) real = next("select");
    if (!directed() || !timeout) return real(count, read, write, except, timeout);
    int64_t ns = timeout->tv_sec * SECOND + timeout->tv_usec * 1000;
    struct timeval none = {0, 0};
    int ready = real(count, read, write, except, &none);
    if (ready == 0 && ns) pass(ns); /* ioquake3 sleeps in here between frames */
    return ready;
}

/* ---- the dice ---- */

static uint64_t dice_state = 1;

static uint64_t mixed(uint64_t x) { /* SplitMix64; S. Vigna, 2015 */
    x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9u;
    x = (x ^ (x >> 27)) * 0x94D049BB133111EBu;
    return x ^ (x >> 31);
}

static long roll(void) { return (long)(mixed(dice_state += 0x9E3779B97F4A7C15u) >> 33); }

#define DICE(NAME, TYPE)                       \
    TYPE NAME(void) {                          \
        static TYPE (*real)(void);             \
        if (directed()) return (TYPE)roll();   \
        if (!real) real = next(#NAME);         \
        return real();                         \
    }
DICE(rand, int)
DICE(random, long)

#define SEED(NAME)                             \
    void NAME(unsigned seed) {                 \
        static void (*real)(unsigned);         \
        if (directed()) return;                \
        if (!real) real = next(#NAME);         \
        real(seed);                            \
    }
SEED(srand)
SEED(srandom)

/* ---- the camera ---- */

enum {
    GL_BACK = 0x0405, GL_PACK_ROW_LENGTH = 0x0D02, GL_PACK_ALIGNMENT = 0x0D05, GL_UNSIGNED_BYTE = 0x1401, GL_BGRA = 0x80E1,
    GL_READ_BUFFER = 0x0C02, GL_PIXEL_PACK_BUFFER = 0x88EB, GL_PIXEL_PACK_BUFFER_BINDING = 0x88ED, GL_READ_FRAMEBUFFER = 0x8CA8,
    GL_READ_FRAMEBUFFER_BINDING = 0x8CAA, GL_RASTERIZER_DISCARD = 0x8C89
};
static struct {
    void (*ReadPixels)(int, int, int, int, unsigned, unsigned, void *);
    void (*GetIntegerv)(unsigned, int *);
    void (*PixelStorei)(unsigned, int);
    void (*ReadBuffer)(unsigned);
    void (*BindFramebuffer)(unsigned, unsigned);
    void (*BindBuffer)(unsigned, unsigned);
    void (*Enable)(unsigned);
    void (*Disable)(unsigned);
} gl;

static void load_gl(void) {
    void *(*address)(const char *) = next("glXGetProcAddressARB");
    gl.ReadPixels = next("glReadPixels");
    gl.GetIntegerv = next("glGetIntegerv");
    gl.PixelStorei = next("glPixelStorei");
    gl.ReadBuffer = next("glReadBuffer");
    gl.Enable = next("glEnable");
    gl.Disable = next("glDisable");
    gl.BindFramebuffer = address("glBindFramebuffer");
    gl.BindBuffer = address("glBindBuffer");
}

static void fail(const char *what) {
    fprintf(stderr, "gamesr frame clock: %s: %s\n", what, strerror(errno));
    _exit(3);
}

static void *allocate(size_t bytes) {
    void *memory = malloc(bytes);
    if (!memory) fail("no memory for a picture");
    return memory;
}

/* Sums of s x s pixels, top row first: rgb is three planes of height/s x width/s. */
static void reduce(const uint8_t *restrict bgra, uint16_t *restrict rgb, int width, int height, int s) {
    int columns = width / s, rows = height / s;
    memset(rgb, 0, (size_t)columns * rows * 3 * sizeof *rgb);
    for (int y = 0; y < height; y++) {
        const uint8_t *line = bgra + (size_t)(height - 1 - y) * width * 4; /* OpenGL's first row is the lowest */
        for (int plane = 0; plane < 3; plane++) {
            uint16_t *out = rgb + ((size_t)plane * rows + y / s) * columns;
            const uint8_t *in = line + 2 - plane;
            for (int i = 0; i < s; i++)
                for (int x = 0; x < columns; x++) out[x] += in[(x * s + i) * 4];
        }
    }
}

/* BT.709 limited (ITU-T H.273, equations 38 to 40): code = offset + r R + g G + b B, in 1/2^20, of sums that count `weight` times. */
typedef struct { double r, g, b; int offset; } Row;
static const Row LUMA = {0.2126 * 219, 0.7152 * 219, 0.0722 * 219, 16};
static const Row CB = {-0.2126 / 1.8556 * 224, -0.7152 / 1.8556 * 224, 0.5 * 224, 128};
static const Row CR = {0.5 * 224, -0.7152 / 1.5748 * 224, -0.0722 / 1.5748 * 224, 128};

static void convert(const int *restrict r, const int *restrict g, const int *restrict b, uint8_t *restrict out, int count, int weight, Row row) {
    const double unit = (1 << 20) / 255.0 / weight;
    const int kr = (int)(row.r * unit + (row.r < 0 ? -0.5 : 0.5)), kg = (int)(row.g * unit + (row.g < 0 ? -0.5 : 0.5)), kb = (int)(row.b * unit + (row.b < 0 ? -0.5 : 0.5));
    const int half = (row.offset << 20) + (1 << 19);
    for (int x = 0; x < count; x++) out[x] = (uint8_t)((kr * r[x] + kg * g[x] + kb * b[x] + half) >> 20);
}

/* I420 from sums that count `weight` times; a chroma sample lies on an even column of luma, between two rows: 1 2 1 over columns. */
static void to_i420(const uint16_t *rgb, uint8_t *out, int width, int height, int weight, int *lines) {
    const size_t area = (size_t)width * height;
    uint8_t *chroma[2] = {out + area, out + area + area / 4};
    for (int y = 0; y < height; y++) {
        for (int plane = 0; plane < 3; plane++)
            for (int x = 0; x < width; x++) lines[plane * width + x] = rgb[plane * area + (size_t)y * width + x];
        convert(lines, lines + width, lines + 2 * width, out + (size_t)y * width, width, weight, LUMA);
    }
    for (int y = 0; y < height / 2; y++) {
        for (int plane = 0; plane < 3; plane++) {
            const uint16_t *above = rgb + plane * area + (size_t)2 * y * width, *below = above + width;
            for (int x = 0; x < width / 2; x++) {
                int left = x ? 2 * x - 1 : 0;
                lines[plane * width + x] = above[left] + below[left] + 2 * (above[2 * x] + below[2 * x]) + above[2 * x + 1] + below[2 * x + 1];
            }
        }
        for (int c = 0; c < 2; c++) convert(lines, lines + width, lines + 2 * width, chroma[c] + (size_t)y * (width / 2), width / 2, 8 * weight, c ? CR : CB);
    }
}

static void send(const uint8_t *bytes, size_t count) {
    while (count) {
        ssize_t sent = write(want.fd, bytes, count);
        if (sent < 0 && errno == EINTR) continue;
        if (sent <= 0) fail("the picture cannot be handed over");
        bytes += sent;
        count -= (size_t)sent;
    }
}

static void film(void) {
    static uint8_t *bgra, *i420;
    static uint16_t *rgb;
    static int *lines;
    const int s = want.supersample, width = want.width / s, height = want.height / s;
    const size_t area = (size_t)width * height;
    if (!bgra) {
        bgra = allocate((size_t)want.width * want.height * 4);
        rgb = allocate(area * 3 * sizeof *rgb);
        i420 = allocate(area * 3 / 2);
        lines = allocate((size_t)width * 3 * sizeof *lines);
    }
    int framebuffer, buffer, alignment, row_length, source;
    gl.GetIntegerv(GL_READ_FRAMEBUFFER_BINDING, &framebuffer);
    gl.GetIntegerv(GL_PIXEL_PACK_BUFFER_BINDING, &buffer);
    gl.GetIntegerv(GL_PACK_ALIGNMENT, &alignment);
    gl.GetIntegerv(GL_PACK_ROW_LENGTH, &row_length);
    if (framebuffer) gl.BindFramebuffer(GL_READ_FRAMEBUFFER, 0);
    if (buffer) gl.BindBuffer(GL_PIXEL_PACK_BUFFER, 0);
    gl.GetIntegerv(GL_READ_BUFFER, &source);
    gl.ReadBuffer(GL_BACK);
    gl.PixelStorei(GL_PACK_ALIGNMENT, 4);
    gl.PixelStorei(GL_PACK_ROW_LENGTH, 0);
    gl.ReadPixels(0, 0, want.width, want.height, GL_BGRA, GL_UNSIGNED_BYTE, bgra);
    gl.ReadBuffer((unsigned)source);
    gl.PixelStorei(GL_PACK_ALIGNMENT, alignment);
    gl.PixelStorei(GL_PACK_ROW_LENGTH, row_length);
    if (framebuffer) gl.BindFramebuffer(GL_READ_FRAMEBUFFER, (unsigned)framebuffer);
    if (buffer) gl.BindBuffer(GL_PIXEL_PACK_BUFFER, (unsigned)buffer);
    reduce(bgra, rgb, want.width, want.height, s);
    to_i420(rgb, i420, width, height, s * s, lines);
    send(i420, area * 3 / 2);
}

static void swapped(void) {
    if (!want.active) return;
    if (!gl.ReadPixels) load_gl();
    if (want.count && frame >= want.skip) {
        film();
        if (++taken == want.count) _exit(0);
    }
    frame++;
    if (!want.count || frame < want.skip - UNRENDERED_UNTIL) gl.Enable(GL_RASTERIZER_DISCARD);
    else if (frame == want.skip - UNRENDERED_UNTIL) gl.Disable(GL_RASTERIZER_DISCARD);
    if (want.pace_ms && frame < want.skip) {
        struct timespec pause = {want.pace_ms / 1000, want.pace_ms % 1000 * 1000000};
        syscall(SYS_nanosleep, &pause, NULL);
    }
    questions = 0;
    static int64_t late_ns; /* a game that slept for longer than a frame is late for good: its next frame is as long as any */
    int64_t due = late_ns + (int64_t)((double)frame * 1e9 / want.fps);
    if (now_ns > due) late_ns += now_ns - due;
    else now_ns = due;
    dice_state = mixed((uint64_t)frame + 1);
}

static int in_sdl;

void glXSwapBuffers(void *display, unsigned long drawable) {
    static void (*real)(void *, unsigned long);
    if (!real) real = next("glXSwapBuffers");
    if (!in_sdl) swapped();
    real(display, drawable);
}

void SDL_GL_SwapWindow(void *window) {
    static void (*real)(void *);
    if (!real) real = next("SDL_GL_SwapWindow");
    swapped();
    in_sdl = 1; /* SDL swaps by glXSwapBuffers: one frame, not two */
    real(window);
    in_sdl = 0;
}

void SDL_GL_GetDrawableSize(void *window, int *width, int *height) {
    static void (*real)(void *, int *, int *);
    if (!real) real = next("SDL_GL_GetDrawableSize");
    real(window, width, height);
    if (!want.active || !want.drawable) return;
    if (width) *width = want.width;
    if (height) *height = want.height;
}
