/* The device as a program behind a pseudo-terminal: a quick double for a host's tests and for trying things
 * out.
 *
 *     flash_double [--edges FILE]   lives in real time; prints the terminal to open
 *     flash_double --step [--clock TICK]   its time stands still but for commands on standard input
 *
 * First line out:    pty PATH CLOCK_HZ
 * An edge of the lamp:   edge TICK 0|1
 * FILE gets, appended and flushed, what a camera beside the lamp needs to know, in ns of CLOCK_MONOTONIC:
 *     NS 0|1                 an edge of the lamp; the device's clock runs linearly in the system's
 *     NS t                   each 10 ms or sooner: all edges up to then have been written
 * Lines in:
 *     run US BYTES           (--step only) waits until BYTES in all have come through the terminal, takes
 *                            them, lets US microseconds pass; answers "ok TICK SENT": bytes sent in all
 *     reset                  the reset button
 *     break                  the timer no longer makes the edge off (to test the guard above it)
 * End of input ends the program.
 */
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "limits.h"
#include "messages.h"
#include "port.h"
#include "port_host.h"

static int line_fd;
static unsigned long received, sent;
static FILE *edges_file; /* null without --edges */
static struct timespec start; /* when the device's clock was 0 */

static void fail(const char *what)
{
    perror(what);
    exit(1);
}

/* A line of the edges' file; a tick is 1 us. */
static void note(tick_t tick, char what)
{
    unsigned long long ns = (unsigned long long)start.tv_sec * 1000000000ULL;
    if (!edges_file)
        return;
    fprintf(edges_file, "%llu %c\n", ns + (unsigned long long)start.tv_nsec + tick * 1000, what);
    fflush(edges_file);
}

static void print_edge(const edge_t *edge)
{
    printf("edge %llu %d\n", (unsigned long long)edge->tick, edge->on);
    fflush(stdout);
    note(edge->tick, edge->on ? '1' : '0');
}

static void write_line(uint8_t byte)
{
    /* Like a UART, it does not care whether anyone listens. */
    if (write(line_fd, &byte, 1) == 1)
        sent++;
}

/* What has come, for `take_line`. Returns how many bytes. */
static uint8_t come[4096];
static size_t read_line(void)
{
    ssize_t count = read(line_fd, come, sizeof come);
    return count > 0 ? (size_t)count : 0;
}

static void take_line(size_t count)
{
    host_receive(come, count);
    received += count;
}

static void reset(void)
{
    static uint32_t last;
    uint32_t nonce = 0;
    FILE *random = fopen("/dev/urandom", "rb");
    if (!random)
        fail("/dev/urandom");
    while (nonce == 0 || nonce == last)
        if (fread(&nonce, sizeof nonce, 1, random) != 1)
            fail("/dev/urandom");
    fclose(random);
    last = nonce;
    host_reset(nonce, STATE_IDLE);
}

static void open_line(void)
{
    struct termios settings;
    int slave;
    line_fd = posix_openpt(O_RDWR | O_NOCTTY);
    if (line_fd < 0 || grantpt(line_fd) || unlockpt(line_fd))
        fail("pseudo-terminal");
    /* Kept open, so that the line survives a host that closes it. */
    slave = open(ptsname(line_fd), O_RDWR | O_NOCTTY);
    if (slave < 0 || tcgetattr(slave, &settings))
        fail(ptsname(line_fd));
    settings.c_iflag &= (tcflag_t) ~(BRKINT | ICRNL | INLCR | IGNCR | INPCK | ISTRIP | IXON);
    settings.c_oflag &= (tcflag_t)~OPOST;
    settings.c_lflag &= (tcflag_t) ~(ECHO | ICANON | IEXTEN | ISIG);
    tcsetattr(slave, TCSANOW, &settings);
    fcntl(line_fd, F_SETFL, O_NONBLOCK);
    printf("pty %s %lu\n", ptsname(line_fd), TICK_HZ);
    fflush(stdout);
}

/* The bytes that a step was promised: through the kernel they may come a moment later. */
static void take_promised(unsigned long total)
{
    struct pollfd wait = {0, POLLIN, 0};
    wait.fd = line_fd;
    while (received < total) {
        size_t count = read_line();
        take_line(count);
        if (!count && poll(&wait, 1, 2000) == 0) {
            fprintf(stderr, "%lu bytes promised, %lu came\n", total, received);
            exit(1);
        }
    }
}

static void obey(const char *command)
{
    unsigned long us, total;
    if (sscanf(command, "run %lu %lu", &us, &total) == 2) {
        take_promised(total);
        host_advance(port_now() + us);
        printf("ok %llu %lu\n", (unsigned long long)port_now(), sent);
    } else if (!strncmp(command, "reset", 5)) {
        reset();
    } else if (!strncmp(command, "break", 5)) {
        host_break_timer();
    } else {
        fprintf(stderr, "unknown command: %s", command);
        exit(1);
    }
    fflush(stdout);
}

/* Moves the device's clock to the system's. */
static void catch_up(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    host_advance((tick_t)((now.tv_sec - start.tv_sec) * 1000000LL + (now.tv_nsec - start.tv_nsec) / 1000));
    note(port_now(), 't');
}

static void live(void)
{
    char command[128];
    clock_gettime(CLOCK_MONOTONIC, &start);
    for (;;) {
        struct pollfd waits[2] = {{0, POLLIN, 0}, {0, POLLIN, 0}};
        int until_edge_ms = (int)((host_next_edge(port_now() + TICK_HZ / 200) - port_now()) / 1000);
        size_t heard;
        waits[0].fd = line_fd;
        poll(waits, 2, until_edge_ms);
        /* read first: no byte is met before it was written */
        heard = waits[0].revents & POLLIN ? read_line() : 0;
        catch_up();
        take_line(heard);
        if (waits[1].revents) {
            /* commands are typed or written whole, one at a time */
            ssize_t count = read(0, command, sizeof command - 1);
            if (count <= 0)
                return;
            command[count] = 0;
            obey(command);
        }
    }
}

int main(int argc, char **argv)
{
    char command[128];
    bool step = false;
    int i;
    for (i = 1; i < argc; i++) {
        if (!strcmp(argv[i], "--step")) {
            step = true;
        } else if (!strcmp(argv[i], "--clock") && i + 1 < argc) {
            host_set_clock(strtoull(argv[++i], 0, 10));
        } else if (!strcmp(argv[i], "--edges") && i + 1 < argc) {
            if (!(edges_file = fopen(argv[++i], "a")))
                fail(argv[i]);
        } else {
            fprintf(stderr, "usage: flash_double [--edges FILE | --step [--clock TICK]]\n");
            return 2;
        }
    }
    host_edge_hook = print_edge;
    host_sent_hook = write_line;
    open_line();
    reset();
    if (!step)
        live();
    else
        while (fgets(command, sizeof command, stdin))
            obey(command);
    return 0;
}
