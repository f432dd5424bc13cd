"""Points of a face that no flash reached take what its other side shows; other subjects stay as they are."""

from types import SimpleNamespace

import pytest
import torch
from face_shapes import arc_of_cameras, seen_by, shape, sitter

from relight.mirror_infill import mirror_infill

KNOWN = 0.25
CAMERAS = arc_of_cameras(-85, 85)


def scene(cameras):
    views = tuple(SimpleNamespace(index=k, camera=camera) for k, camera in cameras.items())
    return SimpleNamespace(views=views, rotation_deg=0)


def tensors(cloud):
    return tuple(torch.from_numpy(values).float() for values in cloud)


def test_the_unlit_cheek_takes_the_colour_of_the_other():
    points, normals, albedo = tensors(seen_by(sitter(), CAMERAS))
    unlit = (points[:, 0] > 0.02) & (points[:, 2] > 0.0) & (points[:, 1].abs() < 0.05)
    information = torch.where(unlit, 0.0, 3.0)
    given = torch.where(unlit[:, None], 0.0, albedo)
    result = mirror_infill(scene(CAMERAS), points, normals, given, information, KNOWN)
    filled = result.filled & unlit
    assert float(filled.sum()) > 0.5 * float(unlit.sum())
    error = (result.values - albedo)[filled].abs().median()
    # The rig's skin has pigment of its own on either side: a few per cent of an albedo of one half.
    assert error < 0.05
    torch.testing.assert_close(result.values[~unlit], albedo[~unlit])


@pytest.mark.parametrize("kind", ["ball", "box"])
def test_what_has_no_face_is_left_to_its_neighbours(kind):
    points, normals, albedo = tensors(shape(kind))
    information = torch.where(points[:, 0] > 0.02, 0.0, 3.0)
    result = mirror_infill(scene(CAMERAS), points, normals, albedo, information, KNOWN)
    assert not bool(result.filled.any())
    assert result.values is albedo
