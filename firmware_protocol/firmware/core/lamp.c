#include "lamp.h"

#include "limits.h"
#include "port.h"

/* How much longer than allowed the pin may be seen lit before the main loop turns it off itself: room for the
 * latency of the loop. Only a port whose edges have failed gets there. */
#define OVERDUE_TICKS (TICK_HZ / 200)

#define MILLION ((uint32_t)1000000)

static struct {
    uint8_t state;
    bool lit;
    bool armed; /* a flash of the train waits at the port or is lit */
    tick_t lit_tick;
    tick_t rises[MAX_RATE_HZ]; /* the last rising edges, oldest first */
    uint32_t pulses;
    /* the train: where the next flash begins, and how the period is made of whole ticks */
    tick_t next;
    uint32_t on_ticks;
    uint64_t period_ticks;
    uint32_t period_rest; /* of a tick, in millionths */
    uint32_t carry;
    uint16_t flashes_left;
} lamp;

static const refusal_t DONE = {ERROR_NONE, 0};

static refusal_t refuse(uint8_t code, uint32_t limit)
{
    refusal_t refused;
    refused.code = code;
    refused.limit = limit;
    return refused;
}

/* Whether a flash may begin at `rise` when `others` flashes lie between it and the last one that has begun:
 * each begins at least a second after the third before it. */
static bool rate_allows(tick_t rise, uint8_t others)
{
    return (int64_t)(rise - lamp.rises[others]) >= (int64_t)TICK_HZ;
}

/* Onto the next period. Flash k begins at t0 + ceil(k period): rounding up keeps every second within the
 * rate. */
static void next_period(void)
{
    lamp.next += lamp.period_ticks;
    lamp.carry += lamp.period_rest;
    if (lamp.carry >= MILLION) {
        lamp.carry -= MILLION;
        lamp.next++;
    }
}

static void flash_is_over(void)
{
    lamp.armed = false;
    lamp.flashes_left--;
    next_period();
    if (lamp.flashes_left == 0)
        lamp.state = STATE_IDLE;
}

static void take_edges(void)
{
    edge_t edge;
    uint8_t i;
    while (port_take_edge(&edge)) {
        lamp.lit = edge.on;
        if (edge.on) {
            for (i = 1; i < MAX_RATE_HZ; i++)
                lamp.rises[i - 1] = lamp.rises[i];
            lamp.rises[MAX_RATE_HZ - 1] = edge.tick;
            lamp.lit_tick = edge.tick;
            lamp.pulses++;
        } else if (lamp.state == STATE_SET) {
            lamp.state = STATE_IDLE;
        } else if (lamp.state == STATE_TRAIN && lamp.armed) {
            flash_is_over();
        }
        lamp_edge_happened(&edge, lamp.pulses);
    }
}

/* Dark at once, whatever was planned, and `state` from now on. */
static void darken(uint8_t state)
{
    port_dark();
    lamp.armed = false;
    lamp.flashes_left = 0;
    take_edges();
    lamp.state = state;
}

static void arm_next_flash(void)
{
    if (!reached(lamp.next, port_now()) || !rate_allows(lamp.next, 0)) {
        flash_is_over(); /* too late or too soon: this flash is left out, never moved */
        return;
    }
    lamp.armed = true;
    port_pulse(lamp.next, lamp.on_ticks);
}

void lamp_start(uint8_t state)
{
    edge_t forgotten;
    uint8_t i;
    tick_t now = port_now();
    port_dark();
    while (port_take_edge(&forgotten)) {
    }
    lamp.state = state;
    lamp.lit = false;
    lamp.armed = false;
    lamp.flashes_left = 0;
    lamp.pulses = 0;
    for (i = 0; i < MAX_RATE_HZ; i++)
        lamp.rises[i] = now;
}

void lamp_poll(void)
{
    take_edges();
    if (lamp.lit && reached(port_now(), lamp.lit_tick + MAX_ON_TICKS + OVERDUE_TICKS)) {
        take_edges(); /* the end may have come between the two */
        if (lamp.lit)
            darken(STATE_SAFE);
    }
    if (lamp.state == STATE_TRAIN && !lamp.armed)
        arm_next_flash();
}

refusal_t lamp_set(uint16_t level, uint16_t ttl_ms)
{
    uint32_t ttl = (uint32_t)((uint64_t)ttl_ms * TICK_HZ / 1000);
    if (level == 0 || ttl == 0) {
        darken(STATE_IDLE);
        return DONE;
    }
    if (level != FULL_LEVEL)
        return refuse(ERROR_UNSUPPORTED, FULL_LEVEL);
    take_edges();
    if (lamp.lit) {
        tick_t off = port_now() + ttl, latest = lamp.lit_tick + MAX_ON_TICKS;
        if (port_off_at(reached(latest, off) ? off : latest)) {
            lamp.armed = false;
            lamp.flashes_left = 0;
            lamp.state = STATE_SET;
            return DONE;
        }
        take_edges(); /* it went dark just now */
    }
    if (!rate_allows(port_now(), 0))
        return refuse(ERROR_RATE, MAX_RATE_HZ);
    darken(STATE_IDLE);
    if (!rate_allows(port_now(), 0)) /* a flash of the train that was dropped had just begun */
        return refuse(ERROR_RATE, MAX_RATE_HZ);
    port_pulse(port_now(), ttl);
    lamp.state = STATE_SET;
    return DONE;
}

refusal_t lamp_train(const train_t *train)
{
    uint64_t period = (uint64_t)train->period_us * TICK_HZ;
    uint64_t on_ticks = (uint64_t)train->on_us * TICK_HZ / MILLION;
    tick_t rise = train->t0_tick;
    uint8_t k;
    if (train->level != FULL_LEVEL)
        return refuse(ERROR_UNSUPPORTED, FULL_LEVEL);
    take_edges();
    if (!reached(rise, port_now() + PORT_LEAD_TICKS))
        return refuse(ERROR_LATE, 0);
    for (k = 0; k < MAX_RATE_HZ && k < train->count; k++) {
        if (!rate_allows(rise, k))
            return refuse(ERROR_RATE, MAX_RATE_HZ);
        rise += period / MILLION;
    }
    darken(STATE_IDLE);
    lamp.next = train->t0_tick;
    lamp.on_ticks = on_ticks ? (uint32_t)on_ticks : 1;
    lamp.period_ticks = period / MILLION;
    lamp.period_rest = (uint32_t)(period % MILLION);
    lamp.carry = MILLION - 1; /* so that the sum of the rests is rounded up */
    lamp.flashes_left = train->count;
    lamp.state = STATE_TRAIN;
    arm_next_flash();
    return DONE;
}

void lamp_stop(void)
{
    darken(lamp.state == STATE_SAFE ? STATE_SAFE : STATE_IDLE);
}

void lamp_make_safe(void)
{
    darken(STATE_SAFE);
}

bool lamp_is_active(void)
{
    return lamp.lit || lamp.state == STATE_SET || lamp.state == STATE_TRAIN;
}

uint8_t lamp_state(void)
{
    return lamp.state;
}

uint16_t lamp_level(void)
{
    return lamp.lit || lamp.state == STATE_SET ? FULL_LEVEL : 0;
}

uint32_t lamp_pulses(void)
{
    return lamp.pulses;
}
