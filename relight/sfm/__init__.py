"""Poses from a session's frames alone: structure from motion on pictures that the flash leaves alike."""

import signal
import threading

import numpy  # noqa: F401  before pycolmap, whose own zlib breaks the writing of PNG when it is first

from relight.sfm.config import PoseResult, SfmConfig
from relight.sfm.find import find_poses

if threading.current_thread() is threading.main_thread():
    # Once imported, pycolmap's logging answers SIGTERM with a stack trace; it is ours to end a process by.
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)

__all__ = ["PoseResult", "SfmConfig", "find_poses"]
