/* Random sessions against the core, under the sanitizers: whatever comes from the line, whenever, the limits
 * hold.
 *
 *     fuzz EXECUTIONS SEED < corpus      (a frame a line, in hexadecimal: every wire of vectors.json)
 *
 * A session is a dozen steps: a frame of the corpus, damaged or whole; a command with a right checksum, the
 * right or a wrong nonce and values at and beyond the limits; noise; time; a reset. Then the line falls
 * silent. Ends with the first broken promise, by abort().
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "cobs.h"
#include "frames.h"
#include "limits.h"
#include "messages.h"
#include "port.h"
#include "port_host.h"

#define MAX_FRAMES 256
#define STEPS      12

static struct {
    uint8_t bytes[MAX_WIRE_BYTES + 16];
    size_t length;
} corpus[MAX_FRAMES];
static size_t corpus_frames;

static uint64_t random_state;
static uint32_t nonce = 1;
static uint16_t seq;

static unsigned long long flashes, sent_frames, resets, fed_bytes, answered_pings;
static tick_t rises[MAX_RATE_HZ], lit_since;
static decoder_t answers;

static void fail(const char *promise)
{
    fprintf(stderr, "broken at tick %llu: %s\n", (unsigned long long)port_now(), promise);
    abort();
}

/* xorshift64* (Vigna 2016). */
static uint32_t draw(uint32_t below)
{
    random_state ^= random_state >> 12;
    random_state ^= random_state << 25;
    random_state ^= random_state >> 27;
    return (uint32_t)((random_state * 2685821657736338717ULL) >> 32) % below;
}

static uint64_t draw_value(uint64_t limit)
{
    switch (draw(6)) {
    case 0:
        return limit;
    case 1:
        return limit + 1;
    case 2:
        return 0;
    case 3:
        return UINT64_MAX;
    case 4:
        return draw(UINT32_MAX);
    default:
        return limit ? draw((uint32_t)(limit < UINT32_MAX ? limit : UINT32_MAX)) : 0;
    }
}

static void check_edge(const edge_t *edge)
{
    if (edge->on) {
        /* MAX_RATE_HZ edges in any second: the one that many before this one is a second old. */
        if (flashes >= MAX_RATE_HZ && edge->tick - rises[flashes % MAX_RATE_HZ] < TICK_HZ)
            fail("at most three flashes a second, across resets too");
        rises[flashes++ % MAX_RATE_HZ] = edge->tick;
        lit_since = edge->tick;
    } else if (edge->tick - lit_since > MAX_ON_TICKS) {
        fail("at most 250 ms on");
    }
}

static void check_sent(uint8_t byte)
{
    packet_t packet;
    switch (decoder_feed(&answers, byte, &packet)) {
    case FRAME_NONE:
        break;
    case FRAME_GOOD:
        sent_frames++;
        if (payload_bytes(packet.type) != packet.payload_bytes)
            fail("every frame sent has the length of its type");
        if (packet.type == PONG_TYPE)
            answered_pings++;
        break;
    case FRAME_OVERSIZED: /* the banner is longer than a frame, and noise to a host */
        break;
    default:
        fail("no frame sent is damaged");
    }
}

static void feed(const uint8_t *data, size_t length)
{
    fed_bytes += length;
    host_receive(data, length);
}

static void feed_message(uint8_t type, const uint8_t *payload, uint8_t length)
{
    uint8_t wire[MAX_WIRE_BYTES];
    seq = (uint16_t)(seq + 1 - (draw(8) == 0)); /* now and then the number of the command before */
    feed(wire, frame_encode(wire, type, seq, payload, length));
}

static void feed_command(void)
{
    uint8_t payload[MAX_PAYLOAD_BYTES] = {0};
    uint32_t named = draw(8) ? nonce : draw(UINT32_MAX);
    switch (draw(6)) {
    case 0: {
        set_t message;
        message.boot_nonce = named;
        message.level = draw(8) ? (uint16_t)FULL_LEVEL : (uint16_t)draw_value(FULL_LEVEL);
        message.ttl_ms = (uint16_t)draw_value(MAX_ON_MS);
        set_pack(&message, payload);
        feed_message(SET_TYPE, payload, SET_BYTES);
        break;
    }
    case 1:
    case 2: {
        train_t message;
        message.boot_nonce = named;
        message.t0_tick = draw(8) ? port_now() + draw(500000) : draw_value(port_now());
        message.period_us =
            draw(2) ? (uint32_t)(MIN_PERIOD_US + draw(300000)) : (uint32_t)draw_value(MIN_PERIOD_US);
        message.on_us = draw(2) ? 1 + draw(MAX_ON_MS * 1000) : (uint32_t)draw_value(MAX_ON_MS * 1000);
        message.count = (uint16_t)draw_value(10);
        message.level = draw(8) ? (uint16_t)FULL_LEVEL : (uint16_t)draw_value(FULL_LEVEL);
        train_pack(&message, payload);
        feed_message(TRAIN_TYPE, payload, TRAIN_BYTES);
        break;
    }
    case 3:
        feed_message(PING_TYPE, payload, PING_BYTES);
        break;
    case 4:
        feed_message(STOP_TYPE, payload, 0);
        break;
    default: {
        uint8_t i, length = (uint8_t)draw(MAX_PAYLOAD_BYTES + 1);
        for (i = 0; i < length; i++)
            payload[i] = (uint8_t)draw(256);
        feed_message((uint8_t)draw(12), payload, length);
        break;
    }
    }
}

static void feed_damaged_frame(void)
{
    size_t which = draw((uint32_t)corpus_frames), length = corpus[which].length;
    uint8_t bytes[sizeof corpus[0].bytes];
    memcpy(bytes, corpus[which].bytes, length);
    switch (draw(5)) {
    case 0:
        bytes[draw((uint32_t)length)] ^= (uint8_t)(1U << draw(8));
        break;
    case 1: /* torn */
        length = draw((uint32_t)length);
        break;
    case 2: /* a foreign byte */
        bytes[draw((uint32_t)length)] = (uint8_t)draw(256);
        break;
    case 3: /* begun in the middle */
        which = draw((uint32_t)length);
        memmove(bytes, bytes + which, length - which);
        length -= which;
        break;
    default:
        break;
    }
    feed(bytes, length);
}

static void feed_noise(void)
{
    uint8_t bytes[300];
    size_t i, length = draw(sizeof bytes);
    uint32_t zeros = 1 + draw(40);
    for (i = 0; i < length; i++)
        bytes[i] = (uint8_t)(draw(zeros) ? draw(256) : 0);
    feed(bytes, length);
}

static void take_step(void)
{
    switch (draw(12)) {
    case 0:
    case 1:
        feed_damaged_frame();
        break;
    case 2:
        feed_noise();
        break;
    case 3:
        host_advance(port_now() + draw(2000000));
        break;
    case 4:
    case 5:
        host_advance(port_now() + draw(50000));
        break;
    case 6:
        if (draw(4) == 0) {
            nonce = 1 + draw(UINT32_MAX - 1);
            host_reset(nonce, (uint8_t)(draw(2) ? STATE_IDLE : STATE_SAFE));
            resets++;
        } else {
            feed((const uint8_t *)"\0?\n", 3);
        }
        break;
    default:
        feed_command();
        break;
    }
}

static void end_session(void)
{
    static const uint8_t DELIMITER = 0;
    uint8_t payload[PING_BYTES] = {0};
    unsigned long long pings, before;
    uint32_t silence = HEARTBEAT_TICKS + TICK_HZ / 50;
    host_advance(port_now() + silence);
    if (host_is_lit())
        fail("dark after the heartbeat is lost");
    before = flashes;
    host_advance(port_now() + TICK_HZ);
    if (flashes != before)
        fail("no flash after the heartbeat is lost");
    feed(&DELIMITER, 1);
    pings = answered_pings;
    payload[0] = (uint8_t)draw(256);
    payload[1] = (uint8_t)draw(256);
    seq++;
    feed_message(PING_TYPE, payload, PING_BYTES);
    if (answered_pings != pings + 1)
        fail("one delimiter, and the next frame is heard");
}

static void read_corpus(void)
{
    char line[4 * MAX_WIRE_BYTES];
    while (corpus_frames < MAX_FRAMES && fgets(line, sizeof line, stdin)) {
        size_t length = 0;
        const char *text = line;
        unsigned value;
        while (length < sizeof corpus[0].bytes && sscanf(text, "%2x", &value) == 1) {
            corpus[corpus_frames].bytes[length++] = (uint8_t)value;
            text += 2;
        }
        if (length)
            corpus[corpus_frames++].length = length;
    }
}

int main(int argc, char **argv)
{
    unsigned long executions, i;
    int step;
    if (argc != 3) {
        fprintf(stderr, "usage: fuzz EXECUTIONS SEED < corpus\n");
        return 2;
    }
    executions = strtoul(argv[1], 0, 10);
    random_state = strtoull(argv[2], 0, 10) * 2 + 1;
    read_corpus();
    if (!corpus_frames) {
        fprintf(stderr, "no frames on standard input\n");
        return 2;
    }
    host_edge_hook = check_edge;
    host_sent_hook = check_sent;
    host_reset(nonce, STATE_IDLE);
    for (i = 0; i < executions; i++) {
        for (step = 0; step < STEPS; step++)
            take_step();
        end_session();
    }
    printf("executions %lu frames %lu bytes %llu answers %llu flashes %llu resets %llu\n", executions,
           (unsigned long)corpus_frames, fed_bytes, sent_frames, flashes, resets);
    return 0;
}
