"""The capture: lock the camera, start the pulse train, take every frame, stop in time, tag, and put all away.

Whatever happens, the lamp is put out first: on the normal end, on Ctrl-C and SIGTERM, when a device goes
away, when the disk is full, on any error.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from capture.cameras import Camera
from capture.controller.config import CaptureConfig
from capture.controller.edge_log import EdgeLog
from capture.controller.folder import create_folder, resume_folder, save_scene
from capture.controller.frame_sink import FrameSink
from capture.controller.interrupts import Interrupts
from capture.controller.looking import FrameLooker, Watch
from capture.controller.report import Counts, capture_report, pulse_warning
from capture.controller.stop_rules import SILENCE_S, StopRules
from capture.controller.tags import apply_tags
from capture.controller.time_axis import TimeAxis
from capture.controls import Controls
from capture.devices.bench import Bench
from capture.devices.camera import CameraDevice, CapturedFrame, LockReport
from capture.devices.flash import FlashDevice, FlashEdge, PulseTrain
from capture.errors import (
    CameraEndedError,
    CameraError,
    CameraTimeoutError,
    DeviceError,
    FlashError,
    SessionError,
)
from capture.session import FrameRecord, Session
from capture.tagging import FrameTag, TaggingConfig
from capture.tagging.given_readout import with_given_readout
from capture.tagging.stream_summary import StreamResult

_READ_TIMEOUT_S = 0.5
_LEAD_S = 0.7  # from the first frame to the first flash: unlit frames to compare with
_USUAL_FPS = 30.0
# Of a wrong label: ten thousand flashes must pass without one (benchmarks/soak.py).
_RISK = 1e-4
_STAMP_SIGMA_S = 1e-4  # of a driver's stamps
_SURE_PULSES = 3  # reported ones that no light answers


@dataclass(frozen=True)
class CaptureOutcome:
    """How a capture ended.

    Attributes:
        session: With every frame that was taken.
        stopped: Why it ended before its time, or is of no use, a sentence; None = it is whole, or a signal
            ended it.
        signal: Name of the signal that ended it; None = none did.
        warnings: What a person should know, a sentence each.
    """

    session: Session
    stopped: str | None
    signal: str | None
    warnings: tuple[str, ...]


def run_capture(
    camera: CameraDevice,
    flash: FlashDevice,
    bench: Bench,
    out: Path,
    config: CaptureConfig,
    *,
    watch: Watch | None = None,
    resume: bool = False,
) -> CaptureOutcome:
    """Records a session.

    Args:
        camera: Open, not locked.
        flash: Open, dark.
        bench: Their clock.
        out: Session folder to make, or to go on with.
        config: What is asked for.
        watch: Who is shown it.
        resume: Whether `out` is an interrupted capture to go on with.

    Returns:
        The session, and how it ended. All that was taken is in it, tagged as far as it can be.

    Raises:
        CaptureError: Before the first frame: the camera cannot be locked, the folder is in use, the flash
            cannot do what is asked for.
    """
    _check_dimming(flash, config)
    try:
        lock = camera.lock(config.profile)
        capture = _Capture(camera, flash, bench, config, lock, watch)
        session = capture.resume(Path(out)) if resume else capture.create(Path(out))
        with session, Interrupts() as interrupts:
            stopped = capture.record(session, interrupts)
            stopped = _finished(capture, session, stopped, interrupts.received)
        return CaptureOutcome(session, stopped, interrupts.received, tuple(capture.warnings))
    finally:
        flash.off()


def _check_dimming(flash: FlashDevice, config: CaptureConfig) -> None:
    """Refuses before a folder is made what the flash would refuse after it."""
    if config.level < 1 and not flash.capabilities.dimmable:
        raise FlashError(f"{flash.info.name} cannot dim its light to {config.level:g}; leave out --level.")


def _finished(capture: _Capture, session: Session, stopped: str | None, signal: str | None) -> str | None:
    """See `_Capture.finish`; why it stopped is told even when that cannot be written down."""
    try:
        return capture.finish(session, stopped, signal)
    except SessionError as error:
        raise SessionError(stopped or f"{error} Make room on the disk, and tag it with --resume.") from error


class _Capture:
    """One capture, step by step."""

    def __init__(
        self,
        camera: CameraDevice,
        flash: FlashDevice,
        bench: Bench,
        config: CaptureConfig,
        lock: LockReport,
        watch: Watch | None,
    ) -> None:
        self._camera, self._flash, self._clock, self._config = camera, flash, bench.clock, config
        self._lock, self._watch = lock, watch
        self._fps = camera.format.fps or _USUAL_FPS
        self._counts = Counts()
        self._tags: dict[int, FrameTag] = {}
        self._poses: dict[int, Camera] = {}
        self._begin_s, self._next_index = 0.0, 0
        self.warnings: list[str] = []
        for sentence in (*lock.warnings, *pulse_warning(config.on_s, lock, self._fps)):
            self._warn(sentence)
        tagging = TaggingConfig(
            exposure_s=lock.value("exposure_s"),
            shortest_period_s=min(0.5, 0.8 * config.period_s),
            longest_on_s=max(0.35, 1.5 * config.on_s),
            risk=_RISK,
            stamp_sigma_s=_STAMP_SIGMA_S,
        )
        live = Controls(
            camera=camera.info.name,
            width=camera.format.width,
            height=camera.format.height,
            rate_hz=camera.format.fps,
        )
        tagging = with_given_readout(tagging, config.calibration, live)
        self._looker = FrameLooker(camera.format, tagging, flash.info.name)
        self._tagger = ThreadPoolExecutor(1, thread_name_prefix="tags")
        self._tagging: Future[dict[int, FrameTag]] | None = None

    def create(self, out: Path) -> Session:
        """A new session folder; what of its calibration does not hold as the camera is locked is told."""
        session = create_folder(out, self._camera, self._flash, self._lock, self._config)
        _, warning = session.read_calibration()
        if warning is not None:
            self._warn(f"Calibration: {warning[0].lower()}{warning[1:]}")
        return session

    def resume(self, out: Path) -> Session:
        """An interrupted one; frames of it that have no tag yet are looked at again."""
        session, self._begin_s = resume_folder(out, self._camera, self._looker, self._config.on_s)
        self._next_index = 1 + max((record.index for record in session.frames), default=-1)
        return session

    def record(self, session: Session, interrupts: Interrupts) -> str | None:
        """Takes the frames; why it stopped before its time."""
        self._axis = TimeAxis(self._camera.info.clock, 1.0 / self._fps, self._begin_s)
        self._counts.start(self._clock.now_s(), time.process_time())
        edges = EdgeLog(session.path)
        try:
            with FrameSink(session, self._camera.format) as sink:
                try:
                    stopped = self._take_frames(session.path, sink, edges, interrupts)
                finally:
                    confirmed = self._flash.off()
                sink.drain()
                self._counts.waits = sink.waits
        except SessionError as error:
            stopped = (
                f"{error} What was taken before it is kept; make room on the disk and go on with --resume."
            )
        finally:
            edges.close()
            self._counts.end(self._clock.now_s(), time.process_time())
        if not confirmed:
            self._warn("The flash has not confirmed that it is off: look at it, and unplug it if it burns.")
        return stopped

    def finish(self, session: Session, stopped: str | None, signal: str | None) -> str | None:
        """Tags, chooses the frames that keep their pictures, writes the report, closes the session.

        Returns:
            Why it is no whole capture, if no signal is the reason: `stopped`, or that no flash was found.
        """
        result: StreamResult | None = None
        self._tagger.shutdown()
        if self._tagging is not None:
            self._tags.update(self._tagging.result())
        if self._watch is not None:
            self._watch.say("The lamp is off; telling lit frames from unlit ones.")
        if (rest := self._looker.finish()) is not None:
            self._tags.update(rest[0])
            result = rest[1]
            refused = result.refused or self._stranger(result)
            if refused is None:
                apply_tags(session, self._tags, self._config)
            elif stopped is None and signal is None:
                stopped = refused
            for sentence in result.warnings:
                if sentence != stopped:
                    self._warn(sentence)
        elif stopped is None and signal is None:
            stopped = (
                "The camera has given no frame; try it with its own program, or name another (--camera)."
            )
        save_scene(session, self._camera, self._poses)
        for sentence in self._left_behind():
            self._warn(sentence)
        session.update_info(
            capture=capture_report(self._flash, self._counts, result, stopped or signal),
            warnings=[*session.info.get("warnings", []), *self.warnings],
        )
        session.finish("complete" if stopped is None and signal is None else "interrupted")
        return stopped

    def _stranger(self, result: StreamResult) -> str | None:
        """A sentence when what lit the frames is not the flash: no pulse comes when one was reported."""
        reported = self._counts.edges // 2
        if reported < _SURE_PULSES or result.matched:
            return None
        return (
            f"The flash reported {reported} flashes and the frames show {result.pulses} changes of light at "
            "other times; point the lamp at the subject, see that it lights up, and that no other "
            "light changes."
        )

    def _take_frames(
        self, folder: Path, sink: FrameSink, edges: EdgeLog, interrupts: Interrupts
    ) -> str | None:
        rules = StopRules(self._config, folder, self._fps)
        started = False
        heard_s = self._clock.now_s()
        try:
            while interrupts.received is None:
                self._take_edges(edges)
                try:
                    frame = self._camera.read(_READ_TIMEOUT_S)
                except CameraTimeoutError:
                    if self._clock.now_s() - heard_s > SILENCE_S:
                        raise
                    continue
                heard_s = self._clock.now_s()
                if not started:
                    self._start_train()
                    started = True
                pts_s, sound_stamp = self._axis.pts_s(frame)
                if pts_s - self._begin_s > self._config.duration_s:
                    return None
                light = self._take(frame, pts_s, sound_stamp, sink)
                sentence = self._reason_to_stop(rules, light, pts_s - self._begin_s)
                if sentence is not None:
                    return sentence
        except CameraEndedError:
            return None
        except DeviceError as error:
            return str(error)
        return None

    def _reason_to_stop(
        self, rules: StopRules, light: tuple[float, float] | None, recorded_s: float
    ) -> str | None:
        if light is not None and (sentence := rules.of_light(*light)) is not None:
            return sentence
        status = self._looker.pulses()
        if status is not None and (sentence := rules.of_pulses(status, recorded_s)) is not None:
            return sentence
        return rules.of_devices(self._camera, self._clock.now_s())

    def _start_train(self) -> None:
        config = self._config
        period_s = config.train_period_s(self._fps)
        count = min(65535, 1 + math.ceil(config.duration_s / period_s))
        self._flash.start(
            PulseTrain(
                start_s=self._clock.now_s() + _LEAD_S,
                period_s=period_s,
                on_s=config.on_s,
                count=count,
                level=config.level,
            )
        )

    def _take(
        self, frame: CapturedFrame, pts_s: float, sound_stamp: bool, sink: FrameSink
    ) -> tuple[float, float] | None:
        """Looks at a frame and sends it to the disk; (level, share clipped), None = it is damaged."""
        index = self._next_index
        self._next_index += 1
        lost = self._counts.frame(frame)
        remarks = ["dropped_before"] if lost else []
        if frame.stamp_estimated or not sound_stamp:
            self._counts.stamps_repaired += 1
            remarks.append("stamp_repaired")
        looked = None if frame.damaged else self._looker.look(index, pts_s, frame)
        if looked is None:
            self._counts.damaged += 1
            remarks.append("unreadable")
        record = FrameRecord(
            index=index,
            file=None,
            width=self._camera.format.width,
            height=self._camera.format.height,
            pts_s=round(pts_s, 9),
            device_timestamp_ns=round(frame.stamp_s * 1e9),
            sequence=frame.sequence,
            exposure_s=frame.exposure_s or self._lock.value("exposure_s"),
            gain=frame.gain or self._lock.value("gain"),
            sharpness=looked.sharpness if looked else None,
            reasons=tuple(remarks),
        )
        sink.put(record, frame.data)
        self._tag_meanwhile()
        if frame.camera is not None:
            self._poses[index] = frame.camera
        if looked is None:
            return None
        if self._watch is not None:
            self._watch.frame(looked, sink.waiting)
        return looked.level, looked.clipped

    def _tag_meanwhile(self) -> None:
        """Tags of what is complete, in a thread of their own: frames must not wait for them."""
        if self._tagging is None:
            self._tagging = self._tagger.submit(self._looker.ready)
        elif self._tagging.done():
            self._tags.update(self._tagging.result())
            self._tagging = None

    def _take_edges(self, log: EdgeLog) -> None:
        edges = self._flash.poll()
        if not edges:
            return
        on_axis = self._on_axis(edges)
        log.append(on_axis)
        self._counts.edges += len(edges)
        self._looker.expect(on_axis, self._config.on_s)
        if self._watch is not None:
            self._watch.edges(on_axis)

    def _on_axis(self, edges: Sequence[FlashEdge]) -> list[FlashEdge]:
        timed = [(edge, self._axis.from_host(edge.time_s)) for edge in edges]
        return [replace(edge, time_s=time_s) for edge, time_s in timed if time_s is not None]

    def _left_behind(self) -> list[str]:
        """The controls a last time, and back to what they were if that is wished."""
        sentences = []
        try:
            for control in self._camera.check():
                sentences.append(
                    f"At the end {control.name} was {control.read_back}, not {control.requested} any more."
                )
            if self._config.restore:
                sentences += self._camera.restore()
        except CameraError as error:
            sentences.append(str(error))
        return sentences

    def _warn(self, sentence: str) -> None:
        if sentence not in self.warnings:
            self.warnings.append(sentence)
            if self._watch is not None:
                self._watch.say(sentence)
