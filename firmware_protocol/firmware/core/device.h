/* The device: bytes from the line become commands, each is obeyed or refused once and answered. */
#ifndef DEVICE_H
#define DEVICE_H

#include <stdbool.h>
#include <stdint.h>

/* Begins after a reset of any kind. `boot_nonce` is not 0 and differs from that of the last start; `state` is
 * STATE_IDLE, or STATE_SAFE when a watchdog made the reset. The lamp pin is already off. */
void device_start(uint32_t boot_nonce, uint8_t state);

/* One round of the main loop: edges, at most one frame from the line, heartbeat, report. To be called at
 * least each 20 ms. Returns whether there is more to do at once. */
bool device_poll(void);

#endif
