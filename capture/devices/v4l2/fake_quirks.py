"""What real cameras and drivers do wrong, as switches of the fake one, and cameras that are made of them.

The faults are those that users of real cameras have reported; `PROFILES` names them after a camera where one
is known for its fault, else after the fault.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

#: Pixel format -> ((width, height), rates).
Modes = Mapping[str, tuple[tuple[tuple[int, int], tuple[float, ...]], ...]]

_SIZES = (
    ((160, 120), (30.0, 15.0)),
    ((320, 240), (30.0, 15.0)),
    ((640, 480), (30.0, 15.0)),
    ((1280, 720), (30.0, 15.0)),
)
PLAIN_MODES: Modes = {"YUYV": _SIZES, "NV12": _SIZES, "MJPG": _SIZES, "RGGB": _SIZES, "RG10": _SIZES}
#: A USB 2 camera: uncompressed pictures are slow when they are large.
USB2_MODES: Modes = {
    "YUYV": (
        ((160, 120), (30.0, 15.0)),
        ((640, 480), (30.0, 15.0)),
        ((1280, 720), (10.0, 5.0)),
        ((1920, 1080), (5.0,)),
    ),
    "MJPG": (
        ((160, 120), (30.0, 15.0)),
        ((640, 480), (30.0, 15.0)),
        ((1280, 720), (30.0, 15.0)),
        ((1920, 1080), (30.0, 15.0)),
    ),
}


@dataclass(frozen=True)
class Quirks:
    """Switches; all off is a camera that does as it says.

    Attributes:
        modes: What it offers.
        old_names: Controls have the names of kernels before 5.16.
        refuses_inactive: EACCES for a control that an automatic holds, as new kernels do.
        controls: False: it has none at all.
        exposure_limits: (lowest, highest, step) of the exposure, 100 us.
        forgets_manual: The firmware is in automatic mode after each start of the stream; the driver does not
            know, and does not send a value again that it thinks is set.
        stale_cache: The driver answers what was written last, whatever the device does.
        latency_frames: Frames until a control shows.
        gain_creeps: The automatic goes on with the gain when the exposure is manual; nobody is told.
        rolls_over_at: Exposures beyond it come out dark; 0 = none.
        ignores_exposure: Takes every value and always exposes for the same time.
        slow_in_dark: With automatic priority on it halves its rate to expose for longer.
        bad_stamp_every: Frames between stamps that are wrong; 0 = never.
        lost_every: Frames between lost ones.
        damaged_every: Frames between incomplete ones.
        monotonic: False: the driver stamps with a clock of its own.
        fails_to_start: Starts of a stream that fail with EIO; the node is then busy until it is reopened.
        no_bandwidth: ENOSPC for uncompressed pictures from 1280 x 720 on.
        unplugged_at: Frame at which it goes away; 0 = never.
        broken_at: Frame at which the driver gives the stream up with EIO.
        meddled_at: Frame at which another program sets the exposure.
    """

    modes: tuple[tuple[str, tuple[tuple[tuple[int, int], tuple[float, ...]], ...]], ...] = tuple(
        PLAIN_MODES.items()
    )
    old_names: bool = False
    refuses_inactive: bool = False
    controls: bool = True
    exposure_limits: tuple[int, int, int] = (3, 2047, 1)
    forgets_manual: bool = False
    stale_cache: bool = False
    latency_frames: int = 2
    gain_creeps: bool = False
    rolls_over_at: int = 0
    ignores_exposure: bool = False
    slow_in_dark: bool = False
    bad_stamp_every: int = 0
    lost_every: int = 0
    damaged_every: int = 0
    monotonic: bool = True
    fails_to_start: int = 0
    no_bandwidth: bool = False
    unplugged_at: int = 0
    broken_at: int = 0
    meddled_at: int = 0


_USB2 = tuple(USB2_MODES.items())

PROFILES: Mapping[str, Quirks] = {
    "plain": Quirks(),
    "c920": Quirks(modes=_USB2, forgets_manual=True, slow_in_dark=True),
    "c270": Quirks(modes=_USB2, rolls_over_at=656),
    "lifecam": Quirks(modes=_USB2, exposure_limits=(5, 505, 50)),
    "old-kernel": Quirks(old_names=True),
    "new-kernel": Quirks(refuses_inactive=True),
    "stale-cache": Quirks(stale_cache=True),
    "forgets-manual": Quirks(forgets_manual=True, stale_cache=True, refuses_inactive=True),
    "creeping-gain": Quirks(gain_creeps=True),
    "ignores-exposure": Quirks(ignores_exposure=True),
    "bad-stamps": Quirks(bad_stamp_every=17),
    "own-clock": Quirks(monotonic=False),
    "gaps": Quirks(lost_every=13),
    "damaged": Quirks(damaged_every=11),
    "fails-to-start": Quirks(fails_to_start=1),
    "no-bandwidth": Quirks(no_bandwidth=True),
    "unplugged": Quirks(unplugged_at=300),
    "broken": Quirks(broken_at=300),
    "meddler": Quirks(meddled_at=300),
    "bare": Quirks(controls=False),
}
