"""The photometric solve of captures that go wrong.

The error is against the subject's formulas, in float64: of the product albedo times C_flash, which no choice
of scale enters, the median relative error over the points that the flash observed well. Where the normals err
by more than three degrees in the median, their angle in units of ten degrees is the error, so that no case
passes with a right albedo and wrong normals.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from capture.ply import PointCloud, write_ply
from capture.session import FrameRecord, Session
from relight.cloud import CloudConfig
from relight.errors import PlanError
from relight.photometric import SolveConfig, solve
from relight.portrait import Portrait
from relight.scene import Scene, load_scene
from relight.shape_from_flash import ShapeConfig
from relight.stress import captures
from relight.stress.captures import film
from relight.stress.case import Case, Measured, Stage, at_most
from relight.stress.subject import SUBJECT, Subject, arc, normals_at

SOLVE = Stage(
    "solve",
    (torch.float32,),
    "frames and portraits are float32 by contract; normal equations are solved in float64",
)

# All of the solve but the mirror, which has a case of its own.
_CONFIG = SolveConfig(cloud=CloudConfig(max_points=1000), shape=ShapeConfig(), mirror=False)
_KNOWN = 0.6  # confidence of points that the flash observed well
_USUAL = 0.05  # a thousand points of a head are 13 mm apart, and a wave of its albedo is 140 mm long
_TOLERABLE_DEG = 3.0
_BROKEN = (np.nan, np.inf, -np.inf)


def cases() -> Iterator[Case]:
    """All cases of this module."""
    for stressed, subject in _LIGHTS.items():
        yield _solved(stressed, partial(film, subject), subject)
    for exponent in (3, 6):
        brighter = _times(10.0**exponent)
        # Without a clip, as of float pictures: the subject is the same, the unit of light another.
        yield _solved(f"light times 1e{exponent:+d}", partial(film, brighter, clip=np.inf), brighter)
    # What is left of a bright pixel at the edge of the clip is the darker part of it.
    clipped = Subject(flash=0.4)
    yield _solved("flash that clips what is bright and faces it", partial(film, clipped), clipped, 0.1)
    for stressed, scene in _GONE_WRONG.items():
        yield _solved(stressed, scene)
    yield Case(SOLVE, "NaN and Inf pixels in files", lambda _: _solved_from_files(), at_most(_USUAL))
    yield _solved("the shape as the cloud has it", film, config=replace(_CONFIG, shape=None))
    one_side = partial(film, cameras=arc(10)[:5])
    mirrored = replace(_CONFIG, mirror=True)
    yield _solved("lit from one side only, mirrored", one_side, config=mirrored)
    for stressed, scene in _REFUSED.items():
        yield _refused(stressed, scene)
    for exponent in (-6, -3):
        too_dark = f"light times 1e{exponent:+d}: the flash adds less than a code of eight bits"
        yield _refused(too_dark, partial(film, _times(10.0**exponent)))


def _times(gain: float) -> Subject:
    return Subject(room=0.25 * gain, flash=0.11 * gain)


_LIGHTS = {
    "usual capture": SUBJECT,
    "black jacket: albedo 0 below the chin": Subject(jacket=0.0),
    "jacket of albedo 5e-5": Subject(jacket=1e-4),
    "flash ten times the room": Subject(room=0.05, flash=0.11),
    "flash a tenth of the room": Subject(room=0.5, flash=0.0125),
    "dark room": Subject(room=0.0),
    "flash of a wide beam": Subject(beam=1.0),
    "flash of a beam of 15 degrees": Subject(beam=80.0),
}

_GONE_WRONG: dict[str, Callable[[], Scene]] = {
    "every frame twice": captures.filmed_twice,
    "one frame with and one without the flash": partial(film, cameras=arc(10)[4:6]),
    "NaN, Inf and 1e38 in every frame": partial(captures.with_broken_pixels, (*_BROKEN, 1e38)),
    "hot pixels of 1e4 that no clip takes out": partial(captures.with_broken_pixels, (1e4,), 3, np.inf),
    "one frame all NaN": captures.with_broken_frame,
    "noise that is known": partial(captures.with_known_noise, 0.002, 1e-4),
    "noise that is known, NaN and Inf in every frame": partial(
        captures.with_known_noise, 0.002, 1e-4, _BROKEN
    ),
    "noise of zero": partial(captures.with_known_noise, 0.0, 0.0),
    "noise of 1e3": partial(captures.with_known_noise, 1e3, 1e3),
    "cloud with NaN, Inf, copies, points at and behind the cameras": captures.with_hostile_cloud,
    "cloud with zero and NaN normals": captures.with_hostile_normals,
    "a camera a millimetre from the surface": captures.from_the_skin,
    "a camera that looks away": captures.looking_away,
}

_REFUSED: dict[str, Callable[[], Scene]] = {
    "all black": partial(film, Subject(albedo=0.0)),
    "flash that clips every pixel": partial(film, Subject(flash=1000.0)),
    "room that clips every pixel": partial(film, Subject(room=1000.0)),
    "constant images": partial(captures.of_constant_images, 0.25),
    "every pixel NaN": partial(captures.of_constant_images, np.nan),
    "empty masks": captures.with_empty_masks,
    "one frame": partial(film, cameras=arc(10)[5:6]),
    "no frame with the flash": partial(film, cameras=arc(10)[::2]),
    "one point": partial(film, cloud=1),
    "cloud behind all cameras": captures.behind_the_cameras,
    "cloud of NaN": captures.with_cloud_of_nan,
}


def _solved(
    stressed: str,
    scene: Callable[[], Scene],
    subject: Subject = SUBJECT,
    error: float = _USUAL,
    config: SolveConfig = _CONFIG,
) -> Case:
    return Case(SOLVE, stressed, lambda _: _measured(solve(scene(), config), subject), at_most(error))


def _refused(stressed: str, scene: Callable[[], Scene]) -> Case:
    return Case(SOLVE, stressed, lambda _: _measured(solve(scene(), _CONFIG), SUBJECT), refused=PlanError)


def _measured(portrait: Portrait, subject: Subject) -> Measured:
    values = {name: value for name, value in vars(portrait).items() if isinstance(value, torch.Tensor)}
    values["c_flash"], values["c_room"] = torch.tensor(portrait.c_flash), torch.tensor(portrait.c_room)
    points = portrait.points.double().numpy()
    truth = subject.flash * subject.albedo_at(points)
    known = (portrait.confidence.numpy() > _KNOWN) & (truth.min(axis=1) > 0.05 * truth.max())
    if not known.any():
        return Measured(values, error=float("nan"))
    product = portrait.albedo.double().numpy() * np.asarray(portrait.c_flash)
    colour = float(np.median(np.abs(product[known] / truth[known] - 1.0)))
    cosine = (portrait.normals_world.double().numpy() * normals_at(points)).sum(axis=1)[known]
    angle_deg = float(np.degrees(np.arccos(np.median(cosine.clip(-1.0, 1.0)))))
    return Measured(values, error=max(colour, angle_deg / 10.0 if angle_deg > _TOLERABLE_DEG else 0.0))


def _solved_from_files() -> Measured:
    """Frames as EXR pictures of a session, so that its own reading decides what is no measurement."""
    scene = captures.with_broken_pixels(_BROKEN)
    first = scene.views[0].camera
    width, height = first.width, first.height
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session"
        with Session.create(
            path, source={"kind": "formulas"}, width=width, height=height, transfer="linear"
        ) as session:
            for view in scene.views:
                file = session.write_frame(view.index, scene.radiances[view.index], ".exr")
                session.append_frame(
                    FrameRecord(index=view.index, file=file, width=width, height=height, flash=view.flash)
                )
            session.save_scene_cameras({view.index: view.camera for view in scene.views})
            write_ply(session.points_path, PointCloud(scene.points.numpy()))
        read = load_scene(Session.open(path), frames=[view.index for view in scene.views])
        read.flash_offset_cam_m = scene.flash_offset_cam_m
        return _measured(solve(read, _CONFIG), SUBJECT)
