/* Times on the device's clock, and how to compare them. */
#ifndef TICKS_H
#define TICKS_H

#include <stdbool.h>
#include <stdint.h>

/* Ticks since start, TICK_HZ a second. Arithmetic wraps; only differences below 2^63 mean anything. */
typedef uint64_t tick_t;

/* Whether `when` is not after `now`: right across a wrap, where `when <= now` is not. */
static inline bool reached(tick_t now, tick_t when)
{
    return (int64_t)(now - when) >= 0;
}

/* One change of the lamp pin and when it happened. */
typedef struct {
    tick_t tick;
    bool on;
} edge_t;

#endif
