"""Lamps on USB HID, and our own firmware over it.

    transport.py   reports out and in; finding and opening devices (PyPI `hidapi`)
    hidpp.py       Logitech's HID++ 2.0: features, replies, events
    litra.py       Logitech Litra Glow, Beam, Beam LX
    relay.py       relay boards "USBRelayN"
    blink1.py      blink(1), which goes dark by itself when the host dies
    guard.py       a process that puts a lamp out when the one that lights it dies
    firmware.py    frames of firmware_protocol in reports of 64 bytes

The bought lamps have no schedule of their own: `capture.devices.host_flash` switches them in time.
"""
