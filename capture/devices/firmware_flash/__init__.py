"""The flash with the reference firmware, over whatever carries bytes both ways.

    transport.py      what a line is: write, read with a timeout, close
    link.py           commands and answers over it: numbers, repeats, heartbeat, resets, counters
    handshake.py      HELLO through boot noise, and who answered instead
    device_clock.py   round trips of PING and PONG -> device clock in host time
    train_ticks.py    a train in host time -> TRAIN in the device's ticks
    edges.py          EVENT -> edge in host time, numbered within its train
    flash.py          the FlashDevice made of them

Transports are a serial port (`capture.devices.serial_flash`) and HID (`capture.devices.hid.firmware`).
"""
