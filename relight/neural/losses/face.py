"""What is known of faces as losses: symmetric albedo, its colour, and the normals of the face.

Sevastopolsky et al. 2020, section 3.3. Textures are [3, 256, 256] display values; a picture's face is brought
into the texture by its position map (`relight.face.textures.sample_texture`).
"""

from __future__ import annotations

import torch

from relight.face.textures import whole_texture
from relight.neural.losses.mismatch import Mismatch


def symmetry_loss(
    mismatch: Mismatch, albedo: torch.Tensor, defined: torch.Tensor, half: torch.Tensor
) -> torch.Tensor:
    """Delta(A ⊙ Posmap, [T_A, flip(T_A)]) where the first is defined.

    Args:
        mismatch: Delta.
        albedo: [3, 256, 256], A ⊙ Posmap.
        defined: [256, 256], 1 where it is.
        half: [3, 256, 128], T_A, learned along.
    """
    return mismatch((albedo * defined)[None], (whole_texture(half) * defined)[None])


def colour_loss(albedo: torch.Tensor, defined: torch.Tensor, colour: torch.Tensor) -> torch.Tensor:
    """L1(A ⊙ Posmap, T_F): mean over the texels of which both are defined; 0 where none is.

    Args:
        albedo: [3, 256, 256], A ⊙ Posmap.
        defined: [256, 256], 1 where both are.
        colour: [3, 256, 256], T_F.
    """
    deviation = ((albedo - colour).abs() * defined).sum()
    return deviation / (len(albedo) * defined.sum()).clamp(min=1.0)


def normal_loss(
    mismatch: Mismatch, normals: torch.Tensor, known: torch.Tensor, face: torch.Tensor
) -> torch.Tensor:
    """Delta(N * M_face, N_i * M_face).

    Args:
        mismatch: Delta.
        normals: [3, H, W], unit, world.
        known: [3, H, W], N_i, as the face prior has them.
        face: [1, H, W], M_face.
    """
    return mismatch((normals * face)[None], (known * face)[None])
