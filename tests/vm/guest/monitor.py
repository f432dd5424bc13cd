"""The emulator's own monitor (QMP) through a port of the machine: the plug of the FTDI adapter."""

import json
from pathlib import Path

from kernel import load, until


class Monitor:
    """Commands to the emulator."""

    def __init__(self):
        load("virtio_console")
        self._port = until(_opened, "the monitor's port")
        self._rest = b""
        self._ask("qmp_capabilities", {})  # an error when it was asked before: the connection is always there

    def __call__(self, command, **arguments):
        """Does a command."""
        answer = self._ask(command, arguments)
        assert "return" in answer, answer

    def _ask(self, command, arguments):
        """The answer to a command; a greeting and events are passed over."""
        self._port.write(json.dumps({"execute": command, "arguments": arguments}).encode() + b"\n")
        while True:
            while b"\n" not in self._rest:
                self._rest += self._port.read(4096)
            line, self._rest = self._rest.split(b"\n", 1)
            message = json.loads(line)
            if "return" in message or "error" in message:
                return message

    def close(self):
        self._port.close()


def _opened():
    """The port, once there is somebody at its other end."""
    port = next(Path("/dev").glob("vport*p1"), None)
    try:
        return port and port.open("r+b", buffering=0)
    except OSError:
        return None
