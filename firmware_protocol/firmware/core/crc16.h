/* CRC-16/MCRF4XX: reflected polynomial 0x8408, initial value 0xFFFF, nothing xored at the end. */
#ifndef CRC16_H
#define CRC16_H

#include <stddef.h>
#include <stdint.h>

#define CRC16_INITIAL 0xFFFFU

/* Checksum of `data`; pass a result back as `crc` to go on. 0 over a message followed by its checksum. */
uint16_t crc16_mcrf4xx(uint16_t crc, const uint8_t *data, size_t length);

#endif
