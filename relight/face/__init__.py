"""The face prior: position maps, normals, masks and symmetric textures of a face, whoever finds it.

`find_face` asks the provider that the configuration names: given position maps, a landmark model, or the
cloud alone. Without a face there is no prior, and the decision says why.
"""

from relight.face.decision import FaceDecision, decide
from relight.face.find import FaceConfig, FaceResult, find_face
from relight.face.prior import FacePrior
from relight.face.store import load_face, save_face

__all__ = [
    "FaceConfig",
    "FaceDecision",
    "FacePrior",
    "FaceResult",
    "decide",
    "find_face",
    "load_face",
    "save_face",
]
