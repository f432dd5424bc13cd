/* The messages: their fields in order, once; structures, packing and the schema are made from this list. */
#ifndef MESSAGES_H
#define MESSAGES_H

#include <stdbool.h>
#include <stdint.h>

#define NAME_BYTES 24

/* FIELD(kind, name) with the kinds U8, U16, U32, U64 and TEXT24, little-endian on the wire. */
#define HELLO_FIELDS(FIELD)                                                                                  \
    FIELD(U8, protocol_major)                                                                                \
    FIELD(U8, protocol_minor)                                                                                \
    FIELD(U16, schema_crc)                                                                                   \
    FIELD(U32, boot_nonce)                                                                                   \
    FIELD(U32, tick_hz)                                                                                      \
    FIELD(U32, capabilities)                                                                                 \
    FIELD(TEXT24, name)
#define PING_FIELDS(FIELD) FIELD(U64, t1_host_us)
#define PONG_FIELDS(FIELD)                                                                                   \
    FIELD(U32, boot_nonce)                                                                                   \
    FIELD(U64, t1_host_us)                                                                                   \
    FIELD(U64, t2_tick)                                                                                      \
    FIELD(U64, t3_tick)
#define SET_FIELDS(FIELD)                                                                                    \
    FIELD(U32, boot_nonce)                                                                                   \
    FIELD(U16, level)                                                                                        \
    FIELD(U16, ttl_ms)
#define TRAIN_FIELDS(FIELD)                                                                                  \
    FIELD(U32, boot_nonce)                                                                                   \
    FIELD(U64, t0_tick)                                                                                      \
    FIELD(U32, period_us)                                                                                    \
    FIELD(U32, on_us)                                                                                        \
    FIELD(U16, count)                                                                                        \
    FIELD(U16, level)
#define STOP_FIELDS(FIELD)
#define STAT_FIELDS(FIELD)                                                                                   \
    FIELD(U32, boot_nonce)                                                                                   \
    FIELD(U64, tick)                                                                                         \
    FIELD(U8, state)                                                                                         \
    FIELD(U16, level)                                                                                        \
    FIELD(U32, pulses)                                                                                       \
    FIELD(U32, crc_errors)                                                                                   \
    FIELD(U32, framing_errors)                                                                               \
    FIELD(U16, heartbeats_lost)
#define EVENT_FIELDS(FIELD)                                                                                  \
    FIELD(U32, boot_nonce)                                                                                   \
    FIELD(U64, tick)                                                                                         \
    FIELD(U8, edge)                                                                                          \
    FIELD(U32, pulse)                                                                                        \
    FIELD(U16, level)
#define ERR_FIELDS(FIELD)                                                                                    \
    FIELD(U8, code)                                                                                          \
    FIELD(U16, refused_seq)                                                                                  \
    FIELD(U32, limit)

/* MESSAGE(NAME, structure, type). STOP stands apart: it has no fields, and C has no empty structure. */
#define MESSAGES_WITH_FIELDS(MESSAGE)                                                                        \
    MESSAGE(HELLO, hello, 0x01)                                                                              \
    MESSAGE(PING, ping, 0x02)                                                                                \
    MESSAGE(PONG, pong, 0x03)                                                                                \
    MESSAGE(SET, set, 0x04)                                                                                  \
    MESSAGE(TRAIN, train, 0x05)                                                                              \
    MESSAGE(STAT, stat, 0x07)                                                                                \
    MESSAGE(EVENT, event, 0x08)                                                                              \
    MESSAGE(ERR, err, 0x09)
#define STOP_TYPE 0x06

#define KIND_U8(name)     uint8_t name;
#define KIND_U16(name)    uint16_t name;
#define KIND_U32(name)    uint32_t name;
#define KIND_U64(name)    uint64_t name;
#define KIND_TEXT24(name) char name[NAME_BYTES];
#define SIZE_U8           1
#define SIZE_U16          2
#define SIZE_U32          4
#define SIZE_U64          8
#define SIZE_TEXT24       NAME_BYTES

#define DECLARE_FIELD(kind, name) KIND_##kind(name)
#define ADD_FIELD(kind, name)     +SIZE_##kind

#define DECLARE_MESSAGE(NAME, structure, type)                                                               \
    typedef struct {                                                                                         \
        NAME##_FIELDS(DECLARE_FIELD)                                                                         \
    } structure##_t;                                                                                         \
    enum { NAME##_TYPE = type, NAME##_BYTES = 0 NAME##_FIELDS(ADD_FIELD) };                                  \
    void structure##_pack(const structure##_t *message, uint8_t *payload);                                   \
    void structure##_unpack(structure##_t *message, const uint8_t *payload);
MESSAGES_WITH_FIELDS(DECLARE_MESSAGE)

enum { STATE_IDLE, STATE_SET, STATE_TRAIN, STATE_SAFE };
enum { CAPABILITY_SCHEDULE = 1, CAPABILITY_DIMMABLE = 2, CAPABILITY_FEEDBACK = 4 };
enum {
    ERROR_NONE, /* never on the wire */
    ERROR_VERSION,
    ERROR_UNKNOWN_TYPE,
    ERROR_LENGTH,
    ERROR_OUT_OF_RANGE,
    ERROR_STALE_NONCE,
    ERROR_LATE,
    ERROR_RATE,
    ERROR_HEARTBEAT,
    ERROR_UNSUPPORTED
};

/* Why something was not done: an ERROR_ and the limit that was broken, 0 where there is none. */
typedef struct {
    uint8_t code;
    uint32_t limit;
} refusal_t;

/* Length of a type's payload, or -1 for a type that is not known. */
int16_t payload_bytes(uint8_t type);

/* What is wrong with the values of a message, whatever state the device is in: ERROR_NONE for nothing. The
 * same messages pass here as can be built in Python. */
refusal_t hello_check(const hello_t *message);
refusal_t pong_check(const pong_t *message);
refusal_t set_check(const set_t *message);
refusal_t train_check(const train_t *message);
refusal_t stat_check(const stat_t *message);
refusal_t event_check(const event_t *message);

#endif
