"""In which type the networks compute their products; weights, losses and all else are float32."""

from __future__ import annotations

import torch

PRECISIONS = ("float32", "bfloat16")

_CPU_INSTRUCTIONS = ("avx512_bf16", "amx_bf16", "avx10_2", "bf16")


def products_in(precision: str, device: torch.device) -> torch.autocast:
    """The context of a network's products in one of `PRECISIONS`.

    A device without instructions for bfloat16 takes longer in it than in float32, and computes in float32.
    """
    rounded = precision == "bfloat16" and has_bfloat16(device)
    return torch.autocast(device.type, torch.bfloat16, enabled=rounded)


def has_bfloat16(device: torch.device) -> bool:
    """Whether a device has instructions for bfloat16."""
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    known = torch.cpu.get_capabilities()
    return any(known.get(name, False) for name in _CPU_INSTRUCTIONS)
