"""A HID device in Python, behind /dev/uhid: the kernel makes a hidraw node of it, as of one on a cable.

The messages are those of <linux/uhid.h>; their structures are packed and of this machine's byte order.
"""

import os
import select
import struct
import threading
import time

_PATH = "/dev/uhid"
_DESTROY, _OUTPUT, _GET_REPORT, _GET_REPORT_REPLY = 1, 6, 9, 10
_CREATE2, _INPUT2, _SET_REPORT, _SET_REPORT_REPLY = 11, 12, 13, 14
_EVENT_BYTES = 4 + 128 + 64 + 64 + 2 + 2 + 4 * 4 + 4096
_BUS_USB = 3
_EIO = 5
_TICK_S = 0.01


class UhidDevice:
    """A device on the bus until it is closed; what it does is a `HidModel` (hid_models.py of the tests)."""

    def __init__(self, model, descriptor, vendor, product, name, serial=""):
        self._model = model
        self._file = os.open(_PATH, os.O_RDWR)
        names = (name.encode(), b"usb-machine/input0", serial.encode())
        create = struct.pack(
            "<I128s64s64sHHIIII", _CREATE2, *names, len(descriptor), _BUS_USB, vendor, product, 0x0100, 0
        )
        os.write(self._file, create + descriptor.ljust(4096, b"\0"))
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self):
        """The device is pulled out."""
        if not self._ended.is_set():
            self._ended.set()
            self._thread.join()
            os.write(self._file, struct.pack("<I", _DESTROY))
            os.close(self._file)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def _serve(self):
        while not self._ended.is_set():
            if select.select([self._file], [], [], _TICK_S)[0]:
                self._take(os.read(self._file, _EVENT_BYTES))
            self._send(self._model.advance(time.monotonic()))

    def _take(self, event):
        kind = struct.unpack_from("<I", event)[0]
        if kind == _OUTPUT:
            size = struct.unpack_from("<H", event, 4 + 4096)[0]
            self._send(self._model.write(event[4 : 4 + size], time.monotonic()))
        elif kind == _SET_REPORT:
            number, _, _, size = struct.unpack_from("<IBBH", event, 4)
            error = self._safely(self._model.set_feature, event[12 : 12 + size])[1]
            os.write(self._file, struct.pack("<IIH", _SET_REPORT_REPLY, number, error))
        elif kind == _GET_REPORT:
            number, report, _ = struct.unpack_from("<IBB", event, 4)
            content, error = self._safely(self._model.get_feature, report)
            reply = struct.pack("<IIHH", _GET_REPORT_REPLY, number, error, len(content))
            os.write(self._file, reply + content)

    def _send(self, reports):
        for report in reports:
            os.write(self._file, struct.pack("<IH", _INPUT2, len(report)) + report)

    @staticmethod
    def _safely(function, argument):
        """(result, error number) of a request that the model may refuse."""
        try:
            return function(argument, time.monotonic()) or b"", 0
        except OSError:
            return b"", _EIO
