"""A camera's controls as another program has them: by their names, past the back end that is tested."""

import ctypes
import fcntl
import os
from contextlib import contextmanager

from capture.devices.v4l2 import structs


class Controls:
    """The controls of an open node."""

    def __init__(self, node):
        self._node = node
        self._ids = {}
        query = structs.QueryExtControl()
        while True:
            query.id |= structs.CTRL_FLAG_NEXT_CTRL
            try:
                fcntl.ioctl(node, structs.QUERY_EXT_CTRL, query)
            except OSError:
                break
            self._ids[query.name.decode()] = query.id

    @property
    def names(self):
        return set(self._ids)

    def set(self, name, value):
        self._call(structs.S_EXT_CTRLS, name, value)

    def press(self, name):
        self._call(structs.S_EXT_CTRLS, name, 1)

    def get(self, name):
        return self._call(structs.G_EXT_CTRLS, name, 0)

    def _call(self, request, name, value):
        assert name in self._ids, f"no control {name}; there are {sorted(self._ids)}"
        control = structs.ExtControl(id=self._ids[name])
        control.value = value
        block = structs.ExtControls(which=self._ids[name] & 0x0FFF0000, count=1)
        block.controls = ctypes.pointer(control)
        fcntl.ioctl(self._node, request, block)
        return control.value


@contextmanager
def another_program(path):
    """The controls of a node in the hands of somebody else."""
    node = os.open(path, os.O_RDWR)
    try:
        yield Controls(node)
    finally:
        os.close(node)
