"""The emulator's own monitor (QMP) through a port of the machine: the plug of the FTDI adapter."""

import json
from pathlib import Path

from kernel import load, until


class Monitor:
    """Commands to the emulator."""

    def __init__(self):
        load("virtio_console")
        port = until(lambda: next(Path("/dev").glob("vport*p1"), None), "the monitor's port")
        self._port = port.open("r+b", buffering=0)
        self._rest = b""
        self._answer("QMP")
        self("qmp_capabilities")

    def __call__(self, command, **arguments):
        """The answer to a command."""
        self._port.write(json.dumps({"execute": command, "arguments": arguments}).encode() + b"\n")
        return self._answer("return")

    def _answer(self, kind):
        """The next message of a kind; events in between are passed over."""
        while True:
            while b"\n" not in self._rest:
                self._rest += self._port.read(4096)
            line, self._rest = self._rest.split(b"\n", 1)
            message = json.loads(line)
            assert "error" not in message, message
            if kind in message:
                return message[kind]

    def close(self):
        self._port.close()
