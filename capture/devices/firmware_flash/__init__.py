"""The flash with the reference firmware, over whatever carries bytes both ways.

    transport.py   what a line is: write, read with a timeout, close
    link.py        commands and answers over it: numbers, repeats, resets, counters
    device_clock.py   round trips -> device clock in host time
    flash.py       the FlashDevice made of them

Transports are a serial port (`capture.devices.serial_flash`) and HID (`capture.devices.hid.firmware`).
"""
