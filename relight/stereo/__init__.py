"""Dense stereo: from frames with poses to a cloud of the subject's surface with normals and confidence."""

from relight.stereo.completion import complete_with_masks
from relight.stereo.config import DenseCloud, StereoConfig
from relight.stereo.dense import dense_cloud

__all__ = ["DenseCloud", "StereoConfig", "complete_with_masks", "dense_cloud"]
