"""U2-Net (Qin et al. 2020, "U2-Net: going deeper with nested U-structure for salient object detection").

The layers bear the names of the published checkpoints (u2net.pth, and the small u2netp.pth), so that these
load as they are. No weights come with this package: a user gives a file by path, and of it only tensors are
read, never code.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import nn
from torch.nn.functional import interpolate, max_pool2d, relu

from capture.transfer import to_display
from relight.errors import GeometryError
from relight.masks.frames import Floats

INPUT_PX = 320
"""Side of the pictures that the published weights were trained on."""

# Stage: height of its inner U (0 = dilated, without pooling), channels in, inside, out (paper, table 1).
_FULL = {
    "stage1": (7, 3, 32, 64),
    "stage2": (6, 64, 32, 128),
    "stage3": (5, 128, 64, 256),
    "stage4": (4, 256, 128, 512),
    "stage5": (0, 512, 256, 512),
    "stage6": (0, 512, 256, 512),
    "stage5d": (0, 1024, 256, 512),
    "stage4d": (4, 1024, 128, 256),
    "stage3d": (5, 512, 64, 128),
    "stage2d": (6, 256, 32, 64),
    "stage1d": (7, 128, 16, 64),
}
_SMALL = {
    name: (height, 3 if name == "stage1" else 128 if name.endswith("d") else 64, 16, 64)
    for name, (height, *_) in _FULL.items()
}
_MEAN, _SPREAD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, as in training
_FLAT_DEPTH = 4  # of the dilated block


class _ConvBlock(nn.Module):
    """3 x 3 convolution, normalisation, ReLU."""

    def __init__(self, channels_in: int, channels_out: int, dilation: int = 1) -> None:
        super().__init__()
        self.conv_s1 = nn.Conv2d(channels_in, channels_out, 3, padding=dilation, dilation=dilation)
        self.bn_s1 = nn.BatchNorm2d(channels_out)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return relu(self.bn_s1(self.conv_s1(x)))


class _ResidualU(nn.Module):
    """A U of convolutions about a residual: RSU-7 to RSU-4; height 0 is RSU-4F, dilated, not pooled."""

    def __init__(self, height: int, channels_in: int, inside: int, channels_out: int) -> None:
        super().__init__()
        self.pooled = height > 0
        self.depth = height or _FLAT_DEPTH
        self.rebnconvin = _ConvBlock(channels_in, channels_out)
        for level in range(1, self.depth + 1):
            dilation = 2 ** (level - 1)
            if self.pooled:
                dilation = 2 if level == self.depth else 1
            block = _ConvBlock(channels_out if level == 1 else inside, inside, dilation)
            self.add_module(f"rebnconv{level}", block)
        for level in range(self.depth - 1, 0, -1):
            dilation = 1 if self.pooled else 2 ** (level - 1)
            block = _ConvBlock(2 * inside, channels_out if level == 1 else inside, dilation)
            self.add_module(f"rebnconv{level}d", block)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        residual = self.rebnconvin(x)
        levels = []
        x = residual
        for level in range(1, self.depth + 1):
            # The last but one is not pooled: the last one sees further by its dilation.
            if self.pooled and 1 < level < self.depth:
                x = _halved(x)
            x = self.get_submodule(f"rebnconv{level}")(x)
            levels.append(x)
        for level in range(self.depth - 1, 0, -1):
            x = torch.cat([_resized(x, levels[level - 1]), levels[level - 1]], dim=1)
            x = self.get_submodule(f"rebnconv{level}d")(x)
        return x + residual


class U2Net(nn.Module):
    """The network: a U of Us with six side outputs and their fusion."""

    def __init__(self, small: bool = False) -> None:
        """Random weights; `small` is the published u2netp."""
        super().__init__()
        stages = _SMALL if small else _FULL
        for name, shape in stages.items():
            self.add_module(name, _ResidualU(*shape))
        sides = ("stage1d", "stage2d", "stage3d", "stage4d", "stage5d", "stage6")
        for number, name in enumerate(sides, start=1):
            self.add_module(f"side{number}", nn.Conv2d(stages[name][3], 1, 3, padding=1))
        self.outconv = nn.Conv2d(6, 1, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Log-odds [B, 1, H, W] of the fused output for normalised pictures [B, 3, H, W]."""
        size = x
        down = []
        for number in range(1, 7):
            x = self.get_submodule(f"stage{number}")(x if number == 1 else _halved(x))
            down.append(x)
        outputs = [x]
        for number in range(5, 0, -1):
            x = torch.cat([_resized(x, down[number - 1]), down[number - 1]], dim=1)
            x = self.get_submodule(f"stage{number}d")(x)
            outputs.insert(0, x)
        sides = [
            _resized(self.get_submodule(f"side{number}")(output), size)
            for number, output in enumerate(outputs, start=1)
        ]
        fused: torch.Tensor = self.outconv(torch.cat(sides, dim=1))
        return fused


def load_u2net(path: Path) -> U2Net:
    """A network with the weights of a checkpoint, ready to infer.

    Args:
        path: .safetensors, or a state dict saved by torch (u2net.pth and u2netp.pth as published).

    Raises:
        GeometryError: Missing, not a file of tensors, or of another network.
    """
    path = Path(path)
    state = _read(path)
    state = {name.removeprefix("module."): tensor for name, tensor in state.items()}
    inner = state.get("stage1.rebnconv1.conv_s1.weight")
    network = U2Net(small=inner is not None and inner.shape[0] == _SMALL["stage1"][2])
    wanted = network.state_dict()
    # Batches are counted in training only; some converters leave that out.
    missing = [name for name in wanted if name not in state and not name.endswith("num_batches_tracked")]
    unfit = [name for name in wanted if name in state and state[name].shape != wanted[name].shape]
    unknown = [name for name in state if name not in wanted]
    if missing or unfit or unknown:
        named = [
            *(f"{name} is missing" for name in missing),
            *(f"{name} has another shape" for name in unfit),
        ]
        named += [f"{name} is unknown" for name in unknown]
        raise GeometryError(
            f"{path} does not fit U2-Net ({len(named)} of its tensors differ, the first: {named[0]}); give "
            "the published u2net.pth or u2netp.pth, or leave the network out."
        )
    network.load_state_dict(state, strict=False)
    return network.eval()


def network_input(radiance: Floats, side_px: int | None = None) -> torch.Tensor:
    """A linear picture [H, W, 3] as the network takes it: [1, 3, side, side], sRGB, normalised."""
    side_px = side_px or INPUT_PX
    small = cv2.resize(radiance, (side_px, side_px), interpolation=cv2.INTER_AREA)
    srgb = to_display(np.clip(small, 0.0, 1.0), "srgb")
    srgb = srgb / max(float(srgb.max()), 1e-6)  # as the published code does
    picture = (srgb - np.array(_MEAN, np.float32)) / np.array(_SPREAD, np.float32)
    return torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1), dtype=np.float32))[None]


def _read(path: Path) -> Mapping[str, torch.Tensor]:
    """The tensors of a file by name."""
    if not path.is_file():
        raise GeometryError(
            f"There is no U2-Net checkpoint {path}; give the path of the published u2net.pth, or leave the "
            "network out: the masks need none."
        )
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (
        OSError,
        RuntimeError,
        ValueError,
        KeyError,
        EOFError,
        pickle.UnpicklingError,
        SafetensorError,
    ) as cause:
        raise GeometryError(
            f"{path} cannot be read as a checkpoint that holds tensors alone; give the published u2net.pth "
            "or a .safetensors file."
        ) from cause
    if not isinstance(state, Mapping) or not all(isinstance(each, torch.Tensor) for each in state.values()):
        raise GeometryError(f"{path} holds no state dict (tensors by name); give the published u2net.pth.")
    return state


def _halved(x: torch.Tensor) -> torch.Tensor:
    return max_pool2d(x, 2, stride=2, ceil_mode=True)


def _resized(x: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    if x.shape[2:] == like.shape[2:]:
        return x
    return interpolate(x, size=like.shape[2:], mode="bilinear", align_corners=False)
