/* Lets a test compare this C with vectors.json and with the Python codec, a line at a time on standard input:
 *
 *     crc HEX             CRC-16 in decimal                    (empty data is written "-")
 *     stuff HEX           COBS, in hexadecimal
 *     unstuff HEX         its inverse, or "bad"
 *     encode SEQ NAME VALUE...     the frame; text as hexadecimal ("-" when empty)
 *     decode HEX          "packet SEQ NAME VALUE..." or "fault REASON SEQ" for each frame, ended by "end"
 *     constants           "NAME VALUE" for each, ended by "end"
 *     schema              its lines, ended by "end"
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "cobs.h"
#include "crc16.h"
#include "frames.h"
#include "limits.h"
#include "messages.h"

#define LONGEST 4096

static size_t from_hex(const char *text, uint8_t *out)
{
    size_t count = 0;
    unsigned value;
    while (text && sscanf(text, "%2x", &value) == 1 && count < LONGEST) {
        out[count++] = (uint8_t)value;
        text += 2;
    }
    return count;
}

static void print_hex(const uint8_t *data, size_t length)
{
    while (length--)
        printf("%02x", *data++);
}

/* ---- fields as text
 * ---------------------------------------------------------------------------------------- */

static uint64_t next_number(void)
{
    const char *word = strtok(0, " \n");
    return word ? strtoull(word, 0, 10) : 0;
}

static void print_text(const char *name)
{
    size_t length = NAME_BYTES;
    while (length && !name[length - 1])
        length--;
    printf(length ? " " : " -");
    print_hex((const uint8_t *)name, length);
}

static void next_text(char *name)
{
    uint8_t bytes[LONGEST];
    size_t length = from_hex(strtok(0, " \n"), bytes);
    memset(name, 0, NAME_BYTES);
    memcpy(name, bytes, length < NAME_BYTES ? length : NAME_BYTES);
}

#define READ_U8(name)          message.name = (uint8_t)next_number();
#define READ_U16(name)         message.name = (uint16_t)next_number();
#define READ_U32(name)         message.name = (uint32_t)next_number();
#define READ_U64(name)         message.name = next_number();
#define READ_TEXT24(name)      next_text(message.name);
#define READ_FIELD(kind, name) READ_##kind(name)

#define PRINT_U8(name)          printf(" %u", (unsigned)message.name);
#define PRINT_U16(name)         printf(" %u", (unsigned)message.name);
#define PRINT_U32(name)         printf(" %lu", (unsigned long)message.name);
#define PRINT_U64(name)         printf(" %llu", (unsigned long long)message.name);
#define PRINT_TEXT24(name)      print_text(message.name);
#define PRINT_FIELD(kind, name) PRINT_##kind(name)

#define DEFINE_TEXT(NAME, structure, type)                                                                   \
    static void structure##_read(uint8_t *payload)                                                           \
    {                                                                                                        \
        structure##_t message;                                                                               \
        NAME##_FIELDS(READ_FIELD) structure##_pack(&message, payload);                                       \
    }                                                                                                        \
    static void structure##_print(const uint8_t *payload)                                                    \
    {                                                                                                        \
        structure##_t message;                                                                               \
        structure##_unpack(&message, payload);                                                               \
        printf(" " #NAME);                                                                                   \
        NAME##_FIELDS(PRINT_FIELD)                                                                           \
    }
MESSAGES_WITH_FIELDS(DEFINE_TEXT)

/* ---- commands
 * ---------------------------------------------------------------------------------------------- */

#define ENCODE_CASE(NAME, structure, number)                                                                 \
    if (!strcmp(name, #NAME)) {                                                                              \
        type = number;                                                                                       \
        structure##_read(payload);                                                                           \
    }

static void encode(void)
{
    uint16_t seq = (uint16_t)next_number();
    const char *name = strtok(0, " \n");
    uint8_t payload[MAX_PAYLOAD_BYTES], wire[MAX_WIRE_BYTES], type = STOP_TYPE;
    if (!name)
        return;
    MESSAGES_WITH_FIELDS(ENCODE_CASE)
    print_hex(wire, frame_encode(wire, type, seq, payload, (uint8_t)payload_bytes(type)));
    printf("\n");
}

static bool values_are_wrong(const packet_t *packet)
{
#define CHECK_CASE(NAME, structure)                                                                          \
    case NAME##_TYPE: {                                                                                      \
        structure##_t message;                                                                               \
        structure##_unpack(&message, packet->payload);                                                       \
        return structure##_check(&message).code != ERROR_NONE;                                               \
    }
    switch (packet->type) {
        CHECK_CASE(HELLO, hello)
        CHECK_CASE(PONG, pong)
        CHECK_CASE(SET, set)
        CHECK_CASE(TRAIN, train)
        CHECK_CASE(STAT, stat)
        CHECK_CASE(EVENT, event)
    default:
        return false;
    }
}

#define PRINT_CASE(NAME, structure, number)                                                                  \
    case number:                                                                                             \
        structure##_print(packet->payload);                                                                  \
        break;

static void print_packet(const packet_t *packet)
{
    printf("packet %u", packet->seq);
    switch (packet->type) {
        MESSAGES_WITH_FIELDS(PRINT_CASE)
    default:
        printf(" STOP");
        break;
    }
    printf("\n");
}

static void print_good(const packet_t *packet)
{
    int16_t expected = payload_bytes(packet->type);
    if (expected < 0)
        printf("fault unknown_type %u\n", packet->seq);
    else if (expected != packet->payload_bytes || values_are_wrong(packet))
        printf("fault payload %u\n", packet->seq);
    else
        print_packet(packet);
}

static void decode(const uint8_t *data, size_t length)
{
    decoder_t decoder;
    packet_t packet;
    memset(&decoder, 0, sizeof decoder);
    while (length--)
        switch (decoder_feed(&decoder, *data++, &packet)) {
        case FRAME_NONE:
            break;
        case FRAME_GOOD:
            print_good(&packet);
            break;
        case FRAME_OVERSIZED:
            printf("fault oversized -\n");
            break;
        case FRAME_FRAMING:
            printf("fault framing -\n");
            break;
        case FRAME_CRC:
            printf("fault crc -\n");
            break;
        case FRAME_VERSION:
            printf("fault version %u\n", packet.seq);
            break;
        }
    printf("end\n");
}

static void print_constants(void)
{
#define PRINT_CONSTANT(name) printf(#name " %lu\n", (unsigned long)(name));
    PRINT_CONSTANT(WIRE_VERSION)
    PRINT_CONSTANT(PROTOCOL_MAJOR)
    PRINT_CONSTANT(PROTOCOL_MINOR)
    PRINT_CONSTANT(SCHEMA_CRC)
    PRINT_CONSTANT(MAX_WIRE_BYTES)
    PRINT_CONSTANT(HEADER_BYTES)
    PRINT_CONSTANT(CRC_BYTES)
    PRINT_CONSTANT(MAX_BODY_BYTES)
    PRINT_CONSTANT(MAX_PAYLOAD_BYTES)
    PRINT_CONSTANT(MAX_ON_MS)
    PRINT_CONSTANT(MAX_RATE_HZ)
    PRINT_CONSTANT(MIN_PERIOD_US)
    PRINT_CONSTANT(HEARTBEAT_TIMEOUT_MS)
    PRINT_CONSTANT(FULL_LEVEL)
    PRINT_CONSTANT(STATE_IDLE)
    PRINT_CONSTANT(STATE_SET)
    PRINT_CONSTANT(STATE_TRAIN)
    PRINT_CONSTANT(STATE_SAFE)
    PRINT_CONSTANT(CAPABILITY_SCHEDULE)
    PRINT_CONSTANT(CAPABILITY_DIMMABLE)
    PRINT_CONSTANT(CAPABILITY_FEEDBACK)
    PRINT_CONSTANT(ERROR_VERSION)
    PRINT_CONSTANT(ERROR_UNKNOWN_TYPE)
    PRINT_CONSTANT(ERROR_LENGTH)
    PRINT_CONSTANT(ERROR_OUT_OF_RANGE)
    PRINT_CONSTANT(ERROR_STALE_NONCE)
    PRINT_CONSTANT(ERROR_LATE)
    PRINT_CONSTANT(ERROR_RATE)
    PRINT_CONSTANT(ERROR_HEARTBEAT)
    PRINT_CONSTANT(ERROR_UNSUPPORTED)
    printf("end\n");
}

#define CODE_U8                        "B"
#define CODE_U16                       "H"
#define CODE_U32                       "I"
#define CODE_U64                       "Q"
#define CODE_TEXT24                    "24s"
#define PRINT_SCHEMA_FIELD(kind, name) " " #name ":" CODE_##kind
#define PRINT_SCHEMA(NAME, structure, type)                                                                  \
    if (type > STOP_TYPE && !stopped) {                                                                      \
        printf("%02x STOP\n", STOP_TYPE);                                                                    \
        stopped = true;                                                                                      \
    }                                                                                                        \
    printf("%02x " #NAME NAME##_FIELDS(PRINT_SCHEMA_FIELD) "\n", type);

static void print_schema(void)
{
    bool stopped = false;
    MESSAGES_WITH_FIELDS(PRINT_SCHEMA)
    printf("end\n");
}

int main(void)
{
    static char line[4 * LONGEST];
    static uint8_t data[LONGEST], out[2 * LONGEST];
    while (fgets(line, sizeof line, stdin)) {
        const char *command = strtok(line, " \n");
        if (!command)
            continue;
        if (!strcmp(command, "encode")) {
            encode();
        } else if (!strcmp(command, "constants")) {
            print_constants();
        } else if (!strcmp(command, "schema")) {
            print_schema();
        } else {
            size_t length = from_hex(strtok(0, " \n"), data);
            if (!strcmp(command, "crc")) {
                printf("%u\n", crc16_mcrf4xx(CRC16_INITIAL, data, length));
            } else if (!strcmp(command, "stuff")) {
                print_hex(out, cobs_stuff(data, length, out));
                printf("\n");
            } else if (!strcmp(command, "unstuff")) {
                size_t found = cobs_unstuff(data, length, out);
                if (found == COBS_BAD)
                    printf("bad");
                else
                    print_hex(out, found);
                printf("\n");
            } else if (!strcmp(command, "decode")) {
                decode(data, length);
            }
        }
        fflush(stdout);
    }
    return 0;
}
