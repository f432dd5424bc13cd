"""What the machine is made of, fetched by apt into a folder of our own; no root, nothing installed.

Debian's packages, and one from PyPI that makes USB devices in Python. apt keeps its lists and its cache in
the same folder, so that those of the system are neither needed nor touched; it looks into the system's list
of installed packages only to leave out what is there.
"""

import json
import os
import platform
import re
import shutil
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

from image import index_modules, with_dependencies

QEMU, QEMU_PACKAGE = "qemu-system-x86_64", "qemu-system-x86"
#: For the camera back end that speaks USB itself; the machine uses the host's, or this one.
LIBUSB = "libusb-1.0-0"
#: Names the newest kernel of the distribution; its own name has the version in it.
KERNEL_META_PACKAGE = "linux-image-amd64"
#: What the tests meet and what the machine itself runs on; a kernel without them is of no use.
DRIVERS = ("vivid", "uvcvideo", "vhci-hcd", "uhid", "hid-generic", "cdc-acm", "ftdi_sio", "xhci-pci")
MODULES = (*DRIVERS, "virtio_pci", "virtio_console", "9p", "9pnet_virtio", "overlay")
REQUIREMENTS = Path(__file__).parent / "requirements.txt"


class UnavailableError(Exception):
    """The machine cannot be had here; the message says what is missing. The tests are skipped."""


@dataclass(frozen=True)
class Parts:
    """Where everything lies.

    Attributes:
        qemu: The program.
        libraries: Folders of shared libraries that are not installed; none when all are.
        firmware: Folders with its start-up code; none when it is installed.
        busybox: A static one, for the start.
        kernel: Compressed image.
        modules: Folder of that kernel's modules; its name is the kernel's version.
        python: Folder for PYTHONPATH.
    """

    qemu: str
    libraries: tuple[str, ...]
    firmware: tuple[str, ...]
    busybox: str
    kernel: str
    modules: str
    python: str


def fetch(cache):
    """The parts, from the folder `cache` or, the first time, from apt and pip.

    Raises:
        UnavailableError: This is no Debian on x86-64, or its package servers cannot be reached.
    """
    cache.mkdir(parents=True, exist_ok=True)
    record = cache / "parts.json"
    if record.exists():
        parts = Parts(**json.loads(record.read_text()))
        if all(Path(path).exists() for path in (parts.qemu, parts.busybox, parts.kernel, parts.python)):
            return parts
    if platform.machine() != "x86_64":
        raise UnavailableError(f"the machine is a PC; this is {platform.machine()}")
    for tool in ("apt-get", "dpkg-deb"):
        if shutil.which(tool) is None:
            raise UnavailableError(f"{tool} is missing; Debian's kernel comes from there")
    apt = _Apt(cache)
    root = cache / "root"
    apt.unpack(["busybox-static", apt.dependency(KERNEL_META_PACKAGE, r"linux-image-.*-amd64")], root)
    qemu, libraries, firmware = shutil.which(QEMU), (), ()
    if missing := apt.missing(LIBUSB, *() if qemu else (QEMU_PACKAGE,)):
        apt.unpack(missing, root)
        libraries = [root / "usr/lib/x86_64-linux-gnu", root / "lib/x86_64-linux-gnu"]
    if qemu is None:
        qemu = root / "usr/bin" / QEMU
        firmware = [root / "usr/share/seabios", root / "usr/share/qemu"]
    busybox = next(path for path in (root / "bin/busybox", root / "usr/bin/busybox") if path.exists())
    parts = Parts(
        qemu=str(qemu),
        libraries=tuple(map(str, libraries)),
        firmware=tuple(map(str, firmware)),
        busybox=str(busybox),
        kernel=str(_only(root.glob("boot/vmlinuz-*"))),
        modules=str(_modules(root, busybox)),
        python=str(_usbip(cache / "python")),
    )
    record.write_text(json.dumps(asdict(parts), indent=1))
    return parts


class _Apt:
    """apt with its state in a folder of ours."""

    def __init__(self, cache):
        state = cache / "apt"
        for folder in ("lists/partial", "archives/partial"):
            (state / folder).mkdir(parents=True, exist_ok=True)
        self._archives = state / "archives"
        self._options = [
            f"-oDir::State::lists={state}/lists",
            f"-oDir::State::extended_states={state}/extended_states",
            "-oDir::State::status=/var/lib/dpkg/status",
            f"-oDir::Cache={state}",
            "-oAPT::Sandbox::User=",  # the folder may lie where apt's own user cannot write
            "-oAcquire::Retries=2",
            "-oAcquire::http::Timeout=20",
        ]
        self._run("apt-get", "update", "-qq")

    def _run(self, program, *arguments):
        made = subprocess.run(
            [program, *self._options, *arguments],
            cwd=self._archives,
            env=os.environ | {"LC_ALL": "C"},
            capture_output=True,
            text=True,
            check=False,
        )
        if made.returncode:
            reason = (made.stderr.strip() or made.stdout.strip()).splitlines()
            raise UnavailableError(
                f"{program} {arguments[0]} failed: {reason[-1].rstrip('.') if reason else 'no reason given'}"
            )
        return made.stdout

    def dependency(self, package, pattern):
        """The one package that another depends on."""
        found = re.findall(
            rf"^\s*Depends: ({pattern})$", self._run("apt-cache", "depends", package), re.MULTILINE
        )
        if not found:
            raise UnavailableError(
                f"apt knows no {package}; this is no Debian, or its servers cannot be reached"
            )
        return found[0]

    def missing(self, *packages):
        """The packages and what they need, as far as they are not installed."""
        plan = self._run("apt-get", "--simulate", "--no-install-recommends", "install", *packages)
        return re.findall(r"^Inst (\S+) ", plan, re.MULTILINE)

    def unpack(self, packages, root):
        """Downloads packages and unpacks them, without running anything in them."""
        for old in self._archives.glob("*.deb"):
            old.unlink()
        self._run("apt-get", "download", *packages)
        for archive in sorted(self._archives.glob("*.deb")):
            subprocess.run(["dpkg-deb", "--extract", archive, root], check=True)
            archive.unlink()


def _only(paths):
    found = sorted(paths)
    if not found:
        raise UnavailableError("the kernel's package has no kernel in it")
    return found[-1]


def _modules(root, busybox):
    """The modules' folder, without the 300 MB of those that nobody needs here."""
    folder = _only([*root.glob("lib/modules/*"), *root.glob("usr/lib/modules/*")])
    names = {path.name.split(".")[0] for path in folder.rglob("*.ko*")}
    missing = [name for name in MODULES if name not in names]
    if missing:
        raise UnavailableError(f"the kernel {folder.name} has no {', '.join(missing)}")
    index_modules(folder, busybox)
    kept = {folder / path for path in with_dependencies(folder, MODULES)}
    for path in folder.rglob("*.ko*"):
        if path not in kept:
            path.unlink()
    index_modules(folder, busybox)
    return folder


def _usbip(folder):
    """The USB devices in Python, pinned by its hash, in a folder of its own."""
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--upgrade"]
    made = subprocess.run(
        [*pip, "--no-deps", "--require-hashes", "--target", folder, "--requirement", REQUIREMENTS],
        capture_output=True,
        text=True,
        check=False,
    )
    if made.returncode:
        raise UnavailableError(
            f"pip cannot fetch {REQUIREMENTS.name}: {made.stderr.strip().splitlines()[-1:]}"
        )
    return folder
