"""Errors of calibrating, under `capture.errors.CalibrationError`.

CalibrationError
├── BoardError       a board cannot be made, printed, or read from its description
├── IntrinsicsError  pictures of a board do not tell a camera's geometry
├── LensFileError    a file of another tool with intrinsics cannot be read, or cannot hold ours
├── ResponseError    an exposure sweep does not tell a camera's response
├── NoiseError       pictures do not tell dark level or noise
├── FlatFieldError   pictures of an even surface do not tell how the lens falls off
├── ColourError      pictures of a chart do not tell colours
├── ReadoutError     a blinking flash does not tell the readout of a rolling shutter
├── ReportError      a calibration cannot be shown
└── FlashGeometryError  pictures of a board do not tell where the flash is and how it shines

Every message is one sentence for the user: what is wrong, with its name, value and limit, and what to do
next.
"""

from capture.errors import CalibrationError


class BoardError(CalibrationError):
    """A board cannot be made, printed, or read from its description."""


class IntrinsicsError(CalibrationError):
    """Pictures of a board do not tell a camera's geometry."""


class LensFileError(CalibrationError):
    """A file with intrinsics of another tool cannot be read, or cannot hold what is to be written."""


class ResponseError(CalibrationError):
    """Pictures of an exposure sweep do not tell a camera's response."""


class NoiseError(CalibrationError):
    """Pictures do not tell dark level or noise."""


class FlatFieldError(CalibrationError):
    """Pictures of an even surface do not tell how the lens falls off."""


class FlashGeometryError(CalibrationError):
    """Pictures of a board with and without flash do not tell where the flash is and how it shines."""


class ColourError(CalibrationError):
    """Pictures of a colour chart do not tell how camera RGB becomes colours."""


class ReadoutError(CalibrationError):
    """Frames with a blinking flash do not tell the readout of a rolling shutter."""


class ReportError(CalibrationError):
    """There is no calibration to show."""
