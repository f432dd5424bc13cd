"""A folder of DNG or camera RAW stills, without poses: developed to linear pictures, tagged as other stills.

All are developed alike. One white balance goes for the whole folder, that of the first picture: only with the
same multipliers is lit minus unlit the flash, and what the camera thought of each picture's white does not
matter, for RAW samples do not have it. Where the exposure changes all the same, radiance is brought to that
of most pictures by what the files state.

Frames become half float EXR, camera colours, in the sensor's orientation. A half float is right to 1 in
2048, a twentieth of the shot noise of 10,000 electrons. Clipped pixels are set to `clip_radiance` of
session.json, a power of two that no other pixel reaches.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.errors import ImageError, SourceError
from capture.importers.image_set import (
    apply_options,
    choose_cloud,
    copy_mask,
    describe_source,
    open_or_create,
)
from capture.importers.options import ImportOptions, Progress
from capture.importers.raw_files import find_raw_files, refuse_doubles, say_left_out, some
from capture.importers.source_frame import SourceFrame
from capture.raw.facts import RawFacts
from capture.raw.reader import RawFile
from capture.session import FrameRecord, Session
from capture.tagging import ProfileAccumulator
from capture.tagging.profiles import THUMBNAIL_COLUMNS, THUMBNAIL_ROWS
from capture.tagging.stills import tag_stills
from capture.transfer import to_display

_SAME_LIGHT = 0.005  # of exposure x gain: below it is how a camera rounds what it states
_HALF_BELOW_ONE = 1.0 - 2.0**-11  # the largest half float below 1


@dataclass(frozen=True, eq=False)
class _Still:
    """A RAW picture that was looked at.

    Attributes:
        path: the file.
        facts: what it says.
        small: [h, w, 3] radiance of a thumbnail, not white balanced.
    """

    path: Path
    facts: RawFacts
    small: NDArray[np.float32]


def import_raw_stills(folder: Path, out: Path, options: ImportOptions, progress: Progress) -> Session:
    """Makes a session of the RAW files in a folder, in the order in which they were taken.

    Everything is read once before the first file is written. An interrupted session of the same source is
    completed.

    Raises:
        SourceError: a file that cannot be read or is of another camera or size, two of one name, or options
            that do not fit.
        TaggingError: without a flash list, where the pictures do not show which of them are lit.
    """
    if options.transfer is not None:
        raise SourceError(f"The RAW files in {folder} are linear by themselves; leave --transfer out.")
    files = find_raw_files(folder)
    refuse_doubles(files)
    warnings = say_left_out(folder, files)
    choose_cloud(None, options, False, warnings)
    stills = []
    for done, file in enumerate(files):
        stills.append(_look(file))
        _refuse_other(stills[0], stills[-1])
        progress("reading RAW files", (done + 1) / len(files))
    stills = _in_order(stills, warnings)
    factors = _factors([still.facts for still in stills], [still.path.name for still in stills], warnings)
    balance = stills[0].facts.white_balance or (1.0, 1.0, 1.0)
    frames = apply_options(
        [
            SourceFrame(index, still.path.name, still.path, (still.facts.width, still.facts.height), None)
            for index, still in enumerate(stills)
        ],
        options,
    )
    info: dict[str, Any] = {}
    if options.flash_list is None:
        frames, info["tagging"] = _tagged(frames, stills, factors, balance, warnings)
    info["raw"] = _describe(stills, factors, balance)
    clip = _clip_radiance(stills, factors, balance)
    warnings += _own_warnings(stills)

    first = stills[0].facts
    rotation = Counter(still.facts.rotation_deg for still in stills).most_common(1)[0][0]
    source = describe_source({"kind": "raw", "path": str(folder)}, options, posed=False)
    times_s = _times_s(stills)
    with open_or_create(out, source, first.width, first.height, "linear", rotation) as session:
        session.update_info(
            warnings=warnings,
            device={"camera": first.camera},
            image=session.info["image"] | {"clip_radiance": clip},
            **info,
        )
        present = {record.index for record in session.frames}
        for frame, still, factor, time_s in zip(frames, stills, factors, times_s, strict=True):
            if frame.index not in present:
                picture = _developed(still.path, balance, factor, clip)
                name = session.write_frame(frame.index, picture, ".exr")
                session.append_frame(_record(frame, still.facts, name, time_s))
            if frame.mask is not None:
                copy_mask(frame.mask, frame, session)
            progress("developing RAW files", (frame.index + 1) / len(frames))
        session.finish()
    return session


def _look(file: Path) -> _Still:
    raw = _opened(file)
    small = raw.small()
    size = (min(4 * THUMBNAIL_COLUMNS, small.shape[1]), min(4 * THUMBNAIL_ROWS, small.shape[0]))
    small = np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_AREA), np.float32)
    return _Still(file, raw.facts, small)


def _opened(file: Path) -> RawFile:
    try:
        return RawFile.open(file)
    except ImageError as cause:
        raise SourceError(str(cause)) from cause


def _developed(file: Path, balance: Sequence[float], factor: float, clip: float) -> NDArray[np.float32]:
    """Radiance as it goes into the session: clipped pixels are `clip`, all others are below."""
    try:
        picture = _opened(file).develop(balance)
    except ImageError as cause:
        raise SourceError(str(cause)) from cause
    radiance = np.minimum(picture.radiance * np.float32(factor), np.float32(clip * _HALF_BELOW_ONE))
    radiance[picture.clipped] = clip
    return radiance


def _record(frame: SourceFrame, facts: RawFacts, file: str, time_s: float | None) -> FrameRecord:
    return FrameRecord(
        index=frame.index,
        file=file,
        width=frame.size[0],
        height=frame.size[1],
        pts_s=time_s,
        exposure_s=facts.exposure_s,
        gain=None if facts.iso is None else facts.iso / 100.0,
        flash=frame.flash,
        confidence=frame.confidence,
        reasons=frame.remarks or (() if frame.flash is not None else ("untagged",)),
        source=frame.name,
    )


def _refuse_other(first: _Still, still: _Still) -> None:
    one, other = first.facts, still.facts
    if one.camera != other.camera:
        raise SourceError(
            f"{still.path} is of {other.camera or 'an unnamed camera'}, {first.path.name} of "
            f"{one.camera or 'an unnamed camera'}; leave only the pictures of one capture in the folder."
        )
    if (one.width, one.height, one.cfa) != (other.width, other.height, other.cfa):
        raise SourceError(
            f"{still.path} is {other.width} x {other.height} pixels {other.cfa}, {first.path.name} "
            f"{one.width} x {one.height} {one.cfa}; leave only the pictures of one capture in the folder, "
            "taken with one setting of size and kind."
        )


def _in_order(stills: list[_Still], warnings: list[str]) -> list[_Still]:
    """By the time they were taken, then by name; by name alone where a time is missing."""
    if missing := [still.path.name for still in stills if still.facts.taken is None]:
        warnings.append(f"The order is that of the names: {some(missing)} do not say when they were taken.")
        return stills
    return sorted(stills, key=lambda still: still.facts.taken or datetime.min)  # stable: names decide ties


def _times_s(stills: Sequence[_Still]) -> list[float | None]:
    """Seconds since the first picture; None where a picture does not say when it was taken."""
    first = stills[0].facts.taken
    return [
        None if first is None or still.facts.taken is None else (still.facts.taken - first).total_seconds()
        for still in stills
    ]


def _factors(facts: Sequence[RawFacts], names: Sequence[str], warnings: list[str]) -> list[float]:
    """What each picture's radiance is multiplied by, so that all are as if exposed like most of them."""
    lights = [fact.light for fact in facts]
    known = [light for light in lights if light is not None]
    if unknown := [name for name, light in zip(names, lights, strict=True) if light is None]:
        warnings.append(
            f"{some(unknown)} do not say their exposure and sensitivity; they are taken to be exposed like "
            "the others."
        )
    if not known:
        return [1.0] * len(facts)
    usual = Counter(known).most_common(1)[0][0]
    factors = [
        1.0 if light is None or abs(light / usual - 1) < _SAME_LIGHT else usual / light for light in lights
    ]
    if other := [name for name, factor in zip(names, factors, strict=True) if factor != 1.0]:
        warnings.append(
            f"The exposure changes: the radiance of {some(other)} was multiplied by {min(factors):.3g} to "
            f"{max(factors):.3g} as exposure, sensitivity and aperture in the files say, which is right to a "
            "few percent; lock the exposure in all pictures."
        )
    return factors


def _clip_radiance(stills: Sequence[_Still], factors: Sequence[float], balance: Sequence[float]) -> float:
    """The least power of two that no pixel below the white clip can reach."""
    largest = max(still.facts.largest_gain * factor for still, factor in zip(stills, factors, strict=True))
    return float(2.0 ** max(0, int(np.ceil(np.log2(max(largest * max(balance), 1.0) * (1 - 1e-6))))))


def _tagged(
    frames: Sequence[SourceFrame],
    stills: Sequence[_Still],
    factors: Sequence[float],
    balance: Sequence[float],
    warnings: list[str],
) -> tuple[list[SourceFrame], dict[str, float]]:
    """The frames with the flash that their pictures show, and what session.json says of it."""
    height, width = stills[0].small.shape[:2]
    accumulator = ProfileAccumulator(width, height, transfer="srgb")
    for done, (still, factor) in enumerate(zip(stills, factors, strict=True)):
        accumulator.add(to_display(still.small * (factor * np.array(balance))), float(done))
    tags = tag_stills(accumulator.profiles())
    warnings += tags.warnings
    tagged = [
        replace(frame, flash=tag.flash, confidence=tag.confidence, remarks=tag.reasons)
        for frame, tag in zip(frames, tags.frames, strict=True)
    ]
    return tagged, {"log_gain": tags.log_gain, "separation": tags.separation}


def _describe(stills: Sequence[_Still], factors: Sequence[float], balance: Sequence[float]) -> dict[str, Any]:
    """What session.json says of the development, under "raw"."""
    first = stills[0].facts
    bayer = len(first.cfa) == 4
    return {
        "white_balance": list(balance),
        "white_balance_source": f"as shot, {stills[0].path.name}" if first.white_balance else "none known",
        "camera_from_xyz": None if first.camera_from_xyz is None else list(first.camera_from_xyz),
        "cfa": first.cfa or None,
        "demosaicing": "LibRaw PPG" if bayer else "LibRaw" if first.cfa else None,
        "black": list(first.black),
        "white": list(first.white),
        "opcodes": list(dict.fromkeys(first.applied)),
        "opcodes_left_out": list(dict.fromkeys(first.left_out)),
        "aperture": first.aperture,
        "focal_length_mm": first.focal_length_mm,
        "radiance_factors": None if set(factors) == {1.0} else list(factors),
    }


def _own_warnings(stills: Sequence[_Still]) -> list[str]:
    """The files' own warnings, each once, and what is said of turned cameras."""
    sentences = list(dict.fromkeys(sentence for still in stills for sentence in still.facts.warnings))
    if len({still.facts.rotation_deg for still in stills}) > 1:
        sentences.append(
            "The camera was turned between pictures; they are shown upright as most of them are, and their "
            "pixels are as the sensor has them."
        )
    return sentences
