/* Streams of stdio on serial ports, gateways and CAN sockets.
 *
 * The C library reads and writes its streams by calls of its own, which would pass this library by.
 * A stream on one of the rig's descriptors is therefore one with functions of ours.
 *
 * Source: fopen(3), fopencookie(3).
 */
#define _GNU_SOURCE
#include "clock.h"

#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

/* Functions that only fortified programs call. */
int __dprintf_chk(int, int, const char *, ...);
int __vdprintf_chk(int, int, const char *, va_list);

static struct stream {
    struct stream *next;
    FILE *file;
    int fd;
} *streams;

static ssize_t read_stream(void *stream, char *data, size_t size)
{
    return read(((struct stream *)stream)->fd, data, size);
}

/* Write all, as fwrite() expects; 0 is an error here. */
static ssize_t write_all(int fd, const char *data, size_t size)
{
    size_t done = 0;
    while (done < size) {
        ssize_t written = write(fd, data + done, size - done);
        if (written < 0) break;
        done += written;
    }
    return done;
}

static ssize_t write_stream(void *stream, const char *data, size_t size)
{
    return write_all(((struct stream *)stream)->fd, data, size);
}

static int close_stream(void *stream)
{
    struct stream **place = &streams;
    int fd = ((struct stream *)stream)->fd;
    while (*place != stream) place = &(*place)->next;
    *place = (*place)->next;
    free(stream);
    return close(fd);
}

/* Return a stream on this descriptor; NULL with errno. */
static FILE *stream_on(int fd, const char *mode)
{
    static const cookie_io_functions_t functions = {
        .read = read_stream, .write = write_stream, .close = close_stream};
    struct stream *stream = malloc(sizeof *stream);
    FILE *file = stream ? fopencookie(stream, mode, functions) : NULL;
    if (!file) {
        free(stream);
        return NULL;
    }
    if (isatty(fd)) setvbuf(file, NULL, _IOLBF, BUFSIZ);
    *stream = (struct stream){streams, file, fd};
    streams = stream;
    return file;
}

static bool is_of_rig(int fd)
{
    return is_line(fd) || is_can(fd);
}

EXPORT FILE *fdopen(int fd, const char *mode)
{
    return is_of_rig(fd) ? stream_on(fd, mode) : REAL(fdopen)(fd, mode);
}

EXPORT FILE *fopen(const char *restrict path, const char *restrict mode)
{
    int fd;
    if (!open_serial(path, strchr(mode, 'e') ? O_CLOEXEC : 0, &fd)) return REAL(fopen)(path, mode);
    FILE *file = fd < 0 ? NULL : stream_on(fd, mode);
    if (fd >= 0 && !file) close(fd);
    return file;
}

EXPORT FILE *fopen64(const char *restrict path, const char *restrict mode)
    __attribute__((alias("fopen")));

EXPORT FILE *freopen(const char *restrict path, const char *restrict mode, FILE *restrict file)
{
    if (is_serial(path))
        refuse("program '%s' calls freopen() of %s: not supported on a line of the rig; expected"
               " fopen(); joins = false lets the program run beside the rig",
               rig.name, path);
    return REAL(freopen)(path, mode, file);
}

EXPORT FILE *freopen64(const char *restrict path, const char *restrict mode, FILE *restrict file)
    __attribute__((alias("freopen")));

static struct stream *stream_of(const FILE *file)
{
    struct stream *stream = streams;
    while (stream && stream->file != file) stream = stream->next;
    return stream;
}

EXPORT int fileno(FILE *file)
{
    const struct stream *stream = stream_of(file);
    return stream ? stream->fd : REAL(fileno)(file);
}

EXPORT int fileno_unlocked(FILE *file)
{
    const struct stream *stream = stream_of(file);
    return stream ? stream->fd : REAL(fileno_unlocked)(file);
}

EXPORT int vdprintf(int fd, const char *restrict format, va_list values)
{
    char *text;
    if (!is_of_rig(fd)) return REAL(vdprintf)(fd, format, values);
    int size = vasprintf(&text, format, values);
    if (size < 0) return -1;
    if (write_all(fd, text, size) < size) size = -1;
    free(text);
    return size;
}

EXPORT int dprintf(int fd, const char *restrict format, ...)
{
    va_list values;
    va_start(values, format);
    int size = vdprintf(fd, format, values);
    va_end(values);
    return size;
}

EXPORT int __vdprintf_chk(int fd, int level, const char *format, va_list values)
{
    (void)level;
    return vdprintf(fd, format, values);
}

EXPORT int __dprintf_chk(int fd, int level, const char *format, ...)
{
    va_list values;
    (void)level;
    va_start(values, format);
    int size = vdprintf(fd, format, values);
    va_end(values);
    return size;
}
