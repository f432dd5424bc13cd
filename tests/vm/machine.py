"""One run of the machine: started, watched, and stopped when its time is over.

It is emulated (TCG): slow, but it needs nothing of the host beyond a process. What it sees of the host are
the files, read-only; what it can write is the folder `share`.
"""

import os
import shlex
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

from image import initramfs, vmlinux

#: Enough for the layer in memory, numpy and OpenCV.
MEMORY_MB = 1536
#: Every x86-64 wheel of NumPy 2 runs on this (x86-64-v2), and the emulator has least to do.
PROCESSOR = "Nehalem"
_POLL_S = 0.1
_CONSOLE_LINES = 40


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    Attributes:
        over: The machine has shut down by itself, after the command.
        seconds: How long it ran.
        trouble: Why it is not `over`, with the last lines of the console; empty when it is.
    """

    over: bool
    seconds: float
    trouble: str = ""


class Machine:
    """A machine made of `parts`, with its files in `folder`."""

    def __init__(self, parts, folder):
        self.parts = parts
        self.share = folder / "share"
        self.share.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._console = folder / "console.log"
        self._vmlinux = vmlinux(Path(parts.kernel), folder / "vmlinux")
        self._initramfs = initramfs(parts, folder / "initramfs")

    def run(self, command, environment, limit_s, terminal=None, watch=lambda: None):
        """Runs a command in the machine.

        Args:
            command: Program with its arguments, as on the host.
            environment: Variables for it.
            limit_s: Longest time; then the machine is stopped.
            terminal: Pseudo-terminal of the host that is a USB serial port of the machine.
            watch: Called a few times a second.
        """
        self._write_command(command, environment)
        start_s = time.monotonic()
        with (self._folder / "qemu.log").open("w") as log:
            qemu = subprocess.Popen(
                self._arguments(terminal),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=self._environment(),
            )
            try:
                while qemu.poll() is None and time.monotonic() < start_s + limit_s:
                    time.sleep(_POLL_S)
                    watch()
                running = qemu.poll() is None
            finally:
                qemu.kill()
                qemu.wait()
        watch()
        seconds = time.monotonic() - start_s
        if running:
            return Outcome(False, seconds, f"stopped after {limit_s:.0f} s\n{self._tail()}")
        if "machine: over" not in self._text(self._console):
            return Outcome(False, seconds, f"it ended early\n{self._tail()}")
        return Outcome(True, seconds)

    def _write_command(self, command, environment):
        version = Path(self.parts.modules).name
        # No LD_LIBRARY_PATH in the machine: ctypes looks for libraries in ldconfig's list alone.
        found = [
            f"echo {shlex.quote(folder)} >> /etc/ld.so.conf.d/machine.conf" for folder in self.parts.libraries
        ]
        lines = [f"export {name}={shlex.quote(value)}" for name, value in environment.items()]
        lines += [
            "mkdir -p /lib/modules",
            f"ln -sfn {shlex.quote(self.parts.modules)} /lib/modules/{version}",
            *(found and [*found, "ldconfig"]),
            f"cd {shlex.quote(os.getcwd())}",
            "exec " + shlex.join(map(str, command)) + " > /run/machine/share/output.log 2>&1",
        ]
        (self.share / "command").write_text("\n".join(lines) + "\n")

    def _arguments(self, terminal):
        monitor = f"path={self._folder.resolve() / 'monitor'}"
        arguments = [self.parts.qemu, "-nodefaults", "-no-user-config", "-display", "none", "-no-reboot"]
        arguments += ["-M", "pc,accel=tcg", "-cpu", PROCESSOR, "-smp", "2", "-m", str(MEMORY_MB)]
        for folder in self.parts.firmware:
            arguments += ["-L", folder]
        arguments += ["-kernel", self._vmlinux, "-initrd", self._initramfs]
        arguments += ["-append", "console=ttyS0 loglevel=4 panic=-1 mitigations=off random.trust_cpu=on"]
        arguments += ["-serial", f"file:{self._console}", "-device", "virtio-rng-pci"]
        arguments += [
            "-virtfs",
            "local,path=/,mount_tag=host,security_model=none,readonly=on,multidevs=remap",
        ]
        arguments += [
            "-virtfs",
            f"local,path={self.share},mount_tag=share,security_model=none,multidevs=remap",
        ]
        # Its own monitor, as a port of the machine: there a test pulls the plug of an emulated device.
        arguments += ["-chardev", f"socket,id=monitor,server=on,wait=off,{monitor}"]
        arguments += ["-mon", "chardev=monitor,mode=control", "-chardev", f"socket,id=port,{monitor}"]
        arguments += ["-device", "virtio-serial", "-device", "virtserialport,chardev=port,name=monitor"]
        if terminal is not None:
            arguments += ["-chardev", f"serial,id=line,path={terminal}", "-device", "qemu-xhci"]
            arguments += ["-device", "usb-serial,chardev=line,id=flash"]
        return arguments

    def _environment(self):
        found = [*self.parts.libraries, *filter(None, [os.environ.get("LD_LIBRARY_PATH")])]
        return os.environ | ({"LD_LIBRARY_PATH": ":".join(found)} if found else {})

    def _tail(self):
        """The last lines that the machine and its tests have said."""
        places = (self._console, self.share / "output.log", self._folder / "qemu.log")
        return "\n".join(
            f"--- {place.name}\n" + "\n".join(self._text(place).splitlines()[-_CONSOLE_LINES:])
            for place in places
        )

    @staticmethod
    def _text(path):
        return path.read_text(errors="replace") if path.exists() else ""
