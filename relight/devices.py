"""Where tensors live: the card where there is one, or what was asked for."""

from __future__ import annotations

import torch

from relight.errors import PlanError


def choose_device(name: str | None) -> torch.device:
    """The device of a name, "cpu" or "cuda"; without one the card where torch sees one.

    Raises:
        PlanError: A card was asked for and there is none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise PlanError(
            "--device cuda was asked for, but torch sees no CUDA card; use --device cpu, or install CUDA's "
            "build of torch as the README says."
        )
    return torch.device(name or ("cuda" if torch.cuda.is_available() else "cpu"))


def describe_device(device: torch.device) -> str:
    """For a person and for metrics.json."""
    if device.type == "cuda":
        return str(torch.cuda.get_device_name(device))
    return f"cpu ({torch.get_num_threads()} threads)"
