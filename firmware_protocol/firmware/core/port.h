/* What a port gives to the core: a clock, a lamp that can only pulse, a line.
 *
 * There is no call that turns the lamp on. The one way to light it is a pulse that carries its own end, and
 * the port cuts a pulse that is longer than MAX_ON_TICKS: nothing in the core can leave the lamp on.
 *
 * A port also has `port_constants.h` on the include path: TICK_HZ, PORT_NAME (at most 24 ASCII characters),
 * PORT_LEAD_TICKS (how far ahead a train's first flash must be), PORT_BYTE_TICKS (a byte on the line) and
 * PORT_ANSWER_TICKS (from reading the clock for a PONG to its first bit).
 */
#ifndef PORT_H
#define PORT_H

#include <stdbool.h>
#include <stdint.h>

#include "ticks.h"

/* The device's clock. */
tick_t port_now(void);

/* Light from `on_tick`, or from now when that has passed, for `on_ticks`. Only while dark; replaces a pulse
 * that has not begun. Both edges are made without the core's help. */
void port_pulse(tick_t on_tick, uint32_t on_ticks);

/* Moves the end of the pulse that is lit. False, and nothing done, when none is. */
bool port_off_at(tick_t off_tick);

/* Dark now, and no pulse in waiting. */
void port_dark(void);

/* The oldest edge of the pin that has not been taken. False when there is none. */
bool port_take_edge(edge_t *edge);

/* Something was put into the outbox. */
void port_send(void);

#endif
