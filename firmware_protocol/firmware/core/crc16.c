#include "crc16.h"

uint16_t crc16_mcrf4xx(uint16_t crc, const uint8_t *data, size_t length)
{
    /* A byte at a time without a table: the eight steps of the polynomial x^16 + x^12 + x^5 + 1 folded into
     * shifts by 4 and 3. A table of 512 bytes would be a quarter of a small part's RAM. */
    while (length--) {
        uint8_t low = (uint8_t)(crc ^ *data++);
        low = (uint8_t)(low ^ (low << 4));
        crc = (uint16_t)((crc >> 8) ^ ((uint16_t)low << 8) ^ ((uint16_t)low << 3) ^ (low >> 4));
    }
    return crc;
}
