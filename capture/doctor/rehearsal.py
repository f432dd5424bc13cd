"""A capture of a few seconds in a folder that is thrown away: what the devices really do together."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.controller.config import CaptureConfig
from capture.controller.run import run_capture
from capture.devices.camera import CameraProfile
from capture.devices.table import open_bench, open_camera, open_flash
from capture.doctor.banding import Banding, find_banding
from capture.doctor.finding import Finding, Level
from capture.session import Session

_SECONDS = 8.0
_GOOD_JITTER_S = 0.003
_FLICKER_DEPTH = 0.01
_LOST_SHARE = 0.01
_SIGMAS = 2.0
_MOST_LIT = 16
_BANDING_DEPTH = 0.01


def rehearse(camera_url: str, flash_url: str, profile: CameraProfile, on_s: float) -> list[Finding]:
    """Locks the camera, blinks the flash eight times, and says what came of it.

    Raises:
        DeviceError: A device cannot be opened or locked.
        KeyboardInterrupt: A signal has ended it.
    """
    config = CaptureConfig(duration_s=_SECONDS, on_s=on_s, profile=profile, restore=True, keep_all=True)
    bench = open_bench(camera_url, flash_url, _SECONDS)
    with (
        tempfile.TemporaryDirectory(prefix="relight-doctor-") as folder,
        open_flash(flash_url, bench) as flash,
        open_camera(camera_url, bench) as camera,
    ):
        outcome = run_capture(camera, flash, bench, Path(folder) / "rehearsal", config)
        info = outcome.session.info
        fps = camera.format.fps
        banding = find_banding(*_rows(outcome.session))
    if outcome.signal is not None:
        raise KeyboardInterrupt
    findings = [_of_control(control) for control in info["device"]["controls"]]
    findings += _of_frames(info["capture"])
    findings += _of_light(info["capture"], on_s, fps)
    findings += _of_banding(banding, info["capture"]["light"])
    said = {finding.sentence for finding in findings}
    if outcome.stopped is not None and outcome.stopped not in said:
        findings.append(Finding("rehearsal", Level.BAD, outcome.stopped))
    findings += [
        Finding("rehearsal", Level.NOTE, sentence) for sentence in outcome.warnings if sentence not in said
    ]
    return findings


def _rows(session: Session) -> tuple[list[NDArray[np.float32]], list[NDArray[np.float32]]]:
    """Of lit frames and of an unlit one near each: the mean radiance of every row, [H, 1, 3]."""
    frames = [record for record in session.frames if record.usable]
    unlit = [record for record in frames if record.flash == 0]
    pairs: tuple[list[NDArray[np.float32]], list[NDArray[np.float32]]] = ([], [])
    if not unlit:
        return pairs
    lit = [record for record in frames if record.flash == 1][:_MOST_LIT]
    for record in lit:
        near = min(unlit, key=lambda other: abs((other.pts_s or 0.0) - (record.pts_s or 0.0)))
        for rows, frame in zip(pairs, (record, near), strict=True):
            rows.append(session.load_radiance(frame).mean(axis=1, keepdims=True))
    return pairs


def _of_banding(banding: Banding | None, light: dict[str, Any] | None) -> list[Finding]:
    """Whether the lamp is dimmed by switching."""
    if banding is None or banding.depth < _BANDING_DEPTH:
        return []
    readout_s = None if light is None else light["readout_s"]
    rate = f", about {banding.waves / abs(readout_s):.0f} Hz" if readout_s else ""
    return [
        Finding(
            "banding",
            Level.NOTE,
            f"The flash's own light bands: {banding.waves:.0f} stripes over the picture{rate}, "
            f"{banding.depth:.1%} deep.",
            "It is dimmed by switching: run it at full level, or keep the camera still if it was not.",
        )
    ]


def _of_control(control: dict[str, Any]) -> Finding:
    """Whether a lock holds."""
    name, asked, found = control["name"], control["requested"], control["read_back"]
    value = "does not tell its value" if found is None else f"is {found:g}"
    if asked is not None and found is not None and asked != found:
        value += f", asked for {asked:g}"
    if control["note"]:
        value += f" ({control['note']})"
    if control["verified"] is False:
        return Finding(
            "lock",
            Level.BAD,
            f"{name} {value}; the light does not follow it.",
            "Set it with the camera's own program, try another --format or camera, or film with a phone.",
        )
    seen = ", and the light follows it" if control["verified"] else ""
    return Finding(
        "lock", Level.NOTE if control["note"] or found is None else Level.GOOD, f"{name} {value}{seen}"
    )


def _of_frames(report: dict[str, Any]) -> list[Finding]:
    frames, lost, damaged = report["frames"], report["lost"], report["damaged"]
    bad = lost + damaged > _LOST_SHARE * max(frames, 1)
    rate = frames / report["wall_s"] if report["wall_s"] > 0 else 0.0
    cpu = report["cpu_s"] / report["wall_s"] if report["wall_s"] > 0 else 0.0
    return [
        Finding(
            "frames",
            Level.BAD if bad else Level.GOOD,
            f"{frames} frames came ({rate:.1f} a second, {cpu:.0%} of a core), {lost} lost, {damaged} bad.",
            "Use another USB port without a hub, a smaller --size, or --format MJPG." if bad else "",
        )
    ]


def _of_light(report: dict[str, Any], on_s: float, fps: float | None) -> list[Finding]:
    """What the frames show of the flash and of the room."""
    light = report["light"]
    if light is None or light["refused"] is not None:
        return [Finding("flash", Level.BAD, "No flash was seen." if light is None else light["refused"])]
    findings = [Finding("flash", Level.GOOD, f"{light['pulses']} flashes were seen.")]
    if (latency_s := light["latency_s"]) is not None:
        jitter_s = light["latency_jitter_s"] or 0.0
        steady = jitter_s < _GOOD_JITTER_S
        findings.append(
            Finding(
                "flash",
                Level.GOOD if steady else Level.NOTE,
                f"The light comes {1e3 * latency_s:+.1f} ms after what the flash reports, by the camera's "
                f"stamps, and varies by {1e3 * jitter_s:.1f} ms.",
                "" if steady else "The tags allow for it; a flash with a schedule of its own varies less.",
            )
        )
    findings.append(_full_frames(light, on_s, fps))
    if (hz := light["flicker_hz"]) is not None and light["flicker_depth"] > _FLICKER_DEPTH:
        findings.append(
            Finding(
                "banding",
                Level.NOTE,
                f"The light bands at {hz:g} Hz, by {light['flicker_depth']:.1%} of the room's light.",
                f"Use daylight or lamps on direct current, or an exposure that is a multiple of 1/{hz:g} s.",
            )
        )
    return findings


def _full_frames(light: dict[str, Any], on_s: float, fps: float | None) -> Finding:
    """Whether every flash has a frame that is lit in all rows: t_on >= exposure + readout + frame period."""
    exposure_s, readout_s = light["exposure_s"], light["readout_s"]
    if fps is None or exposure_s is None or readout_s is None:
        return Finding(
            "flash",
            Level.SKIPPED,
            "Exposure or readout could not be found from so few flashes, so it is open whether every flash "
            "lights a frame in full.",
            "Record for longer, with more light of the flash on the subject.",
        )
    readout_s = abs(readout_s) + _SIGMAS * light["readout_sigma_s"]
    needed_s = exposure_s + readout_s + 1.0 / fps
    sum_text = (
        f"exposure {1e3 * exposure_s:.1f} + readout at most {1e3 * readout_s:.1f} + frame period "
        f"{1e3 / fps:.1f} = {1e3 * needed_s:.1f} ms"
    )
    if needed_s <= on_s:
        return Finding(
            "flash", Level.GOOD, f"Every flash of {1e3 * on_s:.0f} ms lights a frame in full: {sum_text}."
        )
    return Finding(
        "flash",
        Level.BAD,
        f"A flash of {1e3 * on_s:.0f} ms need not light any frame in full: {sum_text}.",
        "Lengthen the flash (--on), shorten the exposure (--exposure) or raise the frame rate (--fps).",
    )
