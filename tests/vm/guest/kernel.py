"""The machine's kernel: its modules, and waiting for what it makes."""

import subprocess
import time
from contextlib import contextmanager

_BUSYBOX = "/run/machine/busybox"
#: Emulated and on a busy host, a driver may need seconds for what takes milliseconds on a computer.
PATIENCE_S = 20.0


def load(module, **parameters):
    """Loads a driver and what it needs."""
    options = [f"{name}={value}" for name, value in parameters.items()]
    subprocess.run([_BUSYBOX, "modprobe", module, *options], check=True)


def unload(module):
    """Unloads a driver."""
    subprocess.run([_BUSYBOX, "rmmod", module], check=True)


@contextmanager
def loaded(module, **parameters):
    """A driver for as long as it is needed."""
    load(module, **parameters)
    try:
        yield
    finally:
        unload(module)


def until(found, what, patience_s=PATIENCE_S):
    """The first value of `found()` that is true.

    Raises:
        AssertionError: None was in time.
    """
    end_s = time.monotonic() + patience_s
    while True:
        if value := found():
            return value
        assert time.monotonic() < end_s, f"{what}: not within {patience_s} s"
        time.sleep(0.02)
