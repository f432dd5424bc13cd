#include "device.h"

#include <string.h>

#include "frames.h"
#include "lamp.h"
#include "limits.h"
#include "port.h"
#include "queues.h"

/* The command that was answered last, and the answer: a repeat of the same bytes gets the same bytes again.
 */
typedef struct {
    uint8_t body[MAX_BODY_BYTES];
    uint8_t body_bytes;
    uint8_t wire[MAX_WIRE_BYTES];
    uint8_t wire_bytes;
} answered_t;

/* Edges that wait for room in the outbox: a flood of answers must not drown them. */
#define WAITING_EVENTS   4
#define EVENT_WIRE_BYTES (EVENT_BYTES + HEADER_BYTES + CRC_BYTES + 2)

static struct {
    uint32_t boot_nonce;
    decoder_t decoder;
    uint8_t text;        /* how much of "?\r\n" the line has begun with since the last delimiter */
    answered_t question; /* HELLO, PING */
    answered_t
        action;   /* SET, TRAIN: kept apart, so that a PING in between does not make a repeat a new one */
    tick_t heard; /* when the last valid command came */
    tick_t next_stat;
    uint32_t crc_errors;
    uint32_t framing_errors;
    uint16_t heartbeats_lost;
    event_t events[WAITING_EVENTS];
    uint8_t first_event;
    uint8_t event_count;
} device;

static const char BANNER[] = "\r\nFlash of the relightable portrait rig, " PORT_NAME
                             "\r\nLamp: off at reset, at most 250 ms on, at most 3 flashes a second.\r\n";

/* Frames and sends; a full outbox drops the frame whole. Keeps it in `answered` unless that is null. */
static void send_frame(uint8_t type, uint16_t seq, const uint8_t *payload, uint8_t payload_bytes,
                       answered_t *answered)
{
    uint8_t wire[MAX_WIRE_BYTES];
    uint8_t wire_bytes = frame_encode(wire, type, seq, payload, payload_bytes);
    outbox_put(wire, wire_bytes);
    port_send();
    if (answered) {
        memcpy(answered->wire, wire, wire_bytes);
        answered->wire_bytes = wire_bytes;
    }
}

static void send_error(refusal_t refused, uint16_t seq, answered_t *answered)
{
    err_t message;
    uint8_t payload[ERR_BYTES];
    message.code = refused.code;
    message.refused_seq = seq;
    message.limit = refused.limit;
    err_pack(&message, payload);
    send_frame(ERR_TYPE, seq, payload, ERR_BYTES, answered);
}

static void send_stat(uint16_t seq, answered_t *answered)
{
    stat_t message;
    uint8_t payload[STAT_BYTES];
    message.boot_nonce = device.boot_nonce;
    message.tick = port_now();
    message.state = lamp_state();
    message.level = lamp_level();
    message.pulses = lamp_pulses();
    message.crc_errors = device.crc_errors;
    message.framing_errors = device.framing_errors;
    message.heartbeats_lost = device.heartbeats_lost;
    stat_pack(&message, payload);
    send_frame(STAT_TYPE, seq, payload, STAT_BYTES, answered);
}

static void send_hello(uint16_t seq, answered_t *answered)
{
    hello_t message;
    uint8_t payload[HELLO_BYTES];
    memset(&message, 0, sizeof message);
    message.protocol_major = PROTOCOL_MAJOR;
    message.protocol_minor = PROTOCOL_MINOR;
    message.schema_crc = SCHEMA_CRC;
    message.boot_nonce = device.boot_nonce;
    message.tick_hz = TICK_HZ;
    message.capabilities = CAPABILITY_SCHEDULE;
    memcpy(message.name, PORT_NAME, sizeof PORT_NAME - 1);
    hello_pack(&message, payload);
    send_frame(HELLO_TYPE, seq, payload, HELLO_BYTES, answered);
}

static void send_pong(const ping_t *ping, tick_t arrived, uint16_t seq, answered_t *answered)
{
    pong_t message;
    uint8_t payload[PONG_BYTES];
    message.boot_nonce = device.boot_nonce;
    message.t1_host_us = ping->t1_host_us;
    message.t2_tick = arrived;
    /* when its first bit will leave: after what waits already, and after it has been made */
    message.t3_tick = port_now() + (uint32_t)outbox_used() * PORT_BYTE_TICKS + PORT_ANSWER_TICKS;
    pong_pack(&message, payload);
    send_frame(PONG_TYPE, seq, payload, PONG_BYTES, answered);
}

void lamp_edge_happened(const edge_t *edge, uint32_t pulse)
{
    event_t *message;
    if (device.event_count == WAITING_EVENTS)
        return; /* STAT's count of pulses tells of it */
    message = &device.events[(device.first_event + device.event_count++) % WAITING_EVENTS];
    message->boot_nonce = device.boot_nonce;
    message->tick = edge->tick;
    message->edge = edge->on;
    message->pulse = pulse;
    message->level = edge->on ? FULL_LEVEL : 0;
}

static void send_events(void)
{
    uint8_t payload[EVENT_BYTES];
    while (device.event_count && outbox_room() >= EVENT_WIRE_BYTES) {
        event_pack(&device.events[device.first_event], payload);
        device.first_event = (uint8_t)((device.first_event + 1) % WAITING_EVENTS);
        device.event_count--;
        send_frame(EVENT_TYPE, 0, payload, EVENT_BYTES, 0);
    }
}

/* Answers again when `packet` is byte for byte what was answered last; otherwise notes it as that. */
static bool is_repeat(const packet_t *packet, answered_t *answered)
{
    if (answered->body_bytes == packet->body_bytes &&
        !memcmp(answered->body, packet->body, packet->body_bytes)) {
        outbox_put(answered->wire, answered->wire_bytes);
        port_send();
        return true;
    }
    memcpy(answered->body, packet->body, packet->body_bytes);
    answered->body_bytes = packet->body_bytes;
    return false;
}

static void hear_hello(const packet_t *packet)
{
    hello_t message;
    refusal_t wrong;
    hello_unpack(&message, packet->payload);
    if (message.boot_nonce)
        return; /* a device's own: the line echoes */
    wrong = hello_check(&message);
    if (wrong.code) {
        send_error(wrong, packet->seq, 0);
        return;
    }
    device.heard = port_now();
    device.action.body_bytes = 0; /* a host that begins may count like the one before it */
    if (!is_repeat(packet, &device.question))
        send_hello(packet->seq, &device.question);
}

static void hear_ping(const packet_t *packet, tick_t arrived)
{
    ping_t message;
    ping_unpack(&message, packet->payload);
    device.heard = port_now();
    if (!is_repeat(packet, &device.question))
        send_pong(&message, arrived, packet->seq, &device.question);
}

/* Answers a SET or a TRAIN whose values are within the limits. */
static void act(const packet_t *packet, uint32_t boot_nonce, const set_t *set, const train_t *train)
{
    refusal_t refused = {ERROR_STALE_NONCE, 0};
    device.heard = port_now();
    if (is_repeat(packet, &device.action))
        return;
    if (boot_nonce == device.boot_nonce)
        refused = set ? lamp_set(set->level, set->ttl_ms) : lamp_train(train);
    if (refused.code)
        send_error(refused, packet->seq, &device.action);
    else
        send_stat(packet->seq, &device.action);
}

static void hear_set(const packet_t *packet)
{
    set_t message;
    refusal_t wrong;
    set_unpack(&message, packet->payload);
    wrong = set_check(&message);
    if (wrong.code)
        send_error(wrong, packet->seq, 0);
    else
        act(packet, message.boot_nonce, &message, 0);
}

static void hear_train(const packet_t *packet)
{
    train_t message;
    refusal_t wrong;
    train_unpack(&message, packet->payload);
    wrong = train_check(&message);
    if (wrong.code)
        send_error(wrong, packet->seq, 0);
    else
        act(packet, message.boot_nonce, 0, &message);
}

static void hear(const packet_t *packet, tick_t arrived)
{
    int16_t expected = payload_bytes(packet->type);
    refusal_t refused;
    switch (packet->type) {
    case PONG_TYPE:
    case STAT_TYPE:
    case EVENT_TYPE:
    case ERR_TYPE:
        return; /* only devices say these: the line echoes, and an answer would echo too */
    default:
        break;
    }
    if (expected != packet->payload_bytes) {
        refused.code = expected < 0 ? ERROR_UNKNOWN_TYPE : ERROR_LENGTH;
        refused.limit = expected < 0 ? 0 : (uint32_t)expected;
        send_error(refused, packet->seq, 0);
        return;
    }
    switch (packet->type) {
    case HELLO_TYPE:
        hear_hello(packet);
        break;
    case PING_TYPE:
        hear_ping(packet, arrived);
        break;
    case SET_TYPE:
        hear_set(packet);
        break;
    case TRAIN_TYPE:
        hear_train(packet);
        break;
    default: /* STOP: obeyed every time, repeat or not */
        device.heard = port_now();
        lamp_stop();
        send_stat(packet->seq, 0);
        break;
    }
}

/* A person at a terminal: "?" and a line feed at the beginning of the line get the banner. No frame of this
 * version begins so, as its second byte is the version. */
static void watch_for_text(uint8_t byte)
{
    static const char ASKED[] = "?\n";
    if (byte == 0)
        device.text = 0;
    else if (device.text < 2 && byte == (uint8_t)ASKED[device.text])
        device.text++;
    else if (!(device.text == 1 && byte == '\r'))
        device.text = 3; /* something else, until the next delimiter */
    if (device.text == 2) {
        outbox_put((const uint8_t *)BANNER, sizeof BANNER); /* its closing zero is the delimiter */
        port_send();
        memset(&device.decoder, 0, sizeof device.decoder);
        device.text = 0;
    }
}

/* Takes bytes up to the end of one frame. Returns whether there may be more. */
static bool take_frame(void)
{
    packet_t packet;
    refusal_t refused = {ERROR_VERSION, WIRE_VERSION};
    uint8_t byte;
    uint32_t stamp;
    tick_t now;
    while (inbox_get(&byte, &stamp)) {
        frame_outcome_t outcome = decoder_feed(&device.decoder, byte, &packet);
        watch_for_text(byte);
        switch (outcome) {
        case FRAME_NONE:
            continue;
        case FRAME_GOOD:
            now = port_now();
            hear(&packet, now - (uint32_t)((uint32_t)now - stamp));
            break;
        case FRAME_VERSION:
            send_error(refused, packet.seq, 0);
            break;
        case FRAME_CRC:
            device.crc_errors++;
            break;
        case FRAME_OVERSIZED:
        case FRAME_FRAMING:
            device.framing_errors++;
            break;
        }
        return true;
    }
    return false;
}

void device_start(uint32_t boot_nonce, uint8_t state)
{
    static const uint8_t FLUSH = 0;
    memset(&device, 0, sizeof device);
    queues_start();
    lamp_start(state);
    device.boot_nonce = boot_nonce;
    device.heard = port_now();
    device.next_stat = port_now() + TICK_HZ;
    outbox_put(&FLUSH, 1);
    port_send();
}

bool device_poll(void)
{
    refusal_t lost = {ERROR_HEARTBEAT, HEARTBEAT_TIMEOUT_MS};
    bool more;
    lamp_poll();
    send_events();
    more = take_frame();
    if (lamp_is_active() && reached(port_now(), device.heard + HEARTBEAT_TICKS)) {
        lamp_make_safe();
        device.heartbeats_lost++;
        send_error(lost, 0, 0);
    }
    if (reached(port_now(), device.next_stat)) {
        device.next_stat = port_now() + TICK_HZ;
        send_stat(0, 0);
    }
    return more;
}
