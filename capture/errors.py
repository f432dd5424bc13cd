"""The errors that a user can meet, as a tree.

    RelightError
    └── CaptureError
        ├── SessionError     a session folder that cannot be read or written
        ├── SourceError      an import source (images, model, video, cloud) that cannot be read
        ├── ImageError       a picture that cannot be read or written
        ├── TransferError    an unknown transfer function; also a ValueError
        ├── CalibrationError a calibration.json that cannot be used
        ├── TaggingError     the flash state of the frames cannot be told
        └── DeviceError      a camera or flash that does not answer as it must
            ├── CameraError          ... of a camera
            │   ├── CameraGoneError      it is not there any more
            │   │   └── CameraEndedError     a recording that is played as a camera is over
            │   └── CameraTimeoutError   no frame came in time; also a TimeoutError
            └── FlashError           ... of a flash
                ├── FlashGoneError       it is not there any more, or its link is dead
                └── FlashResetError      it has restarted; its light is off

Every message is one sentence for the user: what is wrong, with its name, value and limit, and what to do
next. Commands print it and exit with code 1.
"""


class RelightError(Exception):
    """Base of all errors whose message is meant for the user."""


class CaptureError(RelightError):
    """Something between the camera and the session folder went wrong."""


class SessionError(CaptureError):
    """A session folder cannot be read or written."""


class SourceError(CaptureError):
    """An import source is missing, malformed or contradicts itself."""


class ImageError(CaptureError):
    """A picture cannot be read or written."""


class TransferError(CaptureError, ValueError):
    """A transfer function is unknown or has a parameter out of range."""


class CalibrationError(CaptureError):
    """A calibration file is malformed or holds impossible values."""


class TaggingError(CaptureError):
    """The flash state of the frames cannot be told."""


class DeviceError(CaptureError):
    """A camera or a flash does not answer as it must."""


class CameraError(DeviceError):
    """A camera does not answer as it must."""


class CameraGoneError(CameraError):
    """The camera is not there any more."""


class CameraEndedError(CameraGoneError):
    """A recording that is played as a camera is over."""


class CameraTimeoutError(CameraError, TimeoutError):
    """No frame came in time."""


class FlashError(DeviceError):
    """A flash does not answer as it must."""


class FlashGoneError(FlashError):
    """The flash is not there any more, or its link is dead."""


class FlashResetError(FlashError):
    """The flash has restarted; its light is off."""
