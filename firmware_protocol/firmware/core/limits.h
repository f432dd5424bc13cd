/* What the wire carries and what the light may do: the names and values of limits.py, which a test compares.
 *
 * Nothing here can be set from outside. A build that needs a longer pulse or a higher rate is another device.
 */
#ifndef LIMITS_H
#define LIMITS_H

#include "port_constants.h" /* of the port that is built: TICK_HZ, PORT_NAME, PORT_LEAD_TICKS, ... */

#define WIRE_VERSION   1
#define PROTOCOL_MAJOR 1
#define PROTOCOL_MINOR 0
#define SCHEMA_CRC     0xba3eU

#define MAX_WIRE_BYTES    64
#define HEADER_BYTES      4
#define CRC_BYTES         2
#define MAX_BODY_BYTES    (MAX_WIRE_BYTES - 2)
#define MAX_PAYLOAD_BYTES (MAX_BODY_BYTES - HEADER_BYTES - CRC_BYTES)

#define MAX_ON_MS            250
#define MAX_RATE_HZ          3
#define MIN_PERIOD_US        ((1000000UL + MAX_RATE_HZ - 1) / MAX_RATE_HZ)
#define HEARTBEAT_TIMEOUT_MS 1500
#define FULL_LEVEL           0xFFFFU

/* The same in ticks of this port's clock. */
#define MAX_ON_TICKS    ((uint32_t)((uint64_t)TICK_HZ * MAX_ON_MS / 1000))
#define HEARTBEAT_TICKS ((uint32_t)((uint64_t)TICK_HZ * HEARTBEAT_TIMEOUT_MS / 1000))

#endif
