/* The ATmega328P: lamp on an output compare pin, UART at 115,200 baud, sleep between interrupts, watchdog.
 *
 * The lamp pin is D9 (PB1, OC1A) or D10 (PB2, OC1B): the compare unit of timer 1 makes both edges, exact to
 * the tick whatever the processor is doing, and the edge off happens even when the processor hangs. D13 would
 * not do: the boot loader blinks it at every reset. Its LED on the board follows the lamp.
 *
 * At reset all pins are inputs: the pull-down at the gate keeps the lamp off until main() drives it low.
 */
#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>

#include "device.h"
#include "limits.h"
#include "messages.h"
#include "port.h"
#include "queues.h"

#ifndef LAMP_PIN
#define LAMP_PIN 9
#endif

#if LAMP_PIN == 9
#define LAMP           _BV(PB1)
#define LAMP_OCR       OCR1A
#define LAMP_MATCH     _BV(OCF1A)
#define LAMP_INTERRUPT _BV(OCIE1A)
#define LAMP_VECTOR    TIMER1_COMPA_vect
#define CLEAR_ON_MATCH _BV(COM1A1)
#define SET_ON_MATCH   (_BV(COM1A1) | _BV(COM1A0))
#define FORCE_MATCH    _BV(FOC1A)
#define BEAT_OCR       OCR1B
#define BEAT_INTERRUPT _BV(OCIE1B)
#define BEAT_VECTOR    TIMER1_COMPB_vect
#elif LAMP_PIN == 10
#define LAMP           _BV(PB2)
#define LAMP_OCR       OCR1B
#define LAMP_MATCH     _BV(OCF1B)
#define LAMP_INTERRUPT _BV(OCIE1B)
#define LAMP_VECTOR    TIMER1_COMPB_vect
#define CLEAR_ON_MATCH _BV(COM1B1)
#define SET_ON_MATCH   (_BV(COM1B1) | _BV(COM1B0))
#define FORCE_MATCH    _BV(FOC1B)
#define BEAT_OCR       OCR1A
#define BEAT_INTERRUPT _BV(OCIE1A)
#define BEAT_VECTOR    TIMER1_COMPA_vect
#else
#error "LAMP_PIN is 9 or 10: the pins that timer 1 drives"
#endif
#define BOARD_LED _BV(PB5)

#define BEAT_TICKS (TICK_HZ / 100) /* the main loop wakes at least each 10 ms */
#define NEAR_TICKS 16              /* 64 us: nearer than this, an edge is made as soon as can be */
#define SURE_TICKS 3               /* 12 us: a match this far ahead is not missed while it is being set */
#define EDGES      8

enum { DARK, WAITING, ARMED, LIT };

/* Shared with interrupts: touched with interrupts off only. */
static struct {
    uint8_t phase;
    tick_t on_tick;
    uint16_t on_ticks;
    edge_t edges[EDGES];
    uint8_t first_edge;
    uint8_t edge_count;
} lamp_pin;
static volatile uint32_t overflows;

/* ---- before main
 * ------------------------------------------------------------------------------------------- */

static uint8_t reset_cause __attribute__((section(".noinit")));

/* A watchdog that has reset the chip stays on at its shortest time: off before anything else. */
void stop_watchdog_early(void) __attribute__((naked, used, section(".init3")));
void stop_watchdog_early(void)
{
    reset_cause = MCUSR;
    MCUSR = 0;
    wdt_disable();
}

/* ---- clock
 * ------------------------------------------------------------------------------------------------- */

/* The clock with interrupts off. */
static tick_t now_locked(void)
{
    uint16_t low = TCNT1;
    uint32_t high = overflows;
    if ((TIFR1 & _BV(TOV1)) && low < 0x8000)
        high++; /* it has overflowed and the interrupt has not been served yet */
    return (tick_t)high << 16 | low;
}

tick_t port_now(void)
{
    uint8_t status = SREG;
    tick_t now;
    cli();
    now = now_locked();
    SREG = status;
    return now;
}

ISR(TIMER1_OVF_vect)
{
    overflows++;
}

/* ---- lamp; all with interrupts off
 * -------------------------------------------------------------------------- */

static void log_edge(uint16_t at, bool on)
{
    tick_t now = now_locked();
    edge_t *edge;
    if (lamp_pin.edge_count == EDGES)
        return; /* the main loop hangs, and the watchdog is about to end it */
    edge = &lamp_pin.edges[(lamp_pin.first_edge + lamp_pin.edge_count++) % EDGES];
    edge->tick = now - (uint16_t)((uint16_t)now - at);
    edge->on = on;
}

/* A match that was made before, and whose interrupt is of no more use. (The flag is hardly ever up, as the
 * interrupt is always on: simavr takes a write to this register for one to all of its flags.) */
static void forget_match(void)
{
    if (TIFR1 & LAMP_MATCH)
        TIFR1 = LAMP_MATCH;
}

/* The compare unit lets go of the pin, which is then low: its bit in PORTB is never set. */
static void release_dark(void)
{
    TCCR1A = 0;
    PORTB &= (uint8_t)~BOARD_LED;
    forget_match();
    lamp_pin.phase = DARK;
}

static void darken_now(void)
{
    bool matched = TIFR1 & LAMP_MATCH; /* an edge has been made and its interrupt not been served yet */
    if (lamp_pin.phase == ARMED && matched) {
        log_edge(LAMP_OCR, true);
        lamp_pin.phase = LIT;
        matched = false;
    }
    /* Low through the compare unit first: its latch must be low when it next takes the pin. */
    TCCR1A = CLEAR_ON_MATCH;
    TCCR1C = FORCE_MATCH;
    if (lamp_pin.phase == LIT)
        log_edge(matched ? LAMP_OCR : TCNT1, false);
    release_dark();
}

/* The pulse that is lit ends at `at`, which is no farther than MAX_ON_TICKS from now. */
static void set_end(uint16_t at)
{
    LAMP_OCR = at;
    TCCR1A = CLEAR_ON_MATCH;
}

/* Ends the pulse when its end was set too late, or too near for the match to be sure. */
static void check_end(void)
{
    uint16_t left = (uint16_t)(LAMP_OCR - TCNT1);
    if (left < SURE_TICKS || left > MAX_ON_TICKS)
        darken_now();
}

static void arm_when_near(void)
{
    int64_t left;
    if (lamp_pin.phase != WAITING)
        return;
    left = (int64_t)(lamp_pin.on_tick - now_locked());
    if (left > 0xFFFF)
        return;
    LAMP_OCR = left < NEAR_TICKS ? (uint16_t)(TCNT1 + SURE_TICKS) : (uint16_t)lamp_pin.on_tick;
    forget_match();
    TCCR1A = SET_ON_MATCH;
    lamp_pin.phase = ARMED;
}

ISR(LAMP_VECTOR)
{
    uint16_t at = LAMP_OCR;
    if (lamp_pin.phase == ARMED) {
        set_end(
            (uint16_t)(at + lamp_pin.on_ticks)); /* before anything else: from here on it ends by itself */
        PORTB |= BOARD_LED;
        lamp_pin.phase = LIT;
        log_edge(at, true);
        check_end();
    } else if (lamp_pin.phase == LIT) {
        log_edge(at, false);
        release_dark();
    }
}

/* Each 10 ms: wakes the main loop, and arms a pulse that has come within the timer's reach. */
ISR(BEAT_VECTOR)
{
    BEAT_OCR = (uint16_t)(BEAT_OCR + BEAT_TICKS);
    arm_when_near();
}

void port_pulse(tick_t on_tick, uint32_t on_ticks)
{
    uint8_t status = SREG;
    cli();
    darken_now();
    lamp_pin.on_tick = on_tick;
    lamp_pin.on_ticks = (uint16_t)(on_ticks < MAX_ON_TICKS ? on_ticks : MAX_ON_TICKS);
    lamp_pin.phase = WAITING;
    arm_when_near();
    SREG = status;
}

bool port_off_at(tick_t off_tick)
{
    uint8_t status = SREG;
    bool moved = false;
    cli();
    if (lamp_pin.phase == LIT && !(TIFR1 & LAMP_MATCH)) {
        int64_t left = (int64_t)(off_tick - now_locked());
        if (left < NEAR_TICKS) {
            darken_now();
        } else {
            set_end((uint16_t)(left < (int64_t)MAX_ON_TICKS ? off_tick : TCNT1 + MAX_ON_TICKS));
            check_end();
        }
        moved = true;
    }
    SREG = status;
    return moved;
}

void port_dark(void)
{
    uint8_t status = SREG;
    cli();
    darken_now();
    SREG = status;
}

bool port_take_edge(edge_t *edge)
{
    uint8_t status = SREG;
    bool any;
    cli();
    any = lamp_pin.edge_count > 0;
    if (any) {
        *edge = lamp_pin.edges[lamp_pin.first_edge];
        lamp_pin.first_edge = (lamp_pin.first_edge + 1) % EDGES;
        lamp_pin.edge_count--;
    }
    SREG = status;
    return any;
}

/* ---- line
 * ---------------------------------------------------------------------------------------------------- */

ISR(USART_RX_vect)
{
    uint8_t byte = UDR0;
    inbox_put(byte, byte ? 0 : (uint32_t)now_locked());
}

ISR(USART_UDRE_vect)
{
    uint8_t byte;
    if (outbox_get(&byte))
        UDR0 = byte;
    else
        UCSR0B &= (uint8_t)~_BV(UDRIE0);
}

void port_send(void)
{
    uint8_t status = SREG;
    cli();
    UCSR0B |= _BV(UDRIE0);
    SREG = status;
}

/* ---- start
 * ---------------------------------------------------------------------------------------------------- */

/* Never 0 and not that of the last 65,535 starts: the low half counts starts, the high half is noise. The
 * count goes round eight cells of the EEPROM, so that they outlive the board. */
static uint32_t draw_boot_nonce(void)
{
    static uint16_t cells[8] EEMEM;
    uint16_t count = eeprom_read_word(&cells[0]), noise = 0;
    uint8_t i;
    for (i = 1; i < 8; i++) {
        uint16_t other = eeprom_read_word(&cells[i]);
        if ((int16_t)(other - count) > 0)
            count = other;
    }
    count++;
    if (count == 0)
        count = 1;
    eeprom_update_word(&cells[count % 8], count);

    ADMUX = _BV(REFS0) | _BV(MUX3); /* the chip's thermometer against its supply: its last bits are noise */
    ADCSRA = _BV(ADEN) | _BV(ADPS2) | _BV(ADPS1);
    for (i = 0; i < 32; i++) {
        ADCSRA |= _BV(ADSC);
        while (ADCSRA & _BV(ADSC)) {
        }
        noise = (uint16_t)((noise << 3 | noise >> 13) ^ ADC ^ TCNT1);
    }
    ADCSRA = 0;
    return (uint32_t)noise << 16 | count;
}

static void start_hardware(void)
{
    PORTB &= (uint8_t) ~(LAMP | BOARD_LED);
    DDRB |= LAMP | BOARD_LED;

    TCCR1A = 0;
    TCCR1B = _BV(CS11) | _BV(CS10); /* F_CPU / 64, counting round */
    BEAT_OCR = BEAT_TICKS;
    TIMSK1 = _BV(TOIE1) | BEAT_INTERRUPT | LAMP_INTERRUPT;

    /* 117,647 baud, 2.1 % above 115,200: what 16 MHz can do, and what the Arduino core does. */
    UCSR0A = _BV(U2X0);
    UBRR0 = 16;
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UCSR0B = _BV(RXCIE0) | _BV(RXEN0) | _BV(TXEN0);
}

int main(void)
{
    start_hardware();
    device_start(draw_boot_nonce(), reset_cause & _BV(WDRF) ? STATE_SAFE : STATE_IDLE);
    PRR = _BV(PRTWI) | _BV(PRTIM2) | _BV(PRTIM0) | _BV(PRSPI) | _BV(PRADC);
    set_sleep_mode(SLEEP_MODE_IDLE);
    wdt_enable(WDTO_60MS); /* six missed beats reset the chip, and its pins let go of the lamp */
    sei();
    for (;;) {
        wdt_reset();
        if (device_poll())
            continue;
        cli();
        if (inbox_is_empty() && !lamp_pin.edge_count) {
            sleep_enable();
            sei(); /* takes effect after the next instruction: no interrupt can slip in between */
            sleep_cpu();
            sleep_disable();
        }
        sei();
    }
}
