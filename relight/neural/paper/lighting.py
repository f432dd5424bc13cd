"""The paper's image of a view: eq. 6, under a flash whose rays are parallel and everywhere equally strong.

    I = A C_room S + F A C_flash / d^2 <N, -omega_o>

d is the distance from the camera to its closest point of the cloud, omega_o the direction in which the camera
looks (Sevastopolsky et al. 2020, section 3.1: rays are taken for parallel, and d(x) for d). All is linear.
The scalar product is not cut at zero: where a normal turns away, the picture is negative, and the fit turns
it back.
"""

from __future__ import annotations

import torch

from capture.cameras import Camera
from relight.neural.paper.heads import NeuralMaps

_NEAREST = 1e-3  # world units; a camera inside the cloud does not divide by zero


def flash_distance(points: torch.Tensor, camera: Camera) -> float:
    """d: from the camera to its closest point of the cloud [P, 3], world units."""
    centre = torch.as_tensor(camera.centre_world).to(points)
    return max(float(torch.linalg.vector_norm(points - centre, dim=1).min()), _NEAREST)


def towards_camera(camera: Camera) -> torch.Tensor:
    """-omega_o: [3] unit, world, against the camera's optical axis."""
    return torch.as_tensor(-camera.cam_from_world[2, :3], dtype=torch.float32)


def room_image(maps: NeuralMaps, c_room: torch.Tensor) -> torch.Tensor:
    """A C_room S: [3, H, W] linear radiance."""
    return maps.albedo * c_room.view(3, 1, 1) * maps.shading


def flash_image(
    maps: NeuralMaps, c_flash: torch.Tensor, distance: float, towards: torch.Tensor
) -> torch.Tensor:
    """A C_flash / d^2 <N, -omega_o>: [3, H, W] linear radiance, negative where the normal turns away."""
    cosine = (maps.normals_world * towards.to(maps.normals_world).view(3, 1, 1)).sum(dim=0, keepdim=True)
    return maps.albedo * (c_flash / distance**2).view(3, 1, 1) * cosine
