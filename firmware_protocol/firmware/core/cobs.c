#include "cobs.h"

#define FULL_BLOCK 0xFFU /* Code of a block of 254 bytes after which no zero is implied. */

size_t cobs_stuff(const uint8_t *data, size_t length, uint8_t *out)
{
    size_t code_at = 0, used = 1, i;
    uint8_t code = 1;
    for (i = 0; i < length; i++) {
        if (data[i]) {
            out[used++] = data[i];
            code++;
        }
        if (!data[i] || code == FULL_BLOCK) {
            out[code_at] = code;
            code = 1;
            if (data[i] && i + 1 == length)
                return used; /* a full block at the very end opens no other */
            code_at = used++;
        }
    }
    out[code_at] = code;
    return used;
}

size_t cobs_unstuff(const uint8_t *stuffed, size_t length, uint8_t *out)
{
    size_t at = 0, used = 0;
    while (at < length) {
        uint8_t code = stuffed[at];
        size_t end = at + code;
        if (code == 0 || end > length)
            return COBS_BAD;
        for (at++; at < end; at++) {
            if (stuffed[at] == 0)
                return COBS_BAD;
            out[used++] = stuffed[at];
        }
        if (code != FULL_BLOCK && at < length)
            out[used++] = 0;
    }
    return used;
}
