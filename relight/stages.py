"""How long each stage of a run took, and the most memory that it held: the numbers beside every error."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

Progress = Callable[[str, float], None]
"""Told (stage, fraction done 0..1) by everything that may take long."""


def no_progress(stage: str, fraction: float) -> None:
    """For callers that do not want to know."""


class Stages:
    """Wall-clock seconds and most memory by stage, in the order in which they ran.

    Attributes:
        seconds: By stage.
        memory_mb: By stage, the most that the process held in it (`peak_memory_mb`), where that is known.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.seconds: dict[str, float] = {}
        self.memory_mb: dict[str, float] = {}
        self._clock = clock

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Times what is done inside; a stage that runs twice adds up."""
        started_s = self._clock()
        forget_peak_memory()
        try:
            yield
        finally:
            self._ended(name, self._clock() - started_s)

    @contextmanager
    def follow(self, progress: Progress) -> Iterator[Progress]:
        """Times the stages that are named to the progress it gives, each until the next one is named."""
        current = ""
        since_s = self._clock()

        def end_stage() -> None:
            nonlocal since_s
            now_s = self._clock()
            if current:  # what precedes the first name belongs to it
                self._ended(current, now_s - since_s)
                forget_peak_memory()
                since_s = now_s

        def told(stage: str, fraction: float) -> None:
            nonlocal current
            if stage != current:
                end_stage()
                current = stage
            progress(stage, fraction)

        forget_peak_memory()
        try:
            yield told
        finally:
            end_stage()

    def _ended(self, name: str, seconds: float) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds
        if (peak := peak_memory_mb()) is not None:
            self.memory_mb[name] = max(peak, self.memory_mb.get(name, 0.0))

    @property
    def total_s(self) -> float:
        """Seconds of all stages."""
        return sum(self.seconds.values())


def forget_peak_memory() -> None:
    """Begins `peak_memory_mb` anew where the system can (Linux); elsewhere that of the whole run stays."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


def peak_memory_mb() -> float | None:
    """Most resident memory of this process since it began or `forget_peak_memory`, 10^6 bytes; None where the
    system does not say."""
    try:
        status = Path("/proc/self/status").read_text()
        return int(status.split("VmHWM:")[1].split()[0]) * 1024 / 1e6
    except (OSError, IndexError, ValueError):
        pass
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def memory_summary(stages: Stages, device: torch.device) -> dict[str, Any]:
    """Peak memory for metrics.json: of all stages, of each, and of the card where one was used."""
    summary: dict[str, Any] = {
        "peak_memory_mb": max(stages.memory_mb.values(), default=None),
        "stage_memory_mb": {stage: round(peak) for stage, peak in stages.memory_mb.items()},
    }
    if device.type == "cuda":
        summary["peak_cuda_memory_mb"] = torch.cuda.max_memory_allocated(device) / 1e6
    return summary
