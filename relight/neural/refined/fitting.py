"""The fit of the refinement: patches of the frames against the solve's maps as the network changes them.

Points and poses do not move, so the maps of a frame are splatted once and kept; a step cuts a patch of them,
looks up the descriptors of the points that are seen, and compares with the frame under its own light. Frames
whose error is large are drawn more often, lit ones as often as unlit ones.
"""

from __future__ import annotations

import logging
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from capture.cameras import Camera
from relight.errors import RefineError
from relight.lamp import lamp_of_portrait
from relight.lighting import FlashLight, shade
from relight.maps import splat_maps
from relight.neural.checkpoint import load_state, save_state
from relight.neural.crops import Crop
from relight.neural.display import display_values
from relight.neural.frames import FrameStore, Target
from relight.neural.holdout import held_out
from relight.neural.kept import KeptTensors
from relight.neural.refined.config import RefinedConfig
from relight.neural.refined.decoder import RefinedDecoder, apply_network, pixels_a_unit
from relight.neural.refined.layers import STACKED, Layers, changed, stacked, unstacked
from relight.neural.refined.network import RefinedNetwork
from relight.portrait import Portrait
from relight.scene import Scene, View

log = logging.getLogger(__name__)

_ROOM_BYTES = 2 << 30  # for maps; beyond, those not used for longest are drawn again
_MOST_SKIPPED = 20  # steps in a row without a finite loss: it will not come back
_SOFT = 2e-3  # display values: differences below half a code of 8 bits are noise
_CHANGE_COST = 2e-4  # per squared change: what no frame asks for stays as it is
_MASK_WEIGHT = 0.2
_EXPOSURE_RATE = 5e-4
_EXPOSURE_COST = 0.3  # per squared logarithm: a tenth costs as much as an error of a few codes
_FULL_MASK = 0.99
_MEMORY = 0.9  # of a frame's error from one patch to the next
_LIT_SHARE = 0.5  # of the patches: lit frames are few, and show what the unlit ones do not
_SUREST = 1e-4  # of a mask's probability, so that its logarithm is finite


class RefinedFit:
    """A fit under way.

    Attributes:
        step: How many steps were made.
        skipped: How many of them had no finite loss or gradient, and changed nothing.
        checks: [(step, PSNR, loss)] of the frames that are not fitted; empty where none could be spared, or
            those show nothing.
    """

    def __init__(self, scene: Scene, solved: Portrait, config: RefinedConfig, seed: int) -> None:
        """Before the first step.

        Args:
            scene: With the frames; their device is that of the fit.
            solved: What is refined.
            config: What can be set.
            seed: Of chance.
        """
        self.config = config
        self.fitted, self.checked = held_out(scene.views)
        self.step = self.skipped = self._skipped_in_a_row = 0
        self.checks: list[tuple[int, float, float]] = []
        self._solved, self._device = solved, scene.device
        self._lamp = lamp_of_portrait(solved.info)
        self._frames = FrameStore(scene, solved)
        self._views = {view.index: view for view in scene.views}
        self._drawn = KeptTensors(self._draw, _ROOM_BYTES)
        self._chance = torch.Generator().manual_seed(seed)
        gains = solved.info.get("flash_gains", ())
        lit = [view.index for view in scene.views if view.flash == 1]
        self._gains = dict(zip(lit, gains, strict=True)) if len(gains) == len(lit) else {}
        self._errors = dict.fromkeys((view.index for view in self.fitted), 1.0)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = RefinedNetwork(config.descriptors, config.widths)
        self.network = network.to(scene.device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        count = len(solved.points)
        self.descriptors = torch.zeros(count, config.descriptors, device=scene.device, requires_grad=True)
        self._exposures = torch.zeros(
            len(scene.views), 3, device=scene.device, requires_grad=config.exposures
        )
        self._row = {view.index: row for row, view in enumerate(scene.views)}
        groups: list[dict[str, Any]] = [{"params": list(self.network.parameters()), "lr": config.rate}]
        if config.exposures:
            groups.append({"params": [self._exposures], "lr": _EXPOSURE_RATE})
        if config.descriptors:
            groups.append({"params": [self.descriptors], "lr": config.descriptor_rate})
        self._optimiser = torch.optim.Adam(groups, betas=(0.9, 0.99))
        self._rates = [group["lr"] for group in groups]

    def advance(self) -> dict[str, float]:
        """One step; the weighted terms of its loss.

        Raises:
            RefineError: There was no finite loss for many steps in a row.
        """
        view = self._choose()
        crop = self._choose_crop(view)
        image, layers, changes = self._seen(view, crop)
        image = image * self._exposures[self._row[view.index]].exp()[:, None, None]
        terms = self._terms(image, layers, self._frames.patch(view, crop))
        terms["change"] = _CHANGE_COST * changes.square().mean()
        terms["exposure"] = _EXPOSURE_COST * self._exposures.square().mean()
        loss = torch.stack(list(terms.values())).sum()
        self._optimiser.zero_grad(set_to_none=True)
        loss.backward()
        share = 0.5 + 0.5 * math.cos(math.pi * min(1.0, self.step / self.config.steps))
        for group, rate in zip(self._optimiser.param_groups, self._rates, strict=True):
            group["lr"] = rate * share
        self.step += 1
        if bool(loss.isfinite()) and self._has_finite_gradients():
            self._optimiser.step()
            self._skipped_in_a_row = 0
        else:
            self._skip()
        values = {name: float(value.detach()) for name, value in terms.items()}
        self._remember(view, values["image"])
        return values

    def check(self) -> tuple[float, float] | None:
        """PSNR and loss of the held-out frames, mean over them; None without any, or if it is not finite.

        The PSNR is of display values where the mask is full, as they are measured; the loss that of the fit.
        """
        ratios, losses = [], []
        for view in self.checked:
            target = self._frames.whole(view)
            side = self._side(view)
            with torch.no_grad():
                image, layers, _ = self._seen(view, Crop(0, 0, side, side))
                padded = self._frames.patch(view, Crop(0, 0, side, side))
                losses.append(float(torch.stack(list(self._terms(image, layers, padded).values())).sum()))
                image = image[:, : view.camera.height, : view.camera.width].clamp(0.0, 1.0)
                region = ((target.mask > _FULL_MASK) & (target.valid > 0))[0]
                difference = display_values(image) - display_values(target.radiance)
                error = difference[:, region].double().square().mean()
            if bool(region.any()):
                ratios.append(-10.0 * math.log10(max(float(error), 1e-12)))
        if not ratios or not math.isfinite(sum(ratios) + sum(losses)):
            return None
        self.checks.append((self.step, sum(ratios) / len(ratios), sum(losses) / len(losses)))
        return self.checks[-1][1:]

    def state(self) -> dict[str, Tensor]:
        """A copy of what is learned of the portrait: network and descriptors."""
        state = {f"network.{name}": v.detach().clone() for name, v in self.network.state_dict().items()}
        return state | {"descriptors": self.descriptors.detach().clone()}

    def decoder(self, state: dict[str, Tensor]) -> RefinedDecoder:
        """The decoder of a state."""
        scales = [pixels_a_unit(self._solved.points, view.camera) for view in self.fitted]
        known = sorted(scale for scale in scales if scale is not None)
        settings = {
            "descriptors": self.config.descriptors,
            "widths": list(self.config.widths),
            "pixels_a_unit": known[len(known) // 2] if known else 1.0,
            "turn": torch.eye(3).tolist(),
            "precision": self.config.precision,
        }
        return RefinedDecoder.restored(settings, {name: values.clone() for name, values in state.items()})

    def save(self, folder: Path, best: dict[str, Tensor] | None) -> None:
        """Writes a checkpoint, with the best state so far."""
        tensors = {**self.state(), "exposures": self._exposures.detach(), "chance": self._chance.get_state()}
        for number, moments in self._optimiser.state_dict()["state"].items():
            tensors |= {f"adam.{number}.{name}": torch.as_tensor(value) for name, value in moments.items()}
        if best is not None:
            tensors |= {f"best.{name}": values for name, values in best.items()}
        content = {
            "config": _plain(self.config),
            "step": self.step,
            "skipped": self.skipped,
            "checks": self.checks,
            "errors": [[index, error] for index, error in self._errors.items()],
        }
        save_state(folder, self.step, tensors, content)

    def resume(self, folder: Path) -> tuple[bool, dict[str, Tensor] | None]:
        """Goes on from a checkpoint of the same configuration, if there is one: whether it did, and the best
        state of then.

        Raises:
            RefineError: There is one that cannot be read.
        """
        found = load_state(folder, self._device)
        if found is None:
            return False, None
        tensors, content = found
        if content.get("config") != _plain(self.config):
            log.warning("The checkpoint in %s is of another configuration; the fit begins anew.", folder)
            return False, None
        parameters = [p for group in self._optimiser.param_groups for p in group["params"]]
        moments: dict[int, dict[str, Tensor]] = {}
        try:
            own = {n.removeprefix("network."): v for n, v in tensors.items() if n.startswith("network.")}
            self.network.load_state_dict(own)
            with torch.no_grad():
                self.descriptors.copy_(tensors["descriptors"])
                self._exposures.copy_(tensors["exposures"])
            for name, values in tensors.items():
                if name.startswith("adam."):
                    _, number, part = name.split(".")
                    like = parameters[int(number)]
                    laid_out = torch.empty_like(like).copy_(values) if values.shape == like.shape else values
                    moments.setdefault(int(number), {})[part] = laid_out
            groups = self._optimiser.state_dict()["param_groups"]
            self._optimiser.load_state_dict({"state": moments, "param_groups": groups})
            self._chance.set_state(tensors["chance"].cpu())
            self.step, self.skipped = int(content["step"]), int(content["skipped"])
            self.checks = [(int(step), float(db), float(loss)) for step, db, loss in content["checks"]]
            self._errors |= {int(index): float(error) for index, error in content["errors"]}
        except (RuntimeError, KeyError, IndexError, TypeError, ValueError) as error:
            raise RefineError(
                f"The checkpoint in {folder} is not of this fit ({error}); remove the folder, or fit with "
                "--fresh."
            ) from error
        best = {n.removeprefix("best."): v for n, v in tensors.items() if n.startswith("best.")}
        return True, best or None

    def _draw(self, index: int) -> Tensor:
        """[STACKED + 1, H, W] of a view: its stack, and the bits of its point ids."""
        maps = splat_maps(self._solved, self._views[index].camera)
        return torch.cat([stacked(maps), maps.point_ids.int()[None].view(torch.float32)])

    def _seen(self, view: View, crop: Crop) -> tuple[Tensor, Layers, Tensor]:
        """A patch: its image [3, H, W] under the view's light, its layers as changed, and the changes."""
        drawn, camera = self._drawn[view.index], crop.camera(view.camera)
        base = unstacked(crop.of(drawn[:STACKED]), camera)
        ids = _window(drawn[STACKED].view(torch.int32), crop)
        changes = apply_network(
            self.network,
            self.descriptors,
            base,
            ids,
            camera,
            torch.eye(3, device=base.albedo.device),
            self.config.precision,
        )
        layers = changed(base, changes)
        return self._image(layers, view, camera), layers, changes

    def _image(self, layers: Layers, view: View, camera: Camera) -> Tensor:
        """[3, H, W] radiance under the view's light."""
        image = layers.room_radiance
        if view.flash == 1:
            flash = shade(
                FlashLight(),
                layers,
                camera=camera,
                c_flash=self._solved.c_flash,
                flash_offset_cam_m=self._solved.flash_offset_cam_m,
                reflectance=self._solved.reflectance,
                lamp=self._lamp,
            )
            image = image + self._gains.get(view.index, 1.0) * flash
        return image.permute(2, 0, 1)

    def _terms(self, image: Tensor, layers: Layers, target: Target) -> dict[str, Tensor]:
        """Of the image, where it can be compared, and of the mask, where there can be one."""
        on = layers.mask > 0
        region = target.valid * (target.mask > _FULL_MASK) * on
        difference = display_values(image) - display_values(target.radiance)
        error = ((difference**2 + _SOFT**2).sqrt() - _SOFT) * region
        surprise = torch.nn.functional.binary_cross_entropy(
            layers.mask[None].clamp(_SUREST, 1.0 - _SUREST), target.mask.clamp(0.0, 1.0), reduction="none"
        )
        inside = target.inside * on
        return {
            "image": error.sum() / (3.0 * region.sum()).clamp(min=1.0),
            "mask": _MASK_WEIGHT * (surprise * inside).sum() / inside.sum().clamp(min=1.0),
        }

    def _choose(self) -> View:
        """A frame, the sooner the larger its error was, of the lit or the unlit ones."""
        lit = float(torch.rand((), generator=self._chance)) < _LIT_SHARE
        views = [view for view in self.fitted if (view.flash == 1) == lit] or list(self.fitted)
        weights = torch.tensor([self._errors[view.index] for view in views], dtype=torch.float64)
        return views[int(torch.multinomial(weights, 1, generator=self._chance))]

    def _choose_crop(self, view: View) -> Crop:
        """A patch about a random point of the subject, on the coarsest scale's grid, within the frame."""
        subject = self._frames.subject(view)
        height, width = subject.shape
        places = subject.flatten().nonzero()[:, 0]
        draw = float(torch.rand((), generator=self._chance, dtype=torch.float64))
        row, column = height // 2, width // 2
        if len(places):
            row, column = divmod(int(places[min(int(draw * len(places)), len(places) - 1)]), width)
        size, multiple = min(self.config.patch, self._side(view)), self.network.multiple

        def first(centre: int, length: int) -> int:
            return min(max(0, centre - size // 2), max(0, length - size)) // multiple * multiple

        return Crop(first(column, width), first(row, height), size, size)

    def _side(self, view: View) -> int:
        """Of the smallest square of the network's sides that holds the frame."""
        multiple = self.network.multiple
        return -(-max(view.camera.height, view.camera.width) // multiple) * multiple

    def _remember(self, view: View, error: float) -> None:
        """Keeps a frame's error, relative to the others', within a factor of four of them."""
        if math.isfinite(error):
            usual = sum(self._errors.values()) / len(self._errors)
            scale = self.checks[0][2] if self.checks else error
            now = min(max(error / max(scale, 1e-9), 0.25 * usual), 4.0 * usual)
            self._errors[view.index] = _MEMORY * self._errors[view.index] + (1.0 - _MEMORY) * now

    def _has_finite_gradients(self) -> bool:
        learned = (*self.network.parameters(), self.descriptors, self._exposures)
        gradients = [p.grad.abs().sum() for p in learned if p.grad is not None]
        return bool(torch.stack(gradients).sum().isfinite())

    def _skip(self) -> None:
        self.skipped += 1
        self._skipped_in_a_row += 1
        if self._skipped_in_a_row >= _MOST_SKIPPED:
            raise RefineError(
                f"The refinement has no finite loss for {_MOST_SKIPPED} steps on end, after {self.step} "
                "steps; look for frames that are not pictures, or fit with --preset solve."
            )


def _window(ids: Tensor, crop: Crop) -> Tensor:
    """Ids [side, side] int64 of a patch of a frame's [H, W], -1 beyond its edge."""
    height, width = ids.shape
    part = ids[crop.top : min(crop.top + crop.side, height), crop.left : min(crop.left + crop.side, width)]
    beyond = (0, crop.side - part.shape[1], 0, crop.side - part.shape[0])
    return torch.nn.functional.pad(part.long(), beyond, value=-1)


def _plain(config: RefinedConfig) -> dict[str, Any]:
    """A configuration as JSON gives it back."""
    return asdict(replace(config)) | {"widths": list(config.widths)}
