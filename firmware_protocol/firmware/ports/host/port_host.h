/* The host port's own side: moving its clock, its line and its pin. Nothing here waits or asks the system's
 * time, so that a session is the same on every run. */
#ifndef PORT_HOST_H
#define PORT_HOST_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "ticks.h"

/* Called at every edge of the pin, when it happens. */
extern void (*host_edge_hook)(const edge_t *edge);

/* Called with every byte that the device sends. */
extern void (*host_sent_hook)(uint8_t byte);

/* Sets the clock; before host_reset. Tests begin just before a wrap. */
void host_set_clock(tick_t now);

/* A reset of any kind: the pin drops, the memory is lost, the core starts. */
void host_reset(uint32_t boot_nonce, uint8_t state);

/* Moves the clock to `until`, through every edge and every 10 ms on the way, as the timer's hardware would.
 */
void host_advance(tick_t until);

/* Bytes arrive from the line, now. */
void host_receive(const uint8_t *data, size_t length);

/* When the next edge is due; `otherwise` when none is. */
tick_t host_next_edge(tick_t otherwise);

/* The pin. */
bool host_is_lit(void);

/* A fault to test the core's own guard with: the timer no longer makes the edge off. */
void host_break_timer(void);

#endif
