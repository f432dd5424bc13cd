"""COLMAP's global mapper as a program of its own: `python -m relight.sfm.global_mapping DATABASE OUTPUT ...`.

Where it finds no consistent motion it ends the whole process (a failed check in its C++ code), which no
caller could catch. Only `relight.sfm.mapping` starts it.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy  # noqa: F401  before pycolmap, whose own zlib breaks the writing of PNG when it is first
import pycolmap


def main(arguments: Sequence[str]) -> int:
    """Maps a database into numbered folders.

    Args:
        arguments: Database, output folder, threads, seed, and 1 or 0 for refining the lens.
    """
    database, output = Path(arguments[0]), Path(arguments[1])
    threads, seed, refine_lens = (int(text) for text in arguments[2:])
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = threads
    options.random_seed = seed
    options.mapper.bundle_adjustment.refine_focal_length = bool(refine_lens)
    options.mapper.bundle_adjustment.refine_extra_params = bool(refine_lens)
    options.mapper.bundle_adjustment.ceres.use_gpu = False
    options.mapper.global_positioning.use_gpu = False
    for number, model in pycolmap.global_mapping(database, database.parent, output, options).items():
        folder = output / f"{number:03d}"
        folder.mkdir(exist_ok=True)
        model.write(folder)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
