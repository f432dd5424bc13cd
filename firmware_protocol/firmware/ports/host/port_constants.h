/* The device as a program: a clock of 1 us that the program moves, a pin that is a variable. */
#ifndef PORT_CONSTANTS_H
#define PORT_CONSTANTS_H

#define TICK_HZ           1000000UL
#define PORT_NAME         "flash-c 1.0 host"
#define PORT_LEAD_TICKS   1000 /* 1 ms */
#define PORT_BYTE_TICKS   0
#define PORT_ANSWER_TICKS 0

#endif
