"""The head that most tests of the face prior look at, made once."""

import pytest
from face_shapes import arc_of_cameras, seen_by, sitter

from relight.face import find_face


@pytest.fixture(scope="session")
def half_circle():
    return arc_of_cameras(-85, 85)


@pytest.fixture(scope="session")
def head_cloud(half_circle):
    """What cameras on a half circle see of the sitter."""
    return seen_by(sitter(), half_circle)


@pytest.fixture(scope="session")
def face(head_cloud, half_circle):
    """The result of looking for a face in it."""
    return find_face(*head_cloud, half_circle)
