#include "port_host.h"

#include "device.h"
#include "limits.h"
#include "port.h"
#include "queues.h"

#define BEAT_TICKS (TICK_HZ / 100)
#define EDGES      8

void (*host_edge_hook)(const edge_t *edge);
void (*host_sent_hook)(uint8_t byte);

static struct {
    tick_t now;
    bool waiting, lit, timer_broken;
    tick_t on_tick, off_tick;
    uint32_t on_ticks;
    edge_t edges[EDGES];
    uint8_t first_edge, edge_count;
} host;

static void make_edge(bool on)
{
    edge_t edge;
    edge.tick = host.now;
    edge.on = on;
    host.lit = on;
    if (host.edge_count < EDGES)
        host.edges[(host.first_edge + host.edge_count++) % EDGES] = edge;
    if (host_edge_hook)
        host_edge_hook(&edge);
}

static void make_due_edges(void)
{
    if (host.waiting && reached(host.now, host.on_tick)) {
        host.waiting = false;
        host.off_tick = host.now + host.on_ticks;
        make_edge(true);
    }
    if (host.lit && !host.timer_broken && reached(host.now, host.off_tick))
        make_edge(false);
}

static void poll_device(void)
{
    uint8_t byte;
    bool more;
    do {
        make_due_edges();
        more = device_poll();
        while (outbox_get(&byte))
            if (host_sent_hook)
                host_sent_hook(byte);
    } while (more);
}

void host_set_clock(tick_t now)
{
    host.now = now;
}

void host_reset(uint32_t boot_nonce, uint8_t state)
{
    port_dark();
    host.edge_count = 0;
    host.timer_broken = false;
    device_start(boot_nonce, state);
    poll_device();
}

tick_t host_next_edge(tick_t otherwise)
{
    tick_t next = otherwise;
    if (host.waiting && reached(next, host.on_tick))
        next = host.on_tick;
    if (host.lit && !host.timer_broken && reached(next, host.off_tick))
        next = host.off_tick;
    return next;
}

void host_advance(tick_t until)
{
    while (host.now != until) {
        tick_t beat = host.now + BEAT_TICKS;
        tick_t next = host_next_edge(reached(until, beat) ? beat : until);
        host.now = reached(host.now, next) ? host.now : next;
        poll_device();
    }
}

void host_receive(const uint8_t *data, size_t length)
{
    while (length--) {
        inbox_put(*data, *data ? 0 : (uint32_t)host.now);
        if (!*data++)
            poll_device();
    }
    poll_device();
}

bool host_is_lit(void)
{
    return host.lit;
}

void host_break_timer(void)
{
    host.timer_broken = true;
}

tick_t port_now(void)
{
    return host.now;
}

void port_pulse(tick_t on_tick, uint32_t on_ticks)
{
    host.on_tick = reached(host.now, on_tick) ? host.now : on_tick;
    host.on_ticks = on_ticks < MAX_ON_TICKS ? on_ticks : MAX_ON_TICKS;
    host.waiting = true;
}

bool port_off_at(tick_t off_tick)
{
    if (host.lit)
        host.off_tick = off_tick;
    return host.lit;
}

void port_dark(void)
{
    host.waiting = false;
    if (host.lit)
        make_edge(false);
}

bool port_take_edge(edge_t *edge)
{
    if (!host.edge_count)
        return false;
    *edge = host.edges[host.first_edge];
    host.first_edge = (uint8_t)((host.first_edge + 1) % EDGES);
    host.edge_count--;
    return true;
}

void port_send(void)
{
    /* poll_device empties the outbox after every round */
}
