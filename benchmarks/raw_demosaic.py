"""LibRaw's ways from a Bayer mosaic to three colours a pixel, beside each other: error and time.

    python benchmarks/raw_demosaic.py [--views N] [--out FILE]

Views of the simulated rig are put under a mosaic, with and without the noise of 10,000 electrons at white,
and written as 14-bit DNG. The error is the PSNR of display values (sRGB of white balanced radiance) over the
whole view but its edge; the time is that of LibRaw's postprocess for 12 million pixels, the median of three.
`ours` is `capture.raw`, which takes PPG and its own levels.
"""

from __future__ import annotations

import argparse
import importlib.util
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rawpy
from record import ROOT, write_record

from capture.raw.reader import read_raw
from capture.sim import Rig, RigConfig
from capture.transfer import to_display

PACKAGES = ("rawpy", "numpy")
ALGORITHMS = ("LINEAR", "PPG", "VNG", "AHD", "AAHD", "DCB", "DHT")
BALANCE = np.array([2.0, 1.0, 1.6])
FULL_WELL_E, READ_NOISE_E = 10_000.0, 3.0
BLACK, WHITE = 256, 16383
EDGE_PX = 8
LARGE = (3000, 4000)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--views", type=int, default=5)
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "raw_demosaic.json")
    args = parser.parse_args()
    writer = dng_writer()
    rig = Rig.build(replace(RigConfig.small(), width=480, height=640, focal_px=690.0, strands=4000))
    errors: dict[str, dict[str, list[float]]] = {"noise_free": {}, "noisy": {}}
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "view.dng"
        for k in range(args.views):
            layers = rig.layers(rig.camera(1.7 * (k + 0.5) / args.views, "view"), flash=True)
            truth = np.minimum(layers.room + layers.flash, 0.95)
            for name, by_way in errors.items():
                samples = writer.mosaic_of(truth / BALANCE)
                if name == "noisy":
                    spread = np.sqrt(samples / FULL_WELL_E + (READ_NOISE_E / FULL_WELL_E) ** 2)
                    samples = samples + spread * rng.normal(size=samples.shape)
                path.write_bytes(writer.dng(writer.codes_of(samples, BLACK, WHITE), black=BLACK, white=WHITE))
                by_way.setdefault("ours", []).append(psnr_db(read_raw(path, BALANCE).radiance, truth))
                for way in ALGORITHMS:
                    by_way.setdefault(way, []).append(psnr_db(by_libraw(path, way), truth))
        path.write_bytes(writer.dng(rng.integers(BLACK, WHITE, LARGE), black=BLACK, white=WHITE))
        times = {way: statistics.median(seconds(path, way) for _ in range(3)) for way in ALGORITHMS}
    results: dict[str, Any] = {
        name: {way: statistics.mean(found) for way, found in by_way.items()}
        for name, by_way in errors.items()
    }
    for way in ("ours", *ALGORITHMS):
        row = "  ".join(f"{results[name][way]:6.2f} dB" for name in errors)
        print(f"{way:8} {row}  {times.get(way, float('nan')):6.2f} s")
    write_record(args.out, "raw_demosaic", PACKAGES, {"psnr_db": results, "seconds_12_mpx": times})


def by_libraw(path: Path, way: str) -> np.ndarray:
    """Balanced radiance as LibRaw develops it by itself, in a scale of its own."""
    with rawpy.imread(str(path)) as raw:
        codes = raw.postprocess(
            demosaic_algorithm=rawpy.DemosaicAlgorithm[way],
            output_color=rawpy.ColorSpace.raw,
            output_bps=16,
            gamma=(1.0, 1.0),
            user_wb=[*BALANCE, 1.0],
            user_flip=0,
            no_auto_bright=True,
            adjust_maximum_thr=0.0,
            highlight_mode=rawpy.HighlightMode.Ignore,
        )
    return np.asarray(codes / 65535.0)


def seconds(path: Path, way: str) -> float:
    """What a development takes, without opening the file."""
    with rawpy.imread(str(path)) as raw:
        raw.raw_image  # noqa: B018 - unpacks
        start = time.perf_counter()
        raw.postprocess(demosaic_algorithm=rawpy.DemosaicAlgorithm[way], output_bps=16, no_auto_bright=True)
        return time.perf_counter() - start


def psnr_db(found: np.ndarray, truth: np.ndarray) -> float:
    """Of display values, at the scale that fits best."""
    found = found * (np.sum(found * truth) / np.sum(found * found))
    inside = np.s_[EDGE_PX:-EDGE_PX, EDGE_PX:-EDGE_PX]
    error = to_display(np.clip(found[inside], 0, 1)) - to_display(truth[inside])
    return float(-10 * np.log10(np.mean(error**2)))


def dng_writer() -> Any:
    """The DNG writer of the tests."""
    spec = importlib.util.spec_from_file_location("dng_writer", ROOT / "tests/capture/raw/conftest.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


if __name__ == "__main__":
    main()
