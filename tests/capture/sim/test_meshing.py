import numpy as np

from capture.sim.meshing import Mesh, project_to_surface, subdivide, surface_nets

LOW, HIGH = np.full(3, -1.5), np.full(3, 1.5)


def ball(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points, axis=-1) - 1.0


def edge_uses(mesh: Mesh) -> np.ndarray:
    pairs = np.concatenate([mesh.triangles[:, [0, 1]], mesh.triangles[:, [1, 2]], mesh.triangles[:, [2, 0]]])
    _, counts = np.unique(np.sort(pairs, axis=-1), axis=0, return_counts=True)
    return counts


def test_a_ball_becomes_a_closed_mesh_on_its_surface_that_faces_outwards() -> None:
    mesh = project_to_surface(surface_nets(ball, LOW, HIGH, 0.1), ball, 0.05)
    assert (edge_uses(mesh) == 2).all()
    assert np.abs(np.linalg.norm(mesh.vertices, axis=-1) - 1.0).max() < 1e-3  # two Newton steps
    # The mesh of 0.1 chords: a normal is off by at most about the chord's angle.
    assert (np.einsum("vc,vc->v", mesh.normals(), mesh.vertices) > np.cos(0.1)).all()


def test_refining_a_part_opens_no_gap_and_keeps_the_first_vertices() -> None:
    mesh = surface_nets(ball, LOW, HIGH, 0.15)
    refined = subdivide(mesh, mesh.vertices[:, 2] > 0.3)
    assert (edge_uses(refined) == 2).all()
    assert np.array_equal(refined.vertices[: len(mesh.vertices)], mesh.vertices)
    assert len(mesh.triangles) < len(refined.triangles) < 4 * len(mesh.triangles)
    everything = subdivide(mesh, np.ones(len(mesh.vertices), bool))
    assert len(everything.triangles) == 4 * len(mesh.triangles)


def test_refining_keeps_every_triangle_facing_the_same_way() -> None:
    mesh = surface_nets(ball, LOW, HIGH, 0.15)
    refined = subdivide(mesh, mesh.vertices[:, 0] > 0.0)
    a, b, c = (refined.vertices[refined.triangles[:, i]] for i in range(3))
    assert (np.einsum("tc,tc->t", np.cross(b - a, c - a), a + b + c) > 0).all()
