"""Soft foreground masks of a session's frames, and the points of its cloud that they agree on."""

from relight.masks.config import MaskConfig as MaskConfig
from relight.masks.config import MaskResult as MaskResult
from relight.masks.find import find_masks as find_masks
