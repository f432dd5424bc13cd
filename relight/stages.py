"""How long each stage of a run took, and the most memory that it held: the numbers beside every error."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch

Progress = Callable[[str, float], None]
"""Told (stage, fraction done 0..1) by everything that may take long."""


def no_progress(stage: str, fraction: float) -> None:
    """For callers that do not want to know."""


class Stages:
    """Wall-clock seconds by stage, in the order in which they ran."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.seconds: dict[str, float] = {}
        self._clock = clock

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Times what is done inside; a stage that runs twice adds up."""
        started_s = self._clock()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + self._clock() - started_s

    @contextmanager
    def follow(self, progress: Progress) -> Iterator[Progress]:
        """Times the stages that are named to the progress it gives, each until the next one is named."""
        current = ""
        since_s = self._clock()

        def end_stage() -> None:
            nonlocal since_s
            now_s = self._clock()
            if current:  # what precedes the first name belongs to it
                self.seconds[current] = self.seconds.get(current, 0.0) + now_s - since_s
                since_s = now_s

        def told(stage: str, fraction: float) -> None:
            nonlocal current
            if stage != current:
                end_stage()
                current = stage
            progress(stage, fraction)

        try:
            yield told
        finally:
            end_stage()

    @property
    def total_s(self) -> float:
        """Seconds of all stages."""
        return sum(self.seconds.values())


def peak_memory_mb() -> float | None:
    """Most resident memory of this process so far, 10^6 bytes; None where the system does not say."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def memory_summary(device: torch.device) -> dict[str, Any]:
    """Peak memory for metrics.json, of the card too where one was used."""
    summary: dict[str, Any] = {"peak_memory_mb": peak_memory_mb()}
    if device.type == "cuda":
        summary["peak_cuda_memory_mb"] = torch.cuda.max_memory_allocated(device) / 1e6
    return summary
