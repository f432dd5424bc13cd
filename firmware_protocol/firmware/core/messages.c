#include "messages.h"

#include <string.h>

#include "limits.h"

/* Fields are copied as they lie in memory: quick, and right where memory is little-endian like the wire. */
#if !defined(__BYTE_ORDER__) || __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "the wire is little-endian, and so must be the part"
#endif

#define COPY_OUT(kind, name)                                                                                 \
    memcpy(payload, &message->name, SIZE_##kind);                                                            \
    payload += SIZE_##kind;
#define COPY_IN(kind, name)                                                                                  \
    memcpy(&message->name, payload, SIZE_##kind);                                                            \
    payload += SIZE_##kind;

#define DEFINE_MESSAGE(NAME, structure, type)                                                                \
    void structure##_pack(const structure##_t *message, uint8_t *payload)                                    \
    {                                                                                                        \
        NAME##_FIELDS(COPY_OUT)                                                                              \
    }                                                                                                        \
    void structure##_unpack(structure##_t *message, const uint8_t *payload)                                  \
    {                                                                                                        \
        NAME##_FIELDS(COPY_IN)                                                                               \
    }
MESSAGES_WITH_FIELDS(DEFINE_MESSAGE)

#define LENGTH_CASE(NAME, structure, type)                                                                   \
    case type:                                                                                               \
        return NAME##_BYTES;

int16_t payload_bytes(uint8_t type)
{
    switch (type) {
        MESSAGES_WITH_FIELDS(LENGTH_CASE)
    case STOP_TYPE:
        return 0;
    default:
        return -1;
    }
}

static refusal_t refusal(uint8_t code, uint32_t limit)
{
    refusal_t made;
    made.code = code;
    made.limit = limit;
    return made;
}

refusal_t hello_check(const hello_t *message)
{
    bool ended = false;
    uint8_t i;
    for (i = 0; i < NAME_BYTES; i++) {
        if ((message->name[i] & 0x80) || (ended && message->name[i]))
            return refusal(ERROR_OUT_OF_RANGE, 0x7F);
        ended = !message->name[i];
    }
    return refusal(ERROR_NONE, 0);
}

refusal_t pong_check(const pong_t *message)
{
    return refusal(message->t3_tick < message->t2_tick ? ERROR_OUT_OF_RANGE : ERROR_NONE, 0);
}

refusal_t set_check(const set_t *message)
{
    if (message->ttl_ms > MAX_ON_MS)
        return refusal(ERROR_OUT_OF_RANGE, MAX_ON_MS);
    return refusal(ERROR_NONE, 0);
}

refusal_t train_check(const train_t *message)
{
    if (message->period_us < MIN_PERIOD_US)
        return refusal(ERROR_RATE, MIN_PERIOD_US);
    if (message->on_us > MAX_ON_MS * 1000UL)
        return refusal(ERROR_OUT_OF_RANGE, MAX_ON_MS * 1000UL);
    if (message->on_us == 0 || message->count == 0)
        return refusal(ERROR_OUT_OF_RANGE, 1);
    return refusal(ERROR_NONE, 0);
}

refusal_t stat_check(const stat_t *message)
{
    return refusal(message->state > STATE_SAFE ? ERROR_OUT_OF_RANGE : ERROR_NONE, STATE_SAFE);
}

refusal_t event_check(const event_t *message)
{
    return refusal(message->edge > 1 ? ERROR_OUT_OF_RANGE : ERROR_NONE, 1);
}
