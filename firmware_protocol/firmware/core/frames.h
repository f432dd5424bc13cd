/* Frames: one message each, checked, delimited, found again after any garbage. */
#ifndef FRAMES_H
#define FRAMES_H

#include <stdbool.h>
#include <stdint.h>

#include "limits.h"

/* What a byte completed. */
typedef enum {
    FRAME_NONE, /* nothing yet */
    FRAME_GOOD,
    FRAME_OVERSIZED, /* more bytes than the longest frame without a delimiter */
    FRAME_FRAMING,   /* not COBS, or too short for a header and a checksum */
    FRAME_CRC,
    FRAME_VERSION /* intact, of another wire version: type and seq are known */
} frame_outcome_t;

/* Collects one frame; holds no more than the longest one. All zeros is a fresh one. */
typedef struct {
    uint8_t bytes[MAX_WIRE_BYTES - 1];
    uint8_t used;
    bool overflowed;
} decoder_t;

/* An intact frame. It lies in its decoder and is gone with the next byte fed. */
typedef struct {
    uint8_t type;
    uint16_t seq;
    const uint8_t *body; /* header and payload, without the checksum */
    uint8_t body_bytes;
    const uint8_t *payload;
    uint8_t payload_bytes;
} packet_t;

/* Takes one byte from the line. `packet` is filled for FRAME_GOOD and FRAME_VERSION. */
frame_outcome_t decoder_feed(decoder_t *decoder, uint8_t byte, packet_t *packet);

/* The frame for a message, delimiter included, into `wire` with room for MAX_WIRE_BYTES. Returns how many
 * bytes; 0 when the payload is longer than MAX_PAYLOAD_BYTES. */
uint8_t frame_encode(uint8_t *wire, uint8_t type, uint16_t seq, const uint8_t *payload,
                     uint8_t payload_bytes);

#endif
