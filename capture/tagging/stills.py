"""Which of a series of stills the flash lit: jumps of light against the neighbours, in linear light.

Stills have no rows' times and no rhythm: every fifth may be lit, or pairs, or any. Between neighbours the
hand has moved and the room's level drifts, but a flash that goes on or off moves the light by the same amount
every time, and the near head by more than the far background. So the step of light from one picture to the
next is three numbers, of a centre disc, of the ring around it and of the corners (`still_steps`), and

    f_k - f_j = (s_k - s_j) g + noise,      s in {0, 1},    |k - j| <= REACH.

The labels s are found exactly over all these pairs (`still_labels`). Gain and noise are found in turn with
them, and the three numbers are weighed as Fisher's discriminant does, which makes the split blind to exposure
where exposure wanders and lets it use the level where it is steady.

No label is given in doubt: a wrong 1 or 0 costs the fit more than a picture that is left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from capture.errors import TaggingError
from capture.tagging.config import TaggingConfig
from capture.tagging.profiles import FrameProfiles
from capture.tagging.result import FrameTag
from capture.tagging.still_labels import Floats, Labels, Steps, likeliest_labels, lit_probability
from capture.tagging.still_steps import LIGHT_REGIONS, REACH, THIRDS, disc_radiance, light_steps

_LEAST_STILLS = 8
# Gains tried first, in log light: from half of what is credible to more than any phone's lamp gives.
_FIRST_GAINS = np.geomspace(0.03, 3.2, 16)
_FIRST_WEIGHTS = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, -1.0], [1.0, -0.5, -0.5]])
_DARKEST_OF = 4  # pictures before and after
_FIRST_SPREAD = 1 / 6  # of the noise, in gains
_ROUNDS, _STARTS = 12, 4
_SHRINKAGE = 0.3  # of the noise's covariance towards its diagonal: few pictures know it badly
_LEAST_SPREAD = 0.01  # of the noise, in gains; steadier than that is chance
# Scores up to the first are unlit, from the second on lit; between them lit in part, or not known.
_UNLIT, _LIT = 0.25, 0.65
# A third of the rows of a lit picture with less than this share of the usual gain, or of an unlit one with
# more, is not lit as the rest is.
_THIRD = 0.45
_CLEAR = 5.0  # spreads of the noise above which the gain of a third says something
_LEAST_LOG_GAIN = 0.03
_LEAST_CHANGES = 3  # from lit to unlit or back: one or two may be the room's lamp or the sun
_NEAR_OVER_FAR = 1.4  # the centre's log gain over the corners': light that is everywhere is no flash
_NEARLY_WHITE = 0.4  # mean radiance of the lit centre, of which a good part is then clipped
_STRONG = 0.7  # log gain: the flash doubles the light
_MOST_DARKENED = 0.25  # of the centre's gain, by which noise may make the corners darker
# Stills need more than a video: where one step is missed a whole run of pictures is mistaken.
_STRICTER = 2.0
_RISK = 0.01  # of a label
_MOST_UNKNOWN = 0.25  # share of the pictures: where more are in doubt, all are


@dataclass(frozen=True, eq=False)
class StillTags:
    """The flash over a series of stills.

    Attributes:
        frames: one tag for each picture.
        log_gain: of the flash in the middle of the picture.
        separation: the gain in spreads of the noise between neighbours.
        warnings: sentences for the user.
    """

    frames: tuple[FrameTag, ...]
    log_gain: float
    separation: float
    warnings: tuple[str, ...]


def tag_stills(profiles: FrameProfiles, config: TaggingConfig | None = None) -> StillTags:
    """Tags stills in the order in which they were taken; their times are not used.

    Args:
        profiles: of the pictures.
        config: its limits of separation and clipping are used.

    Raises:
        TaggingError: too few, all lit or none, or no two kinds that a flash would make.
    """
    config = config or TaggingConfig()
    seen = np.flatnonzero(profiles.readable)
    if len(seen) < _LEAST_STILLS:
        raise TaggingError(
            f"The flash of {len(seen)} picture{'s' * (len(seen) != 1)} cannot be told: at least "
            f"{_LEAST_STILLS} are needed, lit and unlit ones; name the lit ones in a flash list."
        )
    light = np.stack([profiles.linear(int(k)) for k in seen])
    steps = light_steps(light)
    model = _fit([step[:, LIGHT_REGIONS] for step in steps], disc_radiance(light))
    if model is None:
        raise TaggingError(
            f"No flash that goes on and off can be told from the light of the {len(seen)} pictures: it lit "
            "all of them or none, or it is too weak for the room; name the lit ones in a flash list, or "
            "take pictures of both kinds in turn."
        )
    least = _STRICTER * config.min_separation
    if model.separation < least:
        raise TaggingError(
            f"The pictures do not fall into lit and unlit ones (separation {model.separation:.1f}, at least "
            f"{least:g} needed; gain {100 * np.expm1(model.gain[0]):.0f} %): the flash lit "
            "all of them or none, or it is too weak for the room; name the lit ones in a flash list."
        )
    tags = _tags(profiles, seen, model, _is_patchy(steps, model.lit), config)
    unknown = sum(tag.flash is None for tag in tags)
    if unknown > _MOST_UNKNOWN * len(tags) or {0, 1} - {tag.flash for tag in tags}:
        raise TaggingError(
            f"The flash of {unknown} of {len(tags)} pictures cannot be told (gain "
            f"{100 * np.expm1(model.gain[0]):.0f} % in the middle): it is too weak for the room, or the "
            "exposure changes from picture to picture; name the lit ones in a flash list."
        )
    warnings: tuple[str, ...] = ()
    if unknown:
        warnings = (
            f"The flash of {unknown} of {len(tags)} pictures could not be told; they are left out unless a "
            "flash list says it.",
        )
    return StillTags(tags, float(model.gain[0]), model.separation, warnings)


@dataclass(frozen=True, eq=False)
class _Model:
    """Labels, and what was learnt with them.

    Attributes:
        lit: [K] bool.
        steps: for each distance m, [K - m] the discriminant's, in gains: a flash adds 1.
        gain: [3] log gain of disc, ring and corners.
        spread: [REACH] of the steps between pictures of one kind, by their distance.
        separation: the gain in spreads of the noise between neighbours, tails counted.
        lit_radiance: of the disc in a typical lit picture.
    """

    lit: Labels
    steps: Steps
    gain: Floats
    spread: Floats
    separation: float
    lit_radiance: float


def _fit(steps: Steps, radiance: Floats) -> _Model | None:
    """The best credible model over several first guesses; None = there is none.

    Args:
        steps: for each distance m, [K - m, 3].
        radiance: [K] of the disc.
    """
    found: dict[bytes, _Model] = {}
    for weight in _FIRST_WEIGHTS:
        for gain in _FIRST_GAINS:
            even = _evened(steps, radiance, float(gain))
            lit = likeliest_labels([step @ weight / gain for step in even], np.full(REACH, _FIRST_SPREAD))
            if lit.tobytes() not in found and (model := _learn(even, radiance, lit)) is not None:
                found[lit.tobytes()] = model
    starts = sorted(filter(_credible, found.values()), key=lambda model: -model.separation)
    models = [_settled(steps, radiance, start) for start in starts[:_STARTS]]
    return max(filter(_credible, models), key=lambda model: model.separation, default=None)


def _evened(steps: Steps, radiance: Floats, gain: float) -> list[Floats]:
    """The steps as if the room lit the head equally from everywhere.

    The flash goes with the camera and adds about the same light c to each picture; the room's light r on what
    the camera sees may be a third of it on the dark side of the head, where a gain log(1 + c / r) is larger.
    The darkest of some pictures in a row is taken to be unlit.
    """
    room = ndimage.minimum_filter1d(np.maximum(radiance, 1e-4), 2 * _DARKEST_OF + 1, mode="nearest")
    room = ndimage.uniform_filter1d(room, 2 * _DARKEST_OF + 1, mode="nearest")
    usual = float(np.median(room))
    share = np.log1p(np.expm1(max(gain, 1e-3)) * usual / room) / max(gain, 1e-3)
    return [
        step / np.sqrt(share[apart:] * share[:-apart])[:, None] for apart, step in enumerate(steps, start=1)
    ]


def _settled(steps: Steps, radiance: Floats, model: _Model) -> _Model:
    """Labels and model found in turn until the labels stay."""
    for _ in range(_ROUNDS):
        lit = likeliest_labels(model.steps, model.spread)
        even = _evened(steps, radiance, float(model.gain[0]))
        if np.array_equal(lit, model.lit) or (again := _learn(even, radiance, lit)) is None:
            break
        model = again
    return model


def _credible(model: _Model) -> bool:
    """Whether the pictures change as by a flash: often enough, and the near more than the far.

    A flash darkens nothing. Where a strong one makes the middle nearly white its gain is cut off, and is not
    compared with that of the corners.
    """
    changes = np.count_nonzero(np.diff(model.lit.astype(int)))
    near, far = model.gain[0], model.gain[-1]
    cut_off = model.lit_radiance > _NEARLY_WHITE and near > _STRONG
    nearer = near > _NEAR_OVER_FAR * far or cut_off
    return bool(
        changes >= _LEAST_CHANGES and near > _LEAST_LOG_GAIN and nearer and far > -_MOST_DARKENED * near
    )


def _learn(steps: Steps, radiance: Floats, lit: Labels) -> _Model | None:
    """Gain, discriminant and noise of labels; None where the two kinds are never near each other."""
    rises, stays = [], []
    for apart, step in enumerate(steps, start=1):
        change = lit[apart:].astype(int) - lit[:-apart]
        rises.append(step[change != 0] * change[change != 0, None])
        stays.append(step[change == 0])
    risen, near = np.concatenate(rises), np.concatenate(stays[:2])
    if len(risen) < 2 or len(near) < 4:
        return None
    gain = np.median(risen, axis=0)
    weight = np.linalg.solve(_robust_covariance(near), gain)
    power = float(gain @ weight)
    if not power > 0:
        return None
    weight /= power
    spread = np.array([_spread(step @ weight) for step in stays])
    usual = float(np.nanmin(spread))  # where lit and unlit pictures alternate, no neighbours are of one kind
    # 2.17 = normal quantile of 98.5 %: the largest 3 % on both sides, for motion has heavy tails
    worst = max(usual, float(np.quantile(np.abs(near @ weight), 0.97)) / 2.17)
    return _Model(
        lit=lit,
        steps=tuple(step @ weight for step in steps),
        gain=gain,
        spread=np.maximum(np.where(np.isnan(spread), usual, spread), _LEAST_SPREAD),
        separation=float(np.sqrt(2.0) / max(worst, 1e-6)),
        lit_radiance=float(np.median(radiance[lit])),
    )


def _robust_covariance(steps: Floats) -> Floats:
    """[3, 3] covariance of steps about zero, outliers cut at three spreads, never singular."""
    usual = np.array([_spread(column) for column in steps.T])
    cut = np.clip(steps, -3 * usual, 3 * usual)
    floor = 1e-3  # log light: what 8-bit codes leave of a mean
    covariance = cut.T @ cut / len(cut)
    alone = np.diag(np.diag(covariance))
    return np.asarray((1 - _SHRINKAGE) * covariance + _SHRINKAGE * alone + np.eye(len(alone)) * floor**2)


def _spread(values: Floats) -> float:
    """Robust standard deviation about zero (1.4826 = normal quantile of 75 %)."""
    return float(1.4826 * np.median(np.abs(values))) if len(values) else np.nan


def _scores(model: _Model) -> Floats:
    """[K] each picture's light over what it would be unlit, in gains: 0 = unlit, 1 = lit.

    Between neighbours on both sides a straight drift cancels.
    """
    return _over_unlit(model.steps, model.lit.astype(float), model.spread)


def _over_unlit(steps: Steps, offset: Floats, spread: Floats) -> Floats:
    """[K, ...] weighted mean over the neighbours of the step from them, and what they are over unlit.

    Args:
        steps: for each distance m, [K - m, ...].
        offset: [K, ...] what each picture is over unlit.
        spread: [REACH] of the steps.
    """
    total = np.zeros_like(offset)
    weights = np.zeros(len(offset))
    for apart, step in enumerate(steps, start=1):
        weight = 1.0 / spread[apart - 1] ** 2
        total[apart:] += weight * (step + offset[:-apart])
        total[:-apart] += weight * (offset[apart:] - step)
        weights[apart:] += weight
        weights[:-apart] += weight
    return np.asarray(total / weights.reshape(-1, *[1] * (offset.ndim - 1)))


def _is_patchy(steps: Steps, lit: Labels) -> Labels:
    """[K] whether a third of the rows, in the middle columns, is not lit as the rest is.

    So a rolling shutter shows a pulse that began or ended while its rows were read.
    """
    thirds = [step[:, THIRDS] for step in steps]
    gain, rise = np.zeros(3), np.zeros((len(lit), 3))
    for _ in range(3):  # the gain of the thirds and the level around each picture, in turn
        rise = _over_unlit(thirds, lit[:, None] * gain, np.ones(len(steps)))
        gain = np.median(rise[lit], axis=0)
    clear = gain > _CLEAR * np.array([_spread(column) for column in rise[~lit].T])
    share = rise / np.maximum(gain, 1e-6)
    wrong = np.where(lit[:, None], share < _THIRD, share > _THIRD)
    return np.asarray((wrong & clear).any(axis=1))


def _tags(
    profiles: FrameProfiles, seen: NDArray[np.int_], model: _Model, patchy: Labels, config: TaggingConfig
) -> tuple[FrameTag, ...]:
    """Tags of all pictures, with what is to be said besides the flash."""
    tags = [FrameTag(None, None, 0.0, ("unreadable",))] * len(profiles)
    clipped = profiles.clipped()
    probability = lit_probability(model.steps, model.spread)
    for k, score, posterior, part in zip(seen, _scores(model), probability, patchy, strict=True):
        tag = _tag(float(score), float(posterior), bool(part))
        remarks = ["clipped"] if clipped[k] > config.clipped_share else []
        remarks += ["clipped_frame"] if clipped[k] > config.hopeless_share else []
        tags[k] = replace(tag, reasons=(*tag.reasons, *remarks))
    return tuple(tags)


def _tag(score: float, posterior: float, patchy: bool) -> FrameTag:
    """The tag of a picture; in doubt none."""
    confidence = max(posterior, 1.0 - posterior)
    if _UNLIT < score < _LIT or patchy:
        return FrameTag(None, min(max(score, 0.0), 1.0), confidence, ("partial_flash",))
    if confidence < 1 - _RISK or (score >= _LIT) != (posterior > 0.5):
        return FrameTag(None, None, confidence, ("flash_uncertain",))
    lit = int(posterior > 0.5)
    return FrameTag(lit, float(lit), confidence, ())
