"""The flash with the reference firmware on a serial port."""
