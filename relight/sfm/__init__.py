"""Poses from a session's frames alone: structure from motion on pictures that the flash leaves alike."""

import numpy  # noqa: F401  before pycolmap, whose own zlib breaks the writing of PNG when it is first

from relight.sfm.config import PoseResult, SfmConfig
from relight.sfm.find import find_poses

__all__ = ["PoseResult", "SfmConfig", "find_poses"]
