#include "frames.h"

#include <string.h>

#include "cobs.h"
#include "crc16.h"

#define DELIMITER 0

static frame_outcome_t complete(decoder_t *decoder, packet_t *packet)
{
    size_t length = cobs_unstuff(decoder->bytes, decoder->used, decoder->bytes);
    if (length == COBS_BAD || length < HEADER_BYTES + CRC_BYTES)
        return FRAME_FRAMING;
    if (crc16_mcrf4xx(CRC16_INITIAL, decoder->bytes, length) != 0)
        return FRAME_CRC;
    packet->type = decoder->bytes[1];
    packet->seq = (uint16_t)(decoder->bytes[2] | (uint16_t)decoder->bytes[3] << 8);
    packet->body = decoder->bytes;
    packet->body_bytes = (uint8_t)(length - CRC_BYTES);
    packet->payload = decoder->bytes + HEADER_BYTES;
    packet->payload_bytes = (uint8_t)(length - HEADER_BYTES - CRC_BYTES);
    return decoder->bytes[0] == WIRE_VERSION ? FRAME_GOOD : FRAME_VERSION;
}

frame_outcome_t decoder_feed(decoder_t *decoder, uint8_t byte, packet_t *packet)
{
    frame_outcome_t outcome = FRAME_NONE;
    if (byte != DELIMITER) {
        if (decoder->used < sizeof decoder->bytes)
            decoder->bytes[decoder->used++] = byte;
        else
            decoder->overflowed = true;
        return FRAME_NONE;
    }
    if (decoder->overflowed)
        outcome = FRAME_OVERSIZED;
    else if (decoder->used) /* a delimiter alone flushes the line; it says nothing */
        outcome = complete(decoder, packet);
    decoder->used = 0;
    decoder->overflowed = false;
    return outcome;
}

uint8_t frame_encode(uint8_t *wire, uint8_t type, uint16_t seq, const uint8_t *payload, uint8_t payload_bytes)
{
    uint8_t body[MAX_BODY_BYTES];
    uint8_t used = HEADER_BYTES;
    uint16_t crc;
    size_t stuffed;
    if (payload_bytes > MAX_PAYLOAD_BYTES)
        return 0;
    body[0] = WIRE_VERSION;
    body[1] = type;
    body[2] = (uint8_t)seq;
    body[3] = (uint8_t)(seq >> 8);
    if (payload_bytes)
        memcpy(body + used, payload, payload_bytes);
    used = (uint8_t)(used + payload_bytes);
    crc = crc16_mcrf4xx(CRC16_INITIAL, body, used);
    body[used++] = (uint8_t)crc;
    body[used++] = (uint8_t)(crc >> 8);
    stuffed = cobs_stuff(body, used, wire);
    wire[stuffed] = DELIMITER;
    return (uint8_t)(stuffed + 1);
}
