"""The flash with the reference firmware, over whatever carries bytes both ways.

    transport.py   what a line is: write, read with a timeout, close
    link.py        commands and answers over it: numbers, repeats, resets, counters
    device_clock.py  round trips -> the device's clock in the host's
    flash.py       the FlashDevice made of them

A serial port (`capture.devices.serial_flash`) and HID reports (`capture.devices.hid.firmware`) are transports.
"""
