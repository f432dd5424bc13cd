#include "queues.h"

#define STAMP_BYTES 4

typedef struct {
    volatile uint8_t bytes[256];
    volatile uint8_t head; /* where the next byte goes; moved by the writer only */
    volatile uint8_t tail; /* the oldest byte; moved by the reader only */
} queue_t;

static queue_t inbox, outbox;
static bool delimiter_was_last;

static uint8_t room(const queue_t *queue)
{
    return (uint8_t)(queue->tail - queue->head - 1);
}

void queues_start(void)
{
    inbox.head = inbox.tail = 0;
    outbox.head = outbox.tail = 0;
    delimiter_was_last = true;
}

void inbox_put(uint8_t byte, uint32_t tick)
{
    uint8_t head = inbox.head, i;
    if (byte) {
        if (room(&inbox) < 1 + 1 + STAMP_BYTES)
            return; /* always leave room for the delimiter that ends what is there */
        inbox.bytes[head++] = byte;
    } else {
        if (delimiter_was_last || room(&inbox) < 1 + STAMP_BYTES)
            return;
        inbox.bytes[head++] = 0;
        for (i = 0; i < STAMP_BYTES; i++) {
            inbox.bytes[head++] = (uint8_t)tick;
            tick >>= 8;
        }
    }
    delimiter_was_last = !byte;
    inbox.head = head;
}

bool inbox_get(uint8_t *byte, uint32_t *tick)
{
    uint8_t tail = inbox.tail, i;
    if (tail == inbox.head)
        return false;
    *byte = inbox.bytes[tail++];
    if (!*byte) {
        *tick = 0;
        for (i = 0; i < STAMP_BYTES; i++)
            *tick |= (uint32_t)inbox.bytes[tail++] << (8 * i);
    }
    inbox.tail = tail;
    return true;
}

bool inbox_is_empty(void)
{
    return inbox.tail == inbox.head;
}

bool outbox_put(const uint8_t *data, uint8_t length)
{
    uint8_t head = outbox.head;
    if (room(&outbox) < length)
        return false;
    while (length--)
        outbox.bytes[head++] = *data++;
    outbox.head = head;
    return true;
}

bool outbox_get(uint8_t *byte)
{
    uint8_t tail = outbox.tail;
    if (tail == outbox.head)
        return false;
    *byte = outbox.bytes[tail++];
    outbox.tail = tail;
    return true;
}

uint8_t outbox_room(void)
{
    return room(&outbox);
}

uint8_t outbox_used(void)
{
    return (uint8_t)(outbox.head - outbox.tail);
}
