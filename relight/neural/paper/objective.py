"""The paper's composite loss of one patch (Sevastopolsky et al. 2020, section 3.3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from relight.face.textures import sample_texture
from relight.neural.display import display_values
from relight.neural.frames import Target
from relight.neural.losses.dice import mask_loss
from relight.neural.losses.face import colour_loss, normal_loss, symmetry_loss
from relight.neural.losses.mismatch import Mismatch
from relight.neural.losses.total_variation import total_variation
from relight.neural.paper.config import PaperConfig
from relight.neural.paper.faces import FacePatch
from relight.neural.paper.heads import NeuralMaps


@dataclass(frozen=True, eq=False)
class FaceTextures:
    """T_A as it is learned, and T_F with where it is known.

    Attributes:
        half: [3, 256, 128] T_A, display values.
        colour: [3, 256, 256] T_F, display values.
        known: [256, 256], 1 where T_F is known.
        half_known: [256, 256], 1 where T_A is known on either side.
    """

    half: torch.Tensor
    colour: torch.Tensor
    known: torch.Tensor
    half_known: torch.Tensor


@dataclass(frozen=True)
class Objective:
    """The weighted sum of the losses.

    Attributes:
        config: With the weights.
        mismatch: Delta.
    """

    config: PaperConfig
    mismatch: Mismatch

    def terms(
        self,
        maps: NeuralMaps,
        image: torch.Tensor,
        target: Target,
        face: FacePatch | None = None,
        textures: FaceTextures | None = None,
    ) -> dict[str, torch.Tensor]:
        """Each term times its weight, by name; those of the face where both it and its textures are known.

        Args:
            maps: Of the patch.
            image: [3, H, W], its image by eq. 6, linear.
            target: What the frame shows.
            face: Of the patch.
            textures: Of the face.
        """
        config = self.config
        # Where a pixel is clipped, or beyond the frame, nothing is known of it: it equals itself.
        sure = target.valid * target.mask
        terms = {
            "final": self.mismatch(
                (display_values(image) * sure)[None], (display_values(target.radiance) * sure)[None]
            ),
            "mask": config.weight_mask * mask_loss(maps.mask * target.inside, target.mask * target.inside),
            "shading": config.weight_shading * total_variation(maps.shading),
        }
        if face is not None and textures is not None:
            albedo, defined = sample_texture(display_values(maps.albedo), face.position_map)
            terms["symmetry"] = config.weight_symmetry * symmetry_loss(
                self.mismatch, albedo, defined * textures.half_known, textures.half
            )
            terms["colour"] = config.weight_colour * colour_loss(
                albedo, defined * textures.known, textures.colour
            )
            terms["normal"] = config.weight_normal * normal_loss(
                self.mismatch, maps.normals_world, face.normals_world, face.mask
            )
        return terms
