/* Consistent overhead byte stuffing (Cheshire and Baker 1999): bytes without zeros, so that a zero can end a
 * frame. */
#ifndef COBS_H
#define COBS_H

#include <stddef.h>
#include <stdint.h>

#define COBS_BAD ((size_t) - 1)

/* `data` without zero bytes, into `out` with room for length + length / 254 + 1; the delimiter is not added.
 * Returns how many bytes. */
size_t cobs_stuff(const uint8_t *data, size_t length, uint8_t *out);

/* The bytes that cobs_stuff was given; `out` may be `stuffed` itself. COBS_BAD for a zero inside or a code
 * byte that points past the end. */
size_t cobs_unstuff(const uint8_t *stuffed, size_t length, uint8_t *out);

#endif
