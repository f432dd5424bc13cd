/* What the lamp does: one flash or a train of them, never beyond the limits.
 *
 * All of it runs in the main loop. Interrupts only make the edges that were armed and log when they happened.
 */
#ifndef LAMP_H
#define LAMP_H

#include "messages.h"
#include "ticks.h"

/* Dark, in `state` (STATE_IDLE, or STATE_SAFE after a watchdog). The start counts as three flashes: after any
 * reset the lamp stays dark for a second, so that resets cannot be used to flash faster than the limit. */
void lamp_start(uint8_t state);

/* Takes the edges that have happened and arms the next flash. Call it at least each 20 ms. */
void lamp_poll(void);

/* SET. While lit it moves the end, but not beyond MAX_ON_MS from the pulse's beginning. */
refusal_t lamp_set(uint16_t level, uint16_t ttl_ms);

/* TRAIN; the message has passed train_check. A refused train leaves the one before it alone. */
refusal_t lamp_train(const train_t *train);

/* STOP. Dark; a safe lamp stays safe. */
void lamp_stop(void);

/* Dark until the next SET or TRAIN: a watchdog has fired. */
void lamp_make_safe(void);

/* Whether it is lit or going to be by itself: what a lost heartbeat must end. */
bool lamp_is_active(void);

uint8_t lamp_state(void);
uint16_t lamp_level(void);
uint32_t lamp_pulses(void);

/* Called for every edge, in order. The device makes an EVENT of it. */
void lamp_edge_happened(const edge_t *edge, uint32_t pulse);

#endif
