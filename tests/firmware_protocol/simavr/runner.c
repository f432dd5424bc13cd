/* The firmware as built for the ATmega328P, run by simavr behind a pseudo-terminal.
 *
 * A test tool, in a process of its own: libsimavr is under the GPL and is linked with nothing of the product.
 * The protocol of this program is that of ports/host/flash_double.c, with times in processor cycles:
 *
 *     runner FLASH.elf [--edges FILE | --step]
 *     pty PATH CLOCK_HZ                first line out
 *     edge CYCLE 0|1                   the lamp pin, D9 or D10, exact to the cycle
 *     sent CYCLE BYTE                  (--trace) a byte begins to leave
 *     heard CYCLE                      (--trace) a byte has arrived
 *     run US BYTES -> ok CYCLE SENT STACK   (--step) STACK is the lowest stack pointer so far
 *     reset                            the reset button
 *     hang                             the processor loops for ever with its interrupts off
 *
 * In real time the chip's clock runs linearly in CLOCK_MONOTONIC and never ahead of it: a byte that arrives is
 * met no earlier than it was written, and one that leaves comes out no earlier than it was sent.
 */
#define _GNU_SOURCE
#include <fcntl.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_time.h>

#define LOOP_FOR_EVER 0xCFFF /* rjmp to itself */

/* Of the ATmega328P, in its data space. */
enum { DDRB = 0x24, PORTB = 0x25, TCCR1A = 0x80, TCCR1C = 0x82 };
enum { COMPA_VECTOR = 11, COMPB_VECTOR = 12, RECEIVED_VECTOR = 18 };

static avr_t *avr;
static int line_fd, lit, latch[2], room = 1, trace;
static unsigned long received, sent;
static uint8_t waiting[1 << 16];
static size_t waiting_from, waiting_ready, waiting_to; /* what came after `ready` is not met yet */
static uint16_t lowest_stack = 0xFFFF;
static avr_flashaddr_t hung_at;
static uint8_t hung_over[2];
static FILE *edges_file; /* null without --edges */
static struct timespec start; /* when cycle 0 was */

/* A line of the edges' file. */
static void note(char what)
{
    if (!edges_file)
        return;
    fprintf(edges_file, "%llu %c\n",
            start.tv_sec * 1000000000ULL + (unsigned long long)start.tv_nsec +
                avr->cycle * 1000 / (avr->frequency / 1000000),
            what);
    fflush(edges_file);
}

static void set_lamp(int on)
{
    if (on != lit) {
        printf("edge %llu %d\n", (unsigned long long)avr->cycle, on);
        note(on ? '1' : '0');
    }
    lit = on;
}

/* The lamp pin after the data sheet (ATmega328P, 16-bit timer, compare match output unit), as simavr 1.6
 * moves it at every write to OCR1x: a latch that matches set or clear and that has the pin while COM1x is not
 * 0; PORTB otherwise; no output at all before DDRB says so. */
static void update_pin(void)
{
    int on = 0;
    for (int unit = 0; unit < 2; unit++) {
        uint8_t bit = unit ? 1 << 2 : 1 << 1;
        int owns = avr->data[TCCR1A] >> (unit ? 4 : 6) & 3;
        if (avr->data[DDRB] & bit)
            on |= owns ? latch[unit] : (avr->data[PORTB] & bit) != 0;
    }
    set_lamp(on);
}

static void match(int unit)
{
    int action = avr->data[TCCR1A] >> (unit ? 4 : 6) & 3;
    if (action == 1)
        latch[unit] = !latch[unit];
    else if (action)
        latch[unit] = action == 3;
    update_pin();
}

static void on_match(struct avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    if (value)
        match(param != 0);
}

/* After each instruction: what it wrote to the registers of the pin. */
static void follow_registers(void)
{
    for (int unit = 0; unit < 2; unit++)
        if (avr->data[TCCR1C] & (unit ? 1 << 6 : 1 << 7)) { /* a forced match; the bit is a strobe */
            avr->data[TCCR1C] = 0;
            match(unit);
        }
    update_pin();
}

static void on_heard(struct avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq, (void)param;
    if (value && trace)
        printf("heard %llu\n", (unsigned long long)avr->cycle);
}

static void on_sent(struct avr_irq_t *irq, uint32_t value, void *param)
{
    uint8_t byte = (uint8_t)value;
    (void)irq, (void)param;
    if (trace)
        printf("sent %llu %02x\n", (unsigned long long)avr->cycle, byte);
    if (write(line_fd, &byte, 1) == 1) /* a UART does not care whether anyone listens */
        sent++;
}

static void on_room(struct avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq, (void)value;
    room = param != 0;
}

static avr_cycle_count_t stop_here(avr_t *mcu, avr_cycle_count_t when, void *param)
{
    (void)mcu, (void)when, (void)param; /* only keeps simavr from sleeping past the end of a step */
    return 0;
}

static void sleep_not(avr_t *mcu, avr_cycle_count_t cycles)
{
    (void)mcu, (void)cycles; /* simulated time is not real time */
}

static int read_line(void)
{
    ssize_t count = read(line_fd, waiting + waiting_to, sizeof waiting - waiting_to);
    if (count <= 0)
        return 0;
    waiting_to += (size_t)count;
    received += (unsigned long)count;
    return 1;
}

static void feed_line(void)
{
    avr_irq_t *input = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    while (room && waiting_from < waiting_ready)
        avr_raise_irq(input, waiting[waiting_from++]);
    if (waiting_from == waiting_to)
        waiting_from = waiting_ready = waiting_to = 0;
}

static void run_until(avr_cycle_count_t end)
{
    if (end > avr->cycle)
        avr_cycle_timer_register(avr, end - avr->cycle, stop_here, 0);
    while (avr->cycle < end) {
        uint16_t stack = (uint16_t)(avr->data[R_SPL] | avr->data[R_SPH] << 8);
        if (avr->pc == 0) { /* reset: the pins are inputs, and the line forgets */
            set_lamp(latch[0] = latch[1] = 0);
            if (hung_at)
                memcpy(avr->flash + hung_at, hung_over, 2);
            hung_at = 0;
        } else if (stack < lowest_stack && stack > 0x100) {
            lowest_stack = stack;
        }
        feed_line();
        if (avr_run(avr) == cpu_Crashed || avr->state == cpu_Done) {
            fprintf(stderr, "the firmware crashed at %llu\n", (unsigned long long)avr->cycle);
            exit(1);
        }
        follow_registers();
    }
}

static void hang(void)
{
    hung_at = avr->pc;
    memcpy(hung_over, avr->flash + hung_at, 2);
    avr->flash[hung_at] = LOOP_FOR_EVER & 0xFF;
    avr->flash[hung_at + 1] = LOOP_FOR_EVER >> 8;
    avr->sreg[S_I] = 0;
    avr->state = cpu_Running;
}

static void obey(const char *command)
{
    unsigned long us, total;
    struct pollfd wait = {.fd = line_fd, .events = POLLIN};
    if (sscanf(command, "run %lu %lu", &us, &total) == 2) {
        while (received < total)
            if (!read_line() && poll(&wait, 1, 2000) == 0)
                exit(fprintf(stderr, "%lu bytes promised, %lu came\n", total, received));
        waiting_ready = waiting_to;
        run_until(avr->cycle + us * (avr->frequency / 1000000));
        printf("ok %llu %lu %u\n", (unsigned long long)avr->cycle, sent, lowest_stack);
    } else if (!strncmp(command, "reset", 5)) {
        avr_reset(avr);
        avr->state = cpu_Running;
    } else if (!strncmp(command, "hang", 4)) {
        hang();
    }
    fflush(stdout);
}

/* Runs up to now. */
static void catch_up(void)
{
    static avr_cycle_count_t noted;
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    run_until((avr_cycle_count_t)((now.tv_sec - start.tv_sec) * 1e6 + (now.tv_nsec - start.tv_nsec) / 1e3) *
              (avr->frequency / 1000000));
    if (avr->cycle - noted > avr->frequency / 200) { /* each 5 ms */
        noted = avr->cycle;
        note('t');
    }
    fflush(stdout);
}

static void live(void)
{
    avr_cycle_count_t heard = 0;
    clock_gettime(CLOCK_MONOTONIC, &start);
    for (;;) {
        struct pollfd waits[2] = {{.fd = line_fd, .events = POLLIN}, {.fd = 0, .events = POLLIN}};
        /* While an answer is under way, so often that what leaves the chip does not wait for its reader. */
        struct timespec pause = {0, avr->cycle - heard < avr->frequency / 50 ? 100000 : 1000000};
        char command[128];
        ppoll(waits, 2, &pause, 0);
        if (read_line())
            heard = avr->cycle;
        catch_up();
        waiting_ready = waiting_to;
        if (waits[1].revents) {
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
    static elf_firmware_t firmware;
    uint32_t flags = 0;
    struct termios settings;
    char command[128];
    int slave, step = 0;
    for (int i = 2; i < argc; i++) {
        step |= !strcmp(argv[i], "--step");
        trace |= !strcmp(argv[i], "--trace");
        if (!strcmp(argv[i], "--edges") && i + 1 < argc && !(edges_file = fopen(argv[++i], "a")))
            return perror(argv[i]), 1;
    }
    if (argc < 2 || elf_read_firmware(argv[1], &firmware))
        return fprintf(stderr, "usage: runner FLASH.elf [--edges FILE | --step] [--trace]\n");
    avr = avr_make_mcu_by_name("atmega328p");
    avr_init(avr);
    avr->log = LOG_NONE;
    avr->frequency = 16000000;
    avr_load_firmware(avr, &firmware);
    avr->sleep = sleep_not;

    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_sent, 0);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XON), on_room, avr);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XOFF), on_room, 0);
    avr_irq_register_notify(avr_get_interrupt_irq(avr, COMPA_VECTOR) + AVR_INT_IRQ_PENDING, on_match, 0);
    avr_irq_register_notify(avr_get_interrupt_irq(avr, COMPB_VECTOR) + AVR_INT_IRQ_PENDING, on_match, avr);
    avr_irq_register_notify(avr_get_interrupt_irq(avr, RECEIVED_VECTOR) + AVR_INT_IRQ_PENDING, on_heard, 0);

    line_fd = posix_openpt(O_RDWR | O_NOCTTY);
    grantpt(line_fd);
    unlockpt(line_fd);
    slave = open(ptsname(line_fd), O_RDWR | O_NOCTTY);
    tcgetattr(slave, &settings);
    cfmakeraw(&settings);
    tcsetattr(slave, TCSANOW, &settings);
    fcntl(line_fd, F_SETFL, O_NONBLOCK);
    printf("pty %s %lu\n", ptsname(line_fd), (unsigned long)avr->frequency);
    fflush(stdout);

    if (!step)
        live();
    else
        while (fgets(command, sizeof command, stdin))
            obey(command);
    return 0;
}
