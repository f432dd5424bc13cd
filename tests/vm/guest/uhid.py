"""A HID device in Python, behind /dev/uhid: the kernel makes a hidraw node of it, as of one on a cable.

The messages are those of <linux/uhid.h>; their structures are packed and of this machine's byte order.
"""

import os
import select
import struct
import threading

_PATH = "/dev/uhid"
_DESTROY, _OUTPUT, _GET_REPORT, _GET_REPORT_REPLY = 1, 6, 9, 10
_CREATE2, _INPUT2, _SET_REPORT, _SET_REPORT_REPLY = 11, 12, 13, 14
_EVENT_BYTES = 4 + 128 + 64 + 64 + 2 + 2 + 4 * 4 + 4096
_BUS_USB = 3
_EIO = 5


class UhidDevice:
    """A device on the bus until it is closed.

    The model has `output(report)`, `set_feature(report)` and `get_feature(number) -> bytes`: reports with
    their number first, 0 where there is none.
    """

    def __init__(self, model, descriptor, vendor, product, name, serial=""):
        self._model = model
        self._file = os.open(_PATH, os.O_RDWR)
        fields = (
            name.encode(),
            b"usb-machine/input0",
            serial.encode(),
            len(descriptor),
            _BUS_USB,
            vendor,
            product,
        )
        create = struct.pack("<I128s64s64sHHIIII", _CREATE2, *fields, 0x0100, 0)
        os.write(self._file, create + descriptor.ljust(4096, b"\0"))
        self._closing, self._closed = os.pipe()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def send(self, report):
        """An input report."""
        os.write(self._file, struct.pack("<IH", _INPUT2, len(report)) + bytes(report))

    def close(self):
        """The device is pulled out."""
        if self._file is not None:
            os.write(self._closed, b"x")
            self._thread.join()
            os.write(self._file, struct.pack("<I", _DESTROY))
            for file in (self._file, self._closing, self._closed):
                os.close(file)
            self._file = None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def _serve(self):
        while self._closing not in select.select([self._file, self._closing], [], [])[0]:
            event = os.read(self._file, _EVENT_BYTES)
            kind = struct.unpack_from("<I", event)[0]
            if kind == _OUTPUT:
                size = struct.unpack_from("<H", event, 4 + 4096)[0]
                self._model.output(event[4 : 4 + size])
            elif kind == _SET_REPORT:
                number, _, _, size = struct.unpack_from("<IBBH", event, 4)
                self._model.set_feature(event[12 : 12 + size])
                os.write(self._file, struct.pack("<IIH", _SET_REPORT_REPLY, number, 0))
            elif kind == _GET_REPORT:
                number, report, _ = struct.unpack_from("<IBB", event, 4)
                content = self._model.get_feature(report)
                reply = struct.pack("<IIHH", _GET_REPORT_REPLY, number, 0 if content else _EIO, len(content))
                os.write(self._file, reply + content)
