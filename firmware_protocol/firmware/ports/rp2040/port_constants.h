/* RP2040: Raspberry Pi Pico and its kin. */
#ifndef PORT_CONSTANTS_H
#define PORT_CONSTANTS_H

#define TICK_HZ   1000000UL
#define PORT_NAME "flash-c 1.0 rp2040"

#define PORT_LEAD_TICKS   1000 /* 1 ms */
#define PORT_BYTE_TICKS   0    /* USB packets: what waits leaves together */
#define PORT_ANSWER_TICKS 0

#endif
