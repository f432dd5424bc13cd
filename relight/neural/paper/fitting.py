"""The paper's fit of one scene: a random frame, a random patch, its loss, a step of Adam, again and again."""

from __future__ import annotations

import logging
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from relight.errors import RefineError
from relight.face.prior import FacePrior
from relight.face.textures import half_texture
from relight.neural.checkpoint import load_state, save_state
from relight.neural.crops import random_crop
from relight.neural.display import display_values
from relight.neural.frames import FrameStore
from relight.neural.holdout import held_out
from relight.neural.losses.mismatch import Mismatch, Perceptual
from relight.neural.paper.config import PaperConfig
from relight.neural.paper.decoder import PaperDecoder
from relight.neural.paper.faces import FacePatches
from relight.neural.paper.heads import NeuralMaps
from relight.neural.paper.lighting import flash_distance, flash_image, room_image, towards_camera
from relight.neural.paper.model import LEVELS, PaperModel
from relight.neural.paper.objective import FaceTextures, Objective
from relight.portrait import Portrait
from relight.raster import rasterize_ids
from relight.scene import Scene, View

log = logging.getLogger(__name__)

_SPIKE = 10.0  # times its usual length, beyond which a gradient is shortened
_SPIKE_MEMORY = 0.9  # of the usual length, from one step to the next
_MOST_SKIPPED = 20  # steps in a row without a finite loss: it will not come back
_FIRST_FRAMES = 6  # of each kind, from which the lights are guessed
_FIRST_ALBEDO, _FIRST_SHADING, _FIRST_COSINE = 0.5, 0.5, 0.7  # about what a network without training gives
_TEXTURE_FRAMES = 32
_FULL_MASK = 0.99


class PaperFit:
    """A fit under way.

    Attributes:
        model: What is learned.
        step: How many steps were made.
        skipped: How many of them had no finite loss or gradient, and changed nothing.
        shortened: How many had a gradient far longer than usual, which was shortened.
        held_out_db: [(step, PSNR)] of the frames that are not fitted; empty where none could be spared.
    """

    def __init__(
        self,
        scene: Scene,
        solved: Portrait,
        config: PaperConfig,
        perceptual: Perceptual,
        face: FacePrior | None,
        seed: int,
    ) -> None:
        """Before the first step.

        Args:
            scene: With the frames; their device is that of the fit.
            solved: Gives the points, and the mask of frames that have none.
            config: What can be set.
            perceptual: For Delta.
            face: What is known of the face; None = the terms of the face are left out.
            seed: Of chance.
        """
        self.config = config
        self.fitted, self.checked = held_out(scene.views)
        self.step = self.skipped = self.shortened = self._skipped_in_a_row = 0
        self._usual_gradient = 0.0
        self.held_out_db: list[tuple[int, float]] = []
        self._scene, self._solved, self._face = scene, solved, face
        self._frames = FrameStore(scene, solved)
        self._points = solved.points
        self._distance = {view.index: flash_distance(solved.points, view.camera) for view in scene.views}
        self._objective = Objective(config, Mismatch(perceptual, config.beta))
        self._chance = torch.Generator().manual_seed(seed)
        self._textures = self._first_textures()
        self._patches = None if face is None or self._textures is None else FacePatches(face)
        c_room, c_flash = self._first_colours()
        half = None if self._textures is None else self._textures.half
        model = PaperModel(len(solved.points), c_room, c_flash, half, self._chance)
        self.model = model.to(scene.device)
        self._optimiser = torch.optim.Adam(self.model.groups(config), fused=True)

    def advance(self) -> dict[str, float]:
        """One step; the weighted terms of its loss.

        Raises:
            RefineError: There was no finite loss for many steps in a row.
        """
        draw = float(torch.rand((), generator=self._chance, dtype=torch.float64))
        view = self.fitted[min(int(draw * len(self.fitted)), len(self.fitted) - 1)]
        zooms = (self.config.zoom_out, self.config.zoom_in)
        crop = random_crop(self._frames.subject(view), self.config.crop, zooms, self._chance)
        camera = crop.camera(view.camera)
        self.model.train()
        maps = self.model.maps(rasterize_ids(self._points, camera, LEVELS).ids, self.config.precision)
        textures = self._textures_now()
        terms = self._objective.terms(
            maps,
            self._image(maps, view),
            self._frames.patch(view, crop),
            None if self._patches is None else self._patches.of(view, crop),
            textures,
        )
        loss = torch.stack(list(terms.values())).sum()
        self._optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self.step += 1
        length = self._gradient_length()
        if bool(loss.isfinite()) and math.isfinite(length):
            self._shorten(length)
            self._optimiser.step()
            self._skipped_in_a_row = 0
        else:
            self._skip()
        return {name: float(value.detach()) for name, value in terms.items()}

    def look_at_held_out(self) -> float | None:
        """PSNR of the held-out frames, mean over them, of display values where the mask is full.

        None where none is held out.
        """
        if not self.checked:
            return None
        ratios = []
        decoder = self.decoder()
        for view in self.checked:
            target = self._frames.whole(view)
            maps = decoder.neural_maps(self._points, view.camera)
            with torch.no_grad():
                image = display_values(self._image(maps, view).clamp(0.0, 1.0))
            region = ((target.mask > _FULL_MASK) & (target.valid > 0))[0]
            error = (image - display_values(target.radiance))[:, region].double().square().mean()
            ratios.append(-10.0 * math.log10(max(float(error), 1e-12)) if bool(region.any()) else 0.0)
        self.held_out_db.append((self.step, sum(ratios) / len(ratios)))
        return self.held_out_db[-1][1]

    def decoder(self) -> PaperDecoder:
        """The network as it is now; it does not change when the fit goes on."""
        network = {
            f"network.{name}": v.detach().clone() for name, v in self.model.network.state_dict().items()
        }
        descriptors = self.model.descriptors.detach().clone()
        settings = {"precision": self.config.precision, "turn": torch.eye(3).tolist()}
        return PaperDecoder.restored(settings, {"descriptors": descriptors, **network})

    def colours(self) -> tuple[Tensor, Tensor]:
        """C_room and C_flash as they are now."""
        return self.model.c_room.detach().clone(), self.model.c_flash.detach().clone()

    def save(self, folder: Path) -> None:
        """Writes a checkpoint."""
        tensors = {f"model.{name}": values for name, values in self.model.state_dict().items()}
        for number, moments in self._optimiser.state_dict()["state"].items():
            tensors |= {f"adam.{number}.{name}": torch.as_tensor(value) for name, value in moments.items()}
        tensors["chance"] = self._chance.get_state()
        content = {
            "config": _lasting(self.config),
            "step": self.step,
            "skipped": self.skipped,
            "shortened": self.shortened,
            "usual_gradient": self._usual_gradient,
            "held_out_db": self.held_out_db,
        }
        save_state(folder, self.step, tensors, content)

    def resume(self, folder: Path) -> bool:
        """Goes on from a checkpoint, if there is one of the same configuration; whether it did.

        Raises:
            RefineError: There is one that cannot be read.
        """
        found = load_state(folder, self._scene.device)
        if found is None:
            return False
        tensors, content = found
        if content.get("config") != _lasting(self.config):
            log.warning("The checkpoint in %s is of another configuration; the fit begins anew.", folder)
            return False
        parameters = [p for group in self._optimiser.param_groups for p in group["params"]]
        moments: dict[int, dict[str, Tensor]] = {}
        try:
            self.model.load_state_dict(
                {n.removeprefix("model."): v for n, v in tensors.items() if n.startswith("model.")}
            )
            for name, values in tensors.items():
                if name.startswith("adam."):
                    _, number, part = name.split(".")
                    moments.setdefault(int(number), {})[part] = _laid_out(values, parameters[int(number)])
            groups = self._optimiser.state_dict()["param_groups"]
            self._optimiser.load_state_dict({"state": moments, "param_groups": groups})
            self._chance.set_state(tensors["chance"].cpu())
            self.step, self.skipped = int(content["step"]), int(content["skipped"])
            self.shortened = int(content["shortened"])
            self._usual_gradient = float(content["usual_gradient"])
            self.held_out_db = [(int(step), float(db)) for step, db in content["held_out_db"]]
        except (RuntimeError, KeyError, IndexError, TypeError, ValueError) as error:
            raise RefineError(
                f"The checkpoint in {folder} is not of this fit ({error}); remove the folder, or fit with "
                "--fresh."
            ) from error
        return True

    def _image(self, maps: NeuralMaps, view: View) -> Tensor:
        """[3, H, W] by eq. 6."""
        image = room_image(maps, self.model.c_room)
        if view.flash == 1:
            towards = towards_camera(view.camera)
            image = image + flash_image(maps, self.model.c_flash, self._distance[view.index], towards)
        return image

    def _gradient_length(self) -> float:
        """Of all that is learned together; infinite or NaN where a part is."""
        squares = [p.grad.square().sum() for p in self.model.parameters() if p.grad is not None]
        return float(torch.stack(squares).sum(dtype=torch.float64).sqrt())

    def _shorten(self, length: float) -> None:
        """Cuts a gradient of a length to a few times the usual one (Pascanu et al. 2013).

        One patch a step has outliers. Without this a fit of portrait_A that had reached 28 dB lost all of it
        within a thousand steps.
        """
        usual = self._usual_gradient or length
        most = _SPIKE * usual
        if length > most:
            self.shortened += 1
            for parameter in self.model.parameters():
                if parameter.grad is not None:
                    parameter.grad.mul_(most / length)
        self._usual_gradient = _SPIKE_MEMORY * usual + (1.0 - _SPIKE_MEMORY) * min(length, most)

    def _skip(self) -> None:
        self.skipped += 1
        self._skipped_in_a_row += 1
        if self._skipped_in_a_row >= _MOST_SKIPPED:
            raise RefineError(
                f"The fit has no finite loss for {_MOST_SKIPPED} steps on end, after {self.step} steps; fit "
                f"with a lower rate than {self.config.rate:g}, or look for frames that are not pictures."
            )

    def _first_colours(self) -> tuple[Tensor, Tensor]:
        """Grey C_room and C_flash with which an untrained network's pictures are as bright as the frames."""
        lit = self._mean_radiance(1)
        unlit = self._mean_radiance(0)
        room = unlit / (_FIRST_ALBEDO * _FIRST_SHADING)
        square = sum(self._distance[view.index] ** 2 for view in self.fitted) / len(self.fitted)
        flash = max(lit - unlit, 0.1 * lit) * square / (_FIRST_ALBEDO * _FIRST_COSINE)
        return torch.full((3,), max(room, 1e-4)), torch.full((3,), max(flash, 1e-6))

    def _mean_radiance(self, flash: int) -> float:
        """Of the subject in some frames of a kind; 0 where there is none."""
        views = [view for view in self.fitted if view.flash == flash]
        means = []
        for view in views[:: max(1, len(views) // _FIRST_FRAMES)]:
            target = self._frames.whole(view)
            weight = target.valid * target.mask
            means.append(float((target.radiance * weight).sum() / (3.0 * weight.sum()).clamp(min=1.0)))
        return sum(means) / len(means) if means else 0.0

    def _first_textures(self) -> FaceTextures | None:
        """T_F of the lit frames, and T_A as it begins; None where no lit frame shows a face."""
        face = self._face
        lit = [] if face is None else [v for v in self.fitted if v.flash == 1 and v.index in face.cameras]
        if face is None or not lit:
            return None
        by_index = {view.index: view for view in lit}

        def load_image(index: int) -> Tensor:
            return display_values(self._frames.whole(by_index[index]).radiance)

        colour, count = face.texture_of(load_image, by_index, most=_TEXTURE_FRAMES)
        known = (count > 0).to(colour)
        half, weight = half_texture(colour, known)
        grey = (half * (weight > 0)).sum(dim=(1, 2)) / (weight > 0).sum().clamp(min=1)
        half = torch.where(weight > 0, half, grey[:, None, None])
        half_known = (weight > 0).to(colour)
        return FaceTextures(half, colour, known, torch.cat([half_known, half_known.flip(-1)], dim=-1))

    def _textures_now(self) -> FaceTextures | None:
        """The textures with T_A as it is learned."""
        if self._textures is None or self.model.half_texture is None:
            return None
        first = self._textures
        return FaceTextures(self.model.half_texture, first.colour, first.known, first.half_known)


def _laid_out(values: Tensor, parameter: Tensor) -> Tensor:
    """A moment in memory as its parameter is: a fused Adam goes through both from end to end."""
    return torch.empty_like(parameter).copy_(values) if values.shape == parameter.shape else values


def _lasting(config: PaperConfig) -> dict[str, Any]:
    """What of a configuration a checkpoint depends on: not how long the fit goes on, nor what follows it."""
    passing = ("steps", "validate_every", "baked_views")
    return {name: value for name, value in asdict(config).items() if name not in passing}
