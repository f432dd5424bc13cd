"""Dense stereo: from frames with poses to a cloud of the subject's surface with normals and confidence."""

from relight.stereo.config import DenseCloud, StereoConfig
from relight.stereo.dense import dense_cloud

__all__ = ["DenseCloud", "StereoConfig", "dense_cloud"]
