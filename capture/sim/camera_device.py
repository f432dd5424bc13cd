"""The simulated camera: frames of the rig, lit by what lamps shine on the bench.

Its time is the bench's. When that is virtual, reading a frame makes its time pass; otherwise frames are due
in real time and are delivered when they are computed, each with its right stamp.
"""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Self

import numpy as np

from capture.devices.bench import Bench, VirtualClock
from capture.devices.camera import (
    CameraInfo,
    CameraProfile,
    CapturedFrame,
    ControlReport,
    KnownScene,
    LockReport,
    StreamFormat,
)
from capture.errors import CameraError, CameraGoneError, CameraTimeoutError
from capture.sim.cloud import stereo_cloud
from capture.sim.config import RigConfig
from capture.sim.edge_file import EdgeFile
from capture.sim.lamp import Pulse, PulseTrain
from capture.sim.rig import Exposure, Layers, Rig

_AHEAD = 4  # frames computed beforehand
_EDGE_WAIT_S = 5.0
_DRIFT = 1.6  # factor on the exposure, of the fault
_EXPOSURES_S = (0.0002, 0.03)
_GAINS = (0.25, 8.0)
_LEVEL_AT_S = 0.008  # exposure at which the rig's radiance is taken as it is


@dataclass(frozen=True)
class CameraFaults:
    """What goes wrong, seconds after the first frame; None = it does not.

    Attributes:
        unplug_s: the camera goes away.
        drift_s: its exposure changes by itself.
    """

    unplug_s: float | None = None
    drift_s: float | None = None


class SimulatedCamera:
    """A `CameraDevice` that knows what it films (`KnowsScene`)."""

    def __init__(
        self,
        *,
        url: str,
        config: RigConfig,
        bench: Bench,
        edges: EdgeFile | None = None,
        faults: CameraFaults | None = None,
        tells_scene: bool = True,
    ) -> None:
        """Builds the scene, which takes some seconds.

        Args:
            url: that opens it.
            config: the rig's; its lamp is that of the bench.
            bench: clock and light.
            edges: light that comes from a file, instead of the bench's.
            faults: what goes wrong.
            tells_scene: whether it gives away poses and cloud.
        """
        self._rig = Rig.build(config)
        self._bench, self._edges, self._faults = bench, edges, faults or CameraFaults()
        self._tells_scene = tells_scene
        self._virtual = isinstance(bench.clock, VirtualClock)
        self._rng = np.random.default_rng([config.sensor.seed, 5])
        self._exposure_s, self._gain = config.sensor.exposure_s, 1.0
        self._locked: dict[str, float] = {}
        self._before: dict[str, float] = {}
        self._start_s: float | None = None
        self._tick = self._index = 0
        self._dropped = 0
        self._pool = ThreadPoolExecutor(2, thread_name_prefix="sim-camera")
        self._ahead: deque[tuple[int, float, Future[Layers]]] = deque()
        self._next_tick = 0
        self._closed = False
        camera = self._rig.camera(0.0, "format")
        self._format = StreamFormat(
            width=camera.width,
            height=camera.height,
            pixel_format="RGB3",
            fps=config.fps,
            transfer=config.sensor.transfer,
            rotation_deg=config.rotation_deg,
        )
        self.info = CameraInfo(
            url=url,
            name="simulated rig",
            back_end="sim",
            details={"readout_s": config.sensor.readout_s, "seed": config.subject.seed},
            clock="monotonic",
            stamp_at="start of exposure",
        )

    @property
    def format(self) -> StreamFormat:
        """See `CameraDevice.format`."""
        return self._format

    def known_scene(self) -> KnownScene | None:
        """What dense stereo along the path would find, and where the flash sits."""
        if not self._tells_scene:
            return None
        config = self._rig.config
        times = np.linspace(0.03, 0.97, 9) * config.path.duration_s
        cameras = [self._rig.camera(time_s, "stereo") for time_s in times]
        rng = np.random.default_rng([config.subject.seed, 404])
        cloud = stereo_cloud(self._rig.bust, cameras, config.cloud_points, rng)
        return KnownScene(flash_offset_cam_m=config.flash_offset_cam_m, cloud=cloud)

    def lock(self, profile: CameraProfile) -> LockReport:
        """See `CameraDevice.lock`; exposure and gain can be set, the rest is as the rig was built."""
        if not self._before:
            self._before = {"exposure_s": self._exposure_s, "gain": self._gain}
        controls, warnings = [], []
        for name, wish, (low, high) in (
            ("exposure_s", profile.exposure_s, _EXPOSURES_S),
            ("gain", profile.gain, _GAINS),
        ):
            value = getattr(self, f"_{name}") if wish is None else float(np.clip(wish, low, high))
            note = "" if wish in (None, value) else f"asked for {wish:g}, clamped to {value:g}"
            if note:
                warnings.append(f"{name}: {note}.")
            setattr(self, f"_{name}", value)
            controls.append(ControlReport(name=name, requested=wish, read_back=value, note=note))
        fps = self._rig.config.fps
        note = "" if profile.fps in (None, fps) else f"asked for {profile.fps:g}, the rig has {fps:g}"
        controls.append(ControlReport(name="fps", requested=profile.fps, read_back=fps, note=note))
        size = (self._format.width, self._format.height)
        if (profile.width or size[0], profile.height or size[1]) != size:
            warnings.append(
                f"The rig's pictures are {size[0]} x {size[1]}, not {profile.width} x {profile.height}."
            )
        self._locked = {"exposure_s": self._exposure_s, "gain": self._gain}
        return LockReport(controls=tuple(controls), warnings=tuple(warnings))

    def read(self, timeout_s: float) -> CapturedFrame:
        """See `CameraDevice.read`."""
        if self._closed:
            raise CameraError("The simulated camera is closed; open it again.")
        clock = self._bench.clock
        if self._start_s is None:
            self._start_s = clock.now_s()
        self._fill()
        tick, start_s, unlit = self._ahead[0]
        if self._has_happened(self._faults.unplug_s, start_s):
            raise CameraGoneError("The simulated camera was unplugged; plug it in again.")
        sensor = self._rig.config.sensor
        due_s = self._start_s + start_s + sensor.readout_s + self._exposure_s
        if isinstance(clock, VirtualClock):
            clock.advance_to(due_s)
        elif due_s - clock.now_s() > timeout_s:
            clock.sleep(timeout_s)
            raise CameraTimeoutError(f"The simulated camera gave no frame within {timeout_s} s.")
        else:
            clock.sleep(due_s - clock.now_s())
        pulses = self._pulses(start_s, due_s - self._start_s)
        self._ahead.popleft()
        if self._has_happened(self._faults.drift_s, start_s) and self._exposure_s == self._locked.get(
            "exposure_s", self._exposure_s
        ):
            self._exposure_s *= _DRIFT
        rig = replace(
            self._rig,
            config=replace(self._rig.config, sensor=replace(sensor, exposure_s=self._exposure_s)),
        )
        taken = rig.take(
            Exposure(self._index, tick, start_s, 0),
            pulses,
            sensitivity=self._gain * self._exposure_s / _LEVEL_AT_S,
            unlit=unlit.result(),
        )
        self._index += 1
        return CapturedFrame(
            stamp_s=self._start_s + start_s,
            sequence=tick,
            data=taken.rgb,
            arrival_s=clock.now_s(),
            exposure_s=self._exposure_s,
            gain=self._gain,
            camera=taken.camera if self._tells_scene else None,
        )

    def check(self) -> tuple[ControlReport, ...]:
        """See `CameraDevice.check`."""
        now = {"exposure_s": self._exposure_s, "gain": self._gain}
        return tuple(
            ControlReport(name=name, requested=value, read_back=now[name], note="changed by itself")
            for name, value in self._locked.items()
            if now[name] != value
        )

    def restore(self) -> tuple[str, ...]:
        """See `CameraDevice.restore`."""
        if self._before:
            self._exposure_s, self._gain = self._before["exposure_s"], self._before["gain"]
        self._locked = {}
        return ()

    def close(self) -> None:
        """See `CameraDevice.close`."""
        self._closed = True
        self._pool.shutdown(cancel_futures=True)
        if self._edges is not None:
            self._edges.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _has_happened(self, after_s: float | None, start_s: float) -> bool:
        return after_s is not None and start_s >= after_s

    def _fill(self) -> None:
        """Sees to it that the next few frames are being computed; some are lost before."""
        config = self._rig.config
        while len(self._ahead) < _AHEAD:
            tick = self._next_tick
            self._next_tick += 1
            jitter_s = config.sensor.timestamp_jitter_s * float(np.clip(self._rng.normal(), -4, 4))
            if tick > 0 and self._rng.random() < config.sensor.dropped:
                continue
            start_s = max(0.0, tick / config.fps + jitter_s)
            self._ahead.append((tick, start_s, self._pool.submit(self._rig.unlit, start_s)))

    def _pulses(self, begin_s: float, end_s: float) -> PulseTrain:
        """The lamp's pulses about an interval of the recording, in its time."""
        assert self._start_s is not None
        zero_s = self._start_s
        if self._edges is not None:
            if not self._edges.wait_until(zero_s + end_s, self._bench.clock, _EDGE_WAIT_S):
                raise CameraTimeoutError(
                    f"The lamp that lights the simulated camera has said nothing for {_EDGE_WAIT_S:g} s."
                )
            near = self._edges.near(zero_s + begin_s - 1.0, zero_s + end_s)
        else:
            near = [
                (on_s, off_s)
                for on_s, off_s in self._bench.light.pulses
                if on_s < zero_s + end_s and off_s > zero_s + begin_s - 1.0
            ]
        pulses = tuple(Pulse(on_s - zero_s, min(off_s - zero_s, end_s + 1.0)) for on_s, off_s in near)
        return PulseTrain(self._rig.config.lamp, pulses)
