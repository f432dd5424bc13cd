/* Bytes between interrupts and the main loop: one side writes, the other reads, neither waits.
 *
 * Each queue has 256 bytes and 8-bit positions that wrap by themselves; a position is one byte, so that even
 * an 8-bit part reads it whole, and it moves only after what it announces has been written (all is volatile).
 */
#ifndef QUEUES_H
#define QUEUES_H

#include <stdbool.h>
#include <stdint.h>

/* Empties both. */
void queues_start(void);

/* From the line, in the receive interrupt. `tick` is the low half of the clock and is kept for delimiters
 * only. Delimiters in a row count as one. With no room the byte is dropped, and the frame's checksum will
 * tell. */
void inbox_put(uint8_t byte, uint32_t tick);

/* The oldest byte from the line; `tick` is set with a delimiter. False when there is none. */
bool inbox_get(uint8_t *byte, uint32_t *tick);

bool inbox_is_empty(void);

/* All of `data` towards the line, or nothing and false when there is no room for all: no frame is ever torn.
 */
bool outbox_put(const uint8_t *data, uint8_t length);

/* The next byte for the line, in the transmit interrupt. False when there is none. */
bool outbox_get(uint8_t *byte);

/* How many bytes outbox_put would take. */
uint8_t outbox_room(void);

/* Bytes that wait for the line. */
uint8_t outbox_used(void);

#endif
