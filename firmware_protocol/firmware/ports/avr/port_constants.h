/* ATmega328P at 16 MHz: Arduino Uno, Nano, Pro Mini 5 V and their kin. */
#ifndef PORT_CONSTANTS_H
#define PORT_CONSTANTS_H

#if F_CPU != 16000000UL
#error "the timer and the line are laid out for a 16 MHz crystal or resonator"
#endif

/* Timer 1 at F_CPU / 64: 4 us a tick. No finer, so that its 16 bits (262 ms) span the longest pulse: from the
 * edge on, the edge off stands in the compare unit and needs no software to happen. */
#define TICK_HZ 250000UL

#define PORT_NAME "flash-c 1.0 atmega328p"

#define PORT_LEAD_TICKS   250 /* 1 ms */
#define PORT_BYTE_TICKS   21  /* ten bits at 117,647 baud */
#define PORT_ANSWER_TICKS 61  /* 245 us, as measured in simulation: a test holds it */

#endif
