"""Errors of fitting, lighting and measuring, under `capture.errors.RelightError`.

RelightError
├── LightError       a light, its description or its panorama cannot be used
├── PlanError        a session cannot be fitted as it is, or a decision cannot be forced
│   └── GeometryError poses, cloud or masks cannot be found in the frames
├── PortraitError    a portrait is missing or cannot be read
├── StressError      a stage is not stable under some input
├── RefineError      a refinement lacks something, or cannot go on
└── TruthError       a folder with ground truth cannot be used

Every message is one sentence for the user: what is wrong, with its name, value and limit, and what to do
next.
"""

from capture.errors import RelightError


class LightError(RelightError):
    """A light, its description or its panorama cannot be used."""


class PlanError(RelightError):
    """A session cannot be fitted as it is, or a decision of its plan cannot be forced."""


class GeometryError(PlanError):
    """Poses, cloud or masks cannot be found in the frames of a session."""


class PortraitError(RelightError):
    """A portrait is missing or cannot be read."""


class RefineError(RelightError):
    """A refinement lacks something that was named, or its numbers have gone astray."""


class StressError(RelightError):
    """A stage is not numerically stable under some input, or no such case is known."""


class TruthError(RelightError):
    """A folder with ground truth cannot be used."""
