"""Everything that is shown, frame by frame: a few milliseconds each, and memory that does not grow."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.devices.flash import FlashEdge
from capture.live.advice import Adviser
from capture.live.coverage import TYPICAL_FOCAL, CoverageGauge, surroundings_turn
from capture.live.flow import SHORT_SIDE, FlowTracker
from capture.live.live_tags import LIT, UNKNOWN, UNLIT, LiveTagger
from capture.live.meters import Light, LightMeter, SharpnessGauge
from capture.live.motion import HeadMotion
from capture.live.state import LiveState

_STRIP_S = 3.0  # of labels that are shown
_HOLD_S = 1.3  # what the last flash clipped is shown until the next one
_BLURRED, _USELESS = 0.55, 0.5  # relative sharpness: remarked; corners would be followed badly
_PATIENCE_S = 0.5  # blurred ones are followed when nothing better comes
_LATELY_S = 1.0
_WALK_S = 3.0  # over which the speed of the walk is judged


class LiveMonitor:
    """Watches a recording for the operator; one thread calls it.

    Raises:
        ValueError: a size, rate or time that is not positive.
        TransferError: unknown transfer function.
    """

    def __init__(
        self,
        width: int,
        height: int,
        transfer: str,
        fps: float,
        train_period_s: float | None,
        duration_s: float,
        *,
        focal_px: float | None = None,
        rotation_deg: int = 0,
    ) -> None:
        """Begins.

        Args:
            width: of the pictures that `add` gets, pixels, sensor orientation.
            height: likewise.
            transfer: of their values (`capture.transfer`).
            fps: nominal frame rate.
            train_period_s: of the flash; None = no flash is expected.
            duration_s: planned length of the recording.
            focal_px: of those pictures; None = a typical one is taken, and the angles of the walk are as
                wrong as it is (a lens of 70 degrees instead of 58: by a fifth).
            rotation_deg: clockwise turn that shows the pictures upright: 0, 90, 180, 270.
        """
        for name, value in {"width": width, "height": height, "fps": fps, "duration_s": duration_s}.items():
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}; it must be positive")
        if rotation_deg not in (0, 90, 180, 270):
            raise ValueError(f"rotation_deg is {rotation_deg}; it must be 0, 90, 180 or 270")
        self._turns = rotation_deg // 90
        self._size = (height, width)
        self._period_s, self._duration_s = train_period_s, duration_s
        self._scale = min(1.0, SHORT_SIDE / min(width, height))
        self._small = (round(width * self._scale), round(height * self._scale))
        self._focal_px = (focal_px or TYPICAL_FOCAL * max(width, height)) * self._scale
        self._meter, self._sharpness = LightMeter(width, height, self._turns % 2 == 1), SharpnessGauge()
        self._tagger, self._tracker = LiveTagger(transfer), FlowTracker()
        self._gauge, self._motion, self._adviser = CoverageGauge(), HeadMotion(), Adviser()
        self._labels: deque[str] = deque(maxlen=max(8, round(_STRIP_S * fps)))
        self._blurs: deque[bool] = deque(maxlen=max(3, round(_LATELY_S * fps)))
        self._walk: deque[tuple[float, float]] = deque()
        self._first_s: float | None = None
        self._last_s = 0.0
        self._sequence: int | None = None
        self._frames = self._drops = self._queue = self._expected = 0
        self._edges_known = False
        self._edges_s: deque[float] = deque()
        self._unlit: Light | None = None
        self._lit: Light | None = None
        self._lit_s = -math.inf
        self._fineness = 1.0
        self._followed_s = -math.inf

    def add(self, picture: NDArray[np.uint8], stamp_s: float, sequence: int, *, queue: int = 0) -> str:
        """Looks at a frame.

        Args:
            picture: [h, w, 3] RGB or [h, w] luma, uint8, display values.
            stamp_s: by the camera's clock. A frame that is not later than the one before is counted only.
            sequence: the camera's count.
            queue: frames that wait to be written.

        Returns:
            Its label for display: "lit", "unlit", "partial", "unknown".

        Raises:
            ValueError: another size or type than was announced.
        """
        if picture.shape[:2] != self._size or picture.ndim not in (2, 3) or picture.dtype != np.uint8:
            raise ValueError(
                f"a picture {picture.shape} {picture.dtype} came; {self._size} or {(*self._size, 3)} uint8 "
                "was announced"
            )
        self._frames += 1
        self._queue = queue
        if self._sequence is not None and sequence > self._sequence:
            self._drops += sequence - self._sequence - 1
        self._sequence = sequence
        if self._first_s is None:
            self._first_s = stamp_s
        elif stamp_s <= self._last_s:
            self._labels.append(UNKNOWN)
            return UNKNOWN
        self._last_s = stamp_s
        luma = (
            picture if picture.ndim == 2 else np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.uint8)
        )
        label = self._tagger.add(luma, stamp_s)
        self._labels.append(label)
        light = self._meter.measure(picture, luma)
        if label == UNLIT:
            self._unlit = light
            self._look_at_unlit(luma, stamp_s)
        elif label == LIT:
            self._lit, self._lit_s = light, stamp_s
            self._gauge.flash()
        elif self._unlit is None:
            self._unlit = light
        return label

    def _look_at_unlit(self, luma: NDArray[np.uint8], stamp_s: float) -> None:
        small = np.asarray(cv2.resize(luma, self._small, interpolation=cv2.INTER_AREA), np.uint8)
        self._fineness = self._sharpness.add(small)
        self._blurs.append(self._fineness < _BLURRED)
        if self._fineness < _USELESS and stamp_s - self._followed_s < _PATIENCE_S:
            return
        self._followed_s = stamp_s
        flow = self._tracker.add(np.ascontiguousarray(np.rot90(small, -self._turns)), stamp_s)
        if flow is None:
            return
        turn = surroundings_turn(flow, self._focal_px)
        self._gauge.add(turn, flow.interval_s)
        self._motion.add(flow, turn, self._focal_px)
        azimuth = self._gauge.coverage().azimuth_deg
        if azimuth is not None:
            self._walk.append((stamp_s, azimuth))
        while self._walk and self._walk[0][0] < stamp_s - _WALK_S:
            self._walk.popleft()

    def edges(self, edges: Iterable[FlashEdge]) -> None:
        """What the flash says of its edges, in about the camera's time: flashes to expect."""
        self._edges_known = True
        self._edges_s.extend(edge.time_s for edge in edges if edge.on)

    def snapshot(self) -> LiveState:
        """This moment."""
        elapsed_s = 0.0 if self._first_s is None else self._last_s - self._first_s
        unlit, lit = self._unlit or Light(0.0, 0.0, 0.0, 0.0), self._lit
        recent = lit if lit is not None and self._last_s - self._lit_s <= _HOLD_S else None
        state = LiveState(
            elapsed_s=elapsed_s,
            left_s=max(0.0, self._duration_s - elapsed_s),
            frames=self._frames,
            drops=self._drops,
            queue=self._queue,
            level=unlit.level,
            level_lit=None if lit is None else lit.level,
            clipped=max(unlit.clipped, recent.clipped if recent else 0.0),
            clipped_subject=max(unlit.clipped_subject, recent.clipped_subject if recent else 0.0),
            dark=unlit.dark,
            labels=tuple(self._labels),
            pulses_seen=self._tagger.pulses,
            pulses_expected=self._pulses_expected(elapsed_s),
            coverage=self._gauge.coverage(),
            motion=self._motion.restlessness(),
            sharpness=self._fineness,
            finished=elapsed_s >= self._duration_s,
        )
        return replace(state, advice=self._advice(state))

    def _pulses_expected(self, elapsed_s: float) -> int | None:
        if self._edges_known:
            while self._edges_s and self._edges_s[0] <= self._last_s:
                self._edges_s.popleft()
                self._expected += 1
            return self._expected
        return None if self._period_s is None else math.floor(elapsed_s / self._period_s)

    def _advice(self, state: LiveState) -> str:
        last_pulse_s = self._tagger.last_pulse_s
        since_s = (self._first_s or 0.0) if last_pulse_s is None else last_pulse_s
        walked = [azimuth for _, azimuth in self._walk]
        over_s = self._walk[-1][0] - self._walk[0][0] if len(self._walk) > 1 else 0.0
        settled = over_s > 0.8 * _WALK_S
        return self._adviser.choose(
            state,
            without_flash_s=self._last_s - since_s,
            period_s=self._period_s,
            blurred=float(np.mean(self._blurs)) if self._blurs else 0.0,
            walk_deg_s=(max(walked) - min(walked)) / over_s if settled else math.inf,
        )
