"""vivid: the kernel's own test camera, with real video buffers and faults to order."""

from pathlib import Path

from kernel import load, until


def test_there_is_a_camera():
    load("vivid", n_devs=1, node_types="0x1", input_types="0x0")
    until(Path("/dev/video0").exists, "/dev/video0")
