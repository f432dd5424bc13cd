"""What no flash reached of a face, from its other side: before its neighbours help, where there is a face."""

from __future__ import annotations

import numpy as np
import torch

from relight.face.head import find_head
from relight.face.mirror import MirrorFill, fill_from_mirror
from relight.scene import Scene

_REACH = 0.02  # breadths of the head between a mirror image and the points that stand for it: 3 mm


def mirror_infill(
    scene: Scene,
    points: torch.Tensor,
    normals_world: torch.Tensor,
    values: torch.Tensor,
    information: torch.Tensor,
    known: float,
) -> MirrorFill:
    """Fills values from the mirror image; as given where no face is found.

    Args:
        scene: Tells where the cameras are and which way is up.
        points: [P, 3], world.
        normals_world: [P, 3], unit.
        values: [P, 3], albedo.
        information: [P] >= 0, how much each value rests on.
        known: Information above which a value is known.
    """
    share = information / known
    head = find_head(
        points.cpu().double().numpy(),
        normals_world.cpu().double().numpy(),
        values.cpu().double().numpy(),
        {view.index: view.camera for view in scene.views},
        np.asarray((share / (1.0 + share)).cpu().double().numpy()),
        scene.rotation_deg,
    )
    if not head.decision.found or head.frame is None:
        return MirrorFill(
            values, information, torch.zeros(len(points), dtype=torch.bool, device=points.device)
        )
    return fill_from_mirror(
        points,
        normals_world,
        values,
        information,
        head.frame.plane,
        known=known,
        reach=_REACH * head.frame.breadth,
    )
