"""What the machine starts from: the kernel unpacked, and a small file system with its first drivers.

The kernel comes compressed; emulated, unpacking it would take longer than the rest of the start, and as an
ELF file with a PVH note QEMU starts it directly.
"""

import lzma
import stat
import subprocess
import zlib
from pathlib import Path

INIT = Path(__file__).parent / "init.sh"
#: To see the host's files and to lay writable ones over them; everything else is loaded from there.
_FIRST_MODULES = ("virtio_pci", "9pnet_virtio", "9p", "overlay")
_ELF = b"\x7fELF"
_COMPRESSIONS = (
    (b"\xfd7zXZ\x00", lambda data: lzma.LZMADecompressor().decompress(data)),
    (b"\x1f\x8b\x08", lambda data: zlib.decompressobj(31).decompress(data)),
)


def vmlinux(image, made):
    """The kernel out of its self-extracting image, kept in the file `made`.

    Raises:
        ValueError: It is compressed in a way that Python 3.11 cannot undo.
    """
    if not made.exists():
        made.write_bytes(_unpacked(image.read_bytes()))
    return made


def _unpacked(image):
    for magic, unpack in _COMPRESSIONS:
        at = image.find(magic)
        while at >= 0:
            try:
                kernel = unpack(image[at:])
            except (lzma.LZMAError, zlib.error):
                kernel = b""
            if kernel.startswith(_ELF):
                return kernel
            at = image.find(magic, at + 1)
    raise ValueError("no kernel compressed with xz or gzip in the image")


def initramfs(parts, made):
    """The archive that the kernel starts from, in the file `made`: busybox, init.sh, the first modules."""
    modules = Path(parts.modules)
    files = {"init": INIT.read_bytes(), "bin/busybox": Path(parts.busybox).read_bytes()}
    for module in with_dependencies(modules, _FIRST_MODULES):
        files[f"lib/modules/{modules.name}/{module}"] = (modules / module).read_bytes()
    files[f"lib/modules/{modules.name}/modules.dep"] = (modules / "modules.dep").read_bytes()
    made.write_bytes(_cpio(files))
    return made


def index_modules(modules, busybox):
    """Writes the list of what needs what into a folder of modules."""
    subprocess.run([busybox, "depmod", "-b", modules.parents[2], modules.name], check=True)


def with_dependencies(modules, names):
    """Paths of modules within their folder, with those that they need."""
    needs = {}
    for line in (modules / "modules.dep").read_text().splitlines():
        module, _, others = line.partition(":")
        needs[module] = others.split()
    found = {}
    for module, others in needs.items():
        if Path(module).name.split(".")[0] in names:
            found |= dict.fromkeys([module, *others])
    return list(found)


def _cpio(files):
    """An archive of programs and their folders in cpio's "newc" form (kernel: driver-api/early-userspace)."""
    folders = {str(parent) for name in files for parent in Path(name).parents if str(parent) != "."}
    archive = b""
    for name in sorted(folders):
        archive += _cpio_entry(name, stat.S_IFDIR | 0o755, b"")
    for name, content in files.items():
        archive += _cpio_entry(name, stat.S_IFREG | 0o755, content)
    return archive + _cpio_entry("TRAILER!!!", 0, b"")


def _cpio_entry(name, mode, content):
    path = name.encode() + b"\0"
    # inode, mode, uid, gid, links, time, size, devices (2 and 2), length of the name, checksum
    fields = (0, mode, 0, 0, 1, 0, len(content), 0, 0, 0, 0, len(path), 0)
    entry = b"070701" + b"".join(b"%08X" % field for field in fields) + path
    entry += b"\0" * (-len(entry) % 4)
    return entry + content + b"\0" * (-len(content) % 4)
