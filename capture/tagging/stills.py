"""Which of a series of stills the flash lit: jumps of light against the neighbours, in linear light.

Stills have no rows' times and no rhythm: every fifth may be lit, or pairs, or any. Between neighbours the
hand has moved a little and the room's level drifts, but a flash that goes on or off moves the light by the
same amount every time, and the near head by more than the far background. So a picture is three numbers, the
log light of a centre disc, of the ring around it and of the corners, and

    f_k = b_k + s_k g + noise,      s_k in {0, 1},

with a level b that is unknown but the same, up to a drift, in pictures that are few apart. The labels are
found exactly over all pairs up to `_REACH` apart: a hidden Markov model whose state is the last labels. Gain
and noise are found in turn with them, and the three numbers are weighed as Fisher's discriminant does, which
makes the split blind to exposure where exposure wanders and lets it use the level where it is steady.

No label is given in doubt: a wrong 1 or 0 costs the fit more than a picture that is left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from capture.errors import TaggingError
from capture.tagging.config import TaggingConfig
from capture.tagging.profiles import FrameProfiles
from capture.tagging.result import FrameTag

Floats = NDArray[np.float64]
Labels = NDArray[np.bool_]

_LEAST_STILLS = 8
_REACH = 4  # pictures: further apart the hand has moved too far for a comparison
# Radii of the centre disc and of the corners, 1 = half the picture's sides.
_DISC, _CORNERS = 0.5, 1.0
# Gains tried first, in log light: from half of what is credible to more than any phone's lamp gives.
_FIRST_GAINS = np.geomspace(0.03, 3.2, 16)
_FIRST_WEIGHTS = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, -1.0], [1.0, -0.5, -0.5]])
_FIRST_SPREAD = 1 / 6  # of the noise, in gains
_ROUNDS, _STARTS = 12, 4
_TAIL = 3.0  # degrees of freedom of the residuals (Student)
_SHRINKAGE = 0.3  # of the noise's covariance towards its diagonal: few pictures know it badly
# The flash's gain changes with where it comes from; from picture to picture by about so much of itself.
_GAIN_SPREAD = 0.12
_LEAST_SPREAD = 0.01  # of the noise, in gains; steadier than that is chance
# Scores up to the first are unlit, from the second on lit; between them lit in part, or not known.
_UNLIT, _LIT = 0.25, 0.65
# A third of the rows of a lit picture with less than this share of the usual gain, or of an unlit one with
# more, is not lit as the rest is.
_THIRD = 0.45
_CLEAR = 5.0  # spreads of the noise above which the gain of a third says something
_LEAST_LOG_GAIN = 0.03
_LEAST_CHANGES = 3  # from lit to unlit or back: one or two may be the room's lamp or the sun
_NEAR_OVER_FAR = 1.2  # the centre's log gain over the corners': light that is everywhere is no flash
_NEARLY_WHITE = 0.4  # mean radiance of the lit centre, of which a good part is then clipped
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
    light = np.stack([profiles.linear(int(k)) for k in seen]).astype(np.float64)
    model = _fit(_region_levels(light))
    if model is None:
        raise TaggingError(
            f"No flash that goes on and off can be told from the light of the {len(seen)} pictures: it lit "
            "all of them or none, or it is too weak for the room; name the lit ones in a flash list, or "
            "take pictures of both kinds in turn."
        )
    if model.separation < config.min_separation:
        raise TaggingError(
            f"The pictures do not fall into lit and unlit ones (separation {model.separation:.1f}, at least "
            f"{config.min_separation:g} needed; gain {100 * np.expm1(model.gain[0]):.0f} %): the flash lit "
            "all of them or none, or it is too weak for the room; name the lit ones in a flash list."
        )
    tags = _tags(profiles, seen, model, _is_patchy(light, model.lit), config)
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
        level: [K] the discriminant, in gains: a flash adds 1.
        gain: [3] log gain of disc, ring and corners.
        spread: [_REACH] of the level between pictures of one kind, by their distance.
        separation: the gain in spreads of the noise between neighbours, tails counted.
        lit_radiance: of the disc in a typical lit picture.
    """

    lit: Labels
    level: Floats
    gain: Floats
    spread: Floats
    separation: float
    lit_radiance: float


def _region_levels(light: Floats) -> Floats:
    """[K, 3] log mean light of centre disc, ring and corners."""
    rows, columns = light.shape[1:]
    y = ((np.arange(rows) + 0.5) / rows * 2 - 1)[:, None]
    x = ((np.arange(columns) + 0.5) / columns * 2 - 1)[None, :]
    radius = np.hypot(x, y)
    regions = (radius < _DISC, (radius >= _DISC) & (radius < _CORNERS), radius >= _CORNERS)
    return np.log(np.stack([light[:, region].mean(axis=1) for region in regions], axis=1))


def _fit(features: Floats) -> _Model | None:
    """The best credible model over several first guesses; None = there is none."""
    found: dict[bytes, _Model] = {}
    for weight in _FIRST_WEIGHTS:
        level = features @ weight
        for gain in _FIRST_GAINS:
            lit = _labels(level / gain, np.full(_REACH, _FIRST_SPREAD))
            if lit.tobytes() not in found and (model := _learn(features, lit)) is not None:
                found[lit.tobytes()] = model
    starts = sorted(filter(_credible, found.values()), key=lambda model: -model.separation)
    models = [_settled(features, start) for start in starts[:_STARTS]]
    return max(filter(_credible, models), key=lambda model: model.separation, default=None)


def _settled(features: Floats, model: _Model) -> _Model:
    """Labels and model found in turn until the labels stay."""
    for _ in range(_ROUNDS):
        lit = _labels(model.level, model.spread)
        if np.array_equal(lit, model.lit) or (again := _learn(features, lit)) is None:
            break
        model = again
    return model


def _credible(model: _Model) -> bool:
    """Whether the pictures change as a flash changes them: often enough, and the near more than the far.

    Where the middle of the lit pictures is nearly white its gain is cut off, and is not compared.
    """
    changes = np.count_nonzero(np.diff(model.lit.astype(int)))
    near, far = model.gain[0], model.gain[-1]
    nearer = near > _NEAR_OVER_FAR * far or model.lit_radiance > _NEARLY_WHITE
    return bool(changes >= _LEAST_CHANGES and near > _LEAST_LOG_GAIN and nearer)


def _learn(features: Floats, lit: Labels) -> _Model | None:
    """Gain, discriminant and noise of labels; None where the two kinds are never near each other."""
    rises, stays = [], []
    for apart in range(1, _REACH + 1):
        step, change = features[apart:] - features[:-apart], lit[apart:].astype(int) - lit[:-apart]
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
        level=features @ weight,
        gain=gain,
        spread=np.maximum(np.where(np.isnan(spread), usual, spread), _LEAST_SPREAD),
        separation=float(np.sqrt(2.0) / max(worst, 1e-6)),
        lit_radiance=float(np.exp(np.median(features[lit, 0]))),
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


def _pair_costs(level: Floats, spread: Floats) -> Floats:
    """[K, _REACH, 2, 2] cost of the labels (earlier, later) of each picture and the one so many before it.

    The pairs of a picture are not independent; each counts for one part in `_REACH`.
    """
    cost = np.zeros((len(level), _REACH, 2, 2))
    for apart in range(1, min(_REACH, len(level) - 1) + 1):
        step = level[apart:] - level[:-apart]
        for earlier in (0, 1):
            for later in (0, 1):
                variance = spread[apart - 1] ** 2 + _GAIN_SPREAD**2 * max(earlier, later)
                square = (step - (later - earlier)) ** 2 / variance
                student = 0.5 * (_TAIL + 1) * np.log1p(square / _TAIL) + 0.5 * np.log(variance)
                cost[apart:, apart - 1, earlier, later] = student / _REACH
    return cost


def _state_costs(level: Floats, spread: Floats) -> Floats:
    """[K, S] cost of each picture in each state; a state's bit m is the label of the picture m before."""
    pairs = _pair_costs(level, spread)
    states = np.arange(2 ** (_REACH + 1))
    label = (states[:, None] >> np.arange(_REACH + 1)) & 1
    total = np.zeros((len(level), len(states)))
    for apart in range(1, _REACH + 1):
        total += pairs[:, apart - 1][:, label[:, apart], label[:, 0]]
    return total


def _labels(level: Floats, spread: Floats) -> Labels:
    """[K] the labels of least cost (Viterbi 1967)."""
    costs = _state_costs(level, spread)
    count = costs.shape[1]
    before = np.arange(count) >> 1  # the state one picture earlier, but for its oldest label
    oldest = count // 2
    best, choice = costs[0], np.zeros(costs.shape, bool)
    for k in range(1, len(costs)):
        either = np.stack([best[before], best[before + oldest]])
        choice[k] = either[1] < either[0]
        best = either.min(axis=0) + costs[k]
    state = int(np.argmin(best))
    lit = np.zeros(len(costs), bool)
    for k in range(len(costs) - 1, -1, -1):
        lit[k] = state & 1
        state = (state >> 1) + (oldest if choice[k, state] else 0)
    return lit


def _posterior(model: _Model) -> Floats:
    """[K] probability that each picture is lit (forward and backward, Rabiner 1989)."""
    costs = _state_costs(model.level, model.spread)
    count = costs.shape[1]
    before, oldest = np.arange(count) >> 1, count // 2
    forward, backward = np.zeros(costs.shape), np.zeros(costs.shape)
    forward[0] = -costs[0]
    for k in range(1, len(costs)):
        reached = np.logaddexp(forward[k - 1][before], forward[k - 1][before + oldest]) - costs[k]
        forward[k] = reached - reached.max()
    after = (np.arange(count) << 1) & (count - 1)  # the states one picture later
    for k in range(len(costs) - 2, -1, -1):
        arriving = backward[k + 1] - costs[k + 1]
        reached = np.logaddexp(arriving[after], arriving[after + 1])
        backward[k] = reached - reached.max()
    total = forward + backward
    total = np.exp(total - total.max(axis=1, keepdims=True))
    odd = (np.arange(count) & 1).astype(bool)
    return np.asarray(total[:, odd].sum(axis=1) / total.sum(axis=1))


def _scores(model: _Model) -> Floats:
    """[K] each picture's level over what its neighbours would be unlit: 0 = unlit, 1 = lit.

    Between neighbours on both sides a straight drift cancels.
    """
    reduced = model.level - model.lit
    return np.asarray(model.level - _around(reduced, model.spread))


def _around(values: Floats, spread: Floats) -> Floats:
    """[K, ...] weighted mean of the values up to `_REACH` pictures before and after each."""
    total = np.zeros_like(values)
    weights = np.zeros(len(values))
    for apart in range(1, min(_REACH, len(values) - 1) + 1):
        weight = 1.0 / spread[apart - 1] ** 2
        for target, other in (
            (slice(apart, None), slice(None, -apart)),
            (slice(None, -apart), slice(apart, None)),
        ):
            total[target] += weight * values[other]
            weights[target] += weight
    return np.asarray(total / weights.reshape(-1, *[1] * (values.ndim - 1)))


def _is_patchy(light: Floats, lit: Labels) -> Labels:
    """[K] whether a third of the rows, in the middle columns, is not lit as the rest is.

    So a rolling shutter shows a pulse that began or ended while its rows were read.
    """
    columns = light.shape[2]
    middle = light[:, :, columns // 4 : columns - columns // 4]
    thirds = np.log(np.stack([part.mean(axis=(1, 2)) for part in np.array_split(middle, 3, axis=1)], axis=1))
    gain, rise = np.zeros(3), thirds
    for _ in range(3):  # the gain of the thirds and the level around each picture, in turn
        rise = thirds - _around(thirds - lit[:, None] * gain, np.ones(_REACH))
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
    for k, score, posterior, part in zip(seen, _scores(model), _posterior(model), patchy, strict=True):
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
