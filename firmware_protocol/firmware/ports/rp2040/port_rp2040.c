/* The RP2040: lamp on any pin through a PIO state machine, USB serial, watchdog. Needs pico-sdk 2.0 or later.
 *
 * An alarm's interrupt makes both edges, to a microsecond or two. Under it lies a one-shot in the PIO, which
 * needs no processor: set going with each rising edge, it drops the pin after MAX_ON_MS if nothing has done
 * so before.
 *
 * At reset the pins are inputs with the chip's own pull-down; the watchdog resets the pads too.
 */
#include "hardware/clocks.h"
#include "hardware/gpio.h"
#include "hardware/pio.h"
#include "hardware/sync.h"
#include "hardware/timer.h"
#include "hardware/watchdog.h"
#include "pico/rand.h"
#include "pico/stdio/driver.h"
#include "pico/stdio_usb.h"
#include "pico/stdlib.h"

#include "device.h"
#include "limits.h"
#include "messages.h"
#include "port.h"
#include "queues.h"

#ifndef LAMP_GPIO
#define LAMP_GPIO 15
#endif

#define LAMP_PIO    pio0
#define WATCHDOG_MS 100
#define EDGES       8

enum { DARK, WAITING, LIT };

/* Shared with the alarm's interrupt: touched with interrupts off only. */
static struct {
    uint8_t phase;
    tick_t on_tick, off_tick;
    uint32_t on_ticks;
    edge_t edges[EDGES];
    uint8_t first_edge, edge_count;
} lamp_pin;
static uint lamp_sm, lamp_program, lamp_alarm;

/* ---- lamp; all with interrupts off ---- */

static void log_edge(bool on)
{
    edge_t *edge;
    if (lamp_pin.edge_count == EDGES)
        return; /* the main loop hangs, and the watchdog is about to end it */
    edge = &lamp_pin.edges[(lamp_pin.first_edge + lamp_pin.edge_count++) % EDGES];
    edge->tick = time_us_64();
    edge->on = on;
}

static void show(bool on)
{
#ifdef PICO_DEFAULT_LED_PIN
    gpio_put(PICO_DEFAULT_LED_PIN, on);
#else
    (void)on;
#endif
}

static void rise(void)
{
    pio_sm_put(LAMP_PIO, lamp_sm, MAX_ON_TICKS - 2); /* the loop takes two cycles more than it counts */
    log_edge(true);
    lamp_pin.off_tick = time_us_64() + lamp_pin.on_ticks;
    lamp_pin.phase = LIT;
    show(true);
}

static void fall(void)
{
    pio_sm_exec(LAMP_PIO, lamp_sm, pio_encode_set(pio_pins, 0));
    pio_sm_exec(LAMP_PIO, lamp_sm, pio_encode_jmp(lamp_program));
    pio_sm_clear_fifos(LAMP_PIO, lamp_sm);
    if (lamp_pin.phase == LIT)
        log_edge(false);
    lamp_pin.phase = DARK;
    show(false);
}

/* Makes the edges that are due and sets the alarm to the next one. */
static void follow(void)
{
    for (;;) {
        tick_t now = time_us_64();
        if (lamp_pin.phase == WAITING && reached(now, lamp_pin.on_tick))
            rise();
        else if (lamp_pin.phase == LIT && reached(now, lamp_pin.off_tick))
            fall();
        if (lamp_pin.phase == DARK) {
            hardware_alarm_cancel(lamp_alarm);
            return;
        }
        /* True when the time has passed meanwhile: go round again. */
        if (!hardware_alarm_set_target(
                lamp_alarm,
                from_us_since_boot(lamp_pin.phase == WAITING ? lamp_pin.on_tick : lamp_pin.off_tick)))
            return;
    }
}

static void on_alarm(uint alarm)
{
    uint32_t status = save_and_disable_interrupts();
    (void)alarm;
    follow();
    restore_interrupts(status);
}

void port_pulse(tick_t on_tick, uint32_t on_ticks)
{
    uint32_t status = save_and_disable_interrupts();
    fall();
    lamp_pin.on_tick = on_tick;
    lamp_pin.on_ticks = on_ticks < MAX_ON_TICKS ? on_ticks : MAX_ON_TICKS;
    lamp_pin.phase = WAITING;
    follow();
    restore_interrupts(status);
}

bool port_off_at(tick_t off_tick)
{
    uint32_t status = save_and_disable_interrupts();
    bool lit = lamp_pin.phase == LIT;
    if (lit) {
        lamp_pin.off_tick = off_tick; /* the one-shot keeps counting from the rising edge */
        follow();
    }
    restore_interrupts(status);
    return lit;
}

void port_dark(void)
{
    uint32_t status = save_and_disable_interrupts();
    fall();
    follow();
    restore_interrupts(status);
}

bool port_take_edge(edge_t *edge)
{
    uint32_t status = save_and_disable_interrupts();
    bool any = lamp_pin.edge_count > 0;
    if (any) {
        *edge = lamp_pin.edges[lamp_pin.first_edge];
        lamp_pin.first_edge = (uint8_t)((lamp_pin.first_edge + 1) % EDGES);
        lamp_pin.edge_count--;
    }
    restore_interrupts(status);
    return any;
}

tick_t port_now(void)
{
    return time_us_64();
}

/* ---- line ---- */

void port_send(void)
{
    /* The main loop empties the outbox after every round. */
}

static void exchange_bytes(void)
{
    char bytes[64];
    int count = 0, c;
    uint8_t byte;
    while (count < (int)sizeof bytes && outbox_get(&byte))
        bytes[count++] = (char)byte;
    if (count)
        stdio_usb.out_chars(bytes, count); /* gives up after PICO_STDIO_USB_STDOUT_TIMEOUT_US */
    for (count = 0; count < 64 && (c = getchar_timeout_us(0)) >= 0; count++)
        inbox_put((uint8_t)c, (uint32_t)time_us_64());
}

/* ---- start ---- */

static void start_lamp(void)
{
    /* Waits for a count, lights, counts it down at 1 MHz, goes dark. */
    const uint16_t instructions[] = {
        (uint16_t)pio_encode_pull(false, true), (uint16_t)pio_encode_mov(pio_x, pio_osr),
        (uint16_t)pio_encode_set(pio_pins, 1),  (uint16_t)pio_encode_jmp_x_dec(3),
        (uint16_t)pio_encode_set(pio_pins, 0),
    };
    const pio_program_t program = {.instructions = instructions, .length = 5, .origin = -1};
    pio_sm_config config = pio_get_default_sm_config();
    lamp_sm = (uint)pio_claim_unused_sm(LAMP_PIO, true);
    lamp_program = (uint)pio_add_program(LAMP_PIO, &program);
    sm_config_set_wrap(&config, lamp_program, lamp_program + 4);
    sm_config_set_set_pins(&config, LAMP_GPIO, 1);
    sm_config_set_clkdiv_int_frac(&config, (uint16_t)(clock_get_hz(clk_sys) / TICK_HZ), 0);
    pio_sm_set_pins_with_mask(LAMP_PIO, lamp_sm, 0, 1U << LAMP_GPIO);
    pio_sm_set_consecutive_pindirs(LAMP_PIO, lamp_sm, LAMP_GPIO, 1, true);
    pio_sm_init(LAMP_PIO, lamp_sm, lamp_program, &config);
    pio_sm_set_enabled(LAMP_PIO, lamp_sm, true);
    pio_gpio_init(LAMP_PIO, LAMP_GPIO); /* last of all: the PIO drives it low already */
    lamp_alarm = (uint)hardware_alarm_claim_unused(true);
    hardware_alarm_set_callback(lamp_alarm, on_alarm);
}

/* Never 0 and not that of the last start, which a scratch register keeps across resets. */
static uint32_t draw_boot_nonce(void)
{
    uint32_t nonce;
    do
        nonce = get_rand_32();
    while (nonce == 0 || nonce == watchdog_hw->scratch[0]);
    watchdog_hw->scratch[0] = nonce;
    return nonce;
}

int main(void)
{
    bool hung = watchdog_enable_caused_reboot();
    start_lamp();
#ifdef PICO_DEFAULT_LED_PIN
    gpio_init(PICO_DEFAULT_LED_PIN);
    gpio_set_dir(PICO_DEFAULT_LED_PIN, GPIO_OUT);
#endif
    stdio_usb_init();
    device_start(draw_boot_nonce(), hung ? STATE_SAFE : STATE_IDLE);
    watchdog_enable(WATCHDOG_MS, true);
    for (;;) {
        watchdog_update();
        if (!device_poll() && outbox_used() == 0)
            best_effort_wfe_or_timeout(make_timeout_time_ms(1));
        exchange_bytes();
    }
}
