"""Who sits in the rig: proportions, skin, hair and eyes, drawn from a seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

HAIR_STYLES = ("short", "swept", "bob", "bald")

# Linear reflectances, from measured ranges: skin from very light to dark, hair from black to blond, iris
# colours.
_SKIN_TONES = (
    (0.50, 0.335, 0.25),
    (0.45, 0.30, 0.22),
    (0.36, 0.22, 0.145),
    (0.24, 0.135, 0.085),
    (0.13, 0.07, 0.045),
)
_HAIR_COLOURS = (
    (0.016, 0.012, 0.010),
    (0.045, 0.024, 0.013),
    (0.11, 0.055, 0.026),
    (0.26, 0.16, 0.075),
    (0.20, 0.055, 0.02),
)
_IRIS_COLOURS = ((0.10, 0.045, 0.02), (0.06, 0.12, 0.05), (0.045, 0.085, 0.13), (0.16, 0.09, 0.03))


@dataclass(frozen=True)
class Subject:
    """A person. Sizes are factors on an average adult head, colours linear reflectances.

    Attributes:
        seed: of everything random on the body: freckles, strands, asymmetry.
        head_width: width of skull and face.
        jaw_width: width of the lower face.
        nose_length: how far the nose stands out.
        nose_width: width of tip and wings.
        lip_fullness: thickness of the lips.
        brow: height of the brow ridge.
        chin: how far the chin stands out.
        neck_width: girth of the neck.
        ear_size: size of the ears.
        skin: [3] base reflectance of the skin.
        freckles: number of freckles on the face.
        stubble: 0 (none) .. 1 (dark shadow of a beard).
        gloss: factor on the skin's gloss; about 2 is oily skin under a lamp.
        hair_style: one of `HAIR_STYLES`.
        hair: [3] reflectance of the hair.
        iris: [3] reflectance of the iris.
        shirt: [3] reflectance of the shirt.
    """

    seed: int = 0
    head_width: float = 1.0
    jaw_width: float = 1.0
    nose_length: float = 1.0
    nose_width: float = 1.0
    lip_fullness: float = 1.0
    brow: float = 1.0
    chin: float = 1.0
    neck_width: float = 1.0
    ear_size: float = 1.0
    skin: tuple[float, float, float] = _SKIN_TONES[1]
    freckles: int = 160
    stubble: float = 0.25
    gloss: float = 1.0
    hair_style: str = "short"
    hair: tuple[float, float, float] = _HAIR_COLOURS[1]
    iris: tuple[float, float, float] = _IRIS_COLOURS[2]
    shirt: tuple[float, float, float] = (0.10, 0.17, 0.24)

    def __post_init__(self) -> None:
        if self.hair_style not in HAIR_STYLES:
            raise ValueError(
                f"hair_style {self.hair_style!r} is unknown; choose one of {', '.join(HAIR_STYLES)}"
            )

    @classmethod
    def from_seed(cls, seed: int) -> Subject:
        """The person of a seed; seed 0 is the default one."""
        if seed == 0:
            return cls()
        rng = np.random.default_rng(seed)

        def factor(spread: float) -> float:
            return float(np.clip(rng.normal(1.0, spread), 1.0 - 2 * spread, 1.0 + 2 * spread))

        def colour(choices: tuple[tuple[float, float, float], ...]) -> tuple[float, float, float]:
            picked = np.array(choices[rng.integers(len(choices))]) * rng.uniform(0.9, 1.1)
            return (float(picked[0]), float(picked[1]), float(picked[2]))

        shirt = rng.uniform(0.05, 0.4) * rng.uniform(0.6, 1.4, 3)
        skin = colour(_SKIN_TONES)
        # Fair and red hair come with light skin.
        hair_choices = _HAIR_COLOURS if skin[0] > 0.4 else _HAIR_COLOURS[:2]
        return cls(
            seed=seed,
            head_width=factor(0.03),
            jaw_width=factor(0.06),
            nose_length=factor(0.08),
            nose_width=factor(0.09),
            lip_fullness=factor(0.15),
            brow=factor(0.3),
            chin=factor(0.15),
            neck_width=factor(0.07),
            ear_size=factor(0.08),
            skin=skin,
            freckles=int(rng.integers(20, 320)),
            stubble=float(rng.choice([0.0, 0.0, 0.25, 0.6])),
            gloss=float(rng.choice([0.7, 1.0, 1.0, 2.0])),
            hair_style=str(rng.choice(HAIR_STYLES)),
            hair=colour(hair_choices),
            iris=colour(_IRIS_COLOURS),
            shirt=(float(shirt[0]), float(shirt[1]), float(shirt[2])),
        )
