"""Cameras and flashes: two interfaces, and a back end behind a URL for each kind of device.

    camera.py   what a camera is: lock, read, check, restore
    flash.py    what a flash is: start a pulse train, poll its edges, off
    bench.py    what a camera and a flash on one desk share: the clock, and for simulated ones the light
    table.py    URL -> back end, imported only when it is asked for

The simulated back ends (`capture.sim`, the fake V4L2 driver) are ordinary entries of the table.
"""
