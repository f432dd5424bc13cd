"""TUM's pcalib.txt and vignette.png: what is written is read again, and what cannot be is refused."""

import numpy as np
import pytest

from calib.calibration import Calibration, Quantity, load_calibration, save_calibration
from calib.errors import LensFileError
from calib.tum import read_pcalib, read_vignette, write_pcalib, write_vignette
from capture.controls import Controls
from capture.images import read_image, write_png
from capture.response import Response
from capture.transfer import to_linear
from relight.cli import main

FLAT = np.array([-0.35, 0.06, -0.02])
SIZE = Controls(width=96, height=64)


def known():
    return Calibration(response=Response("srgb"), flat_field=Quantity.of(FLAT, "1", "flats", made_with=SIZE))


def test_a_response_survives_its_file(tmp_path):
    write_pcalib(known(), tmp_path / "pcalib.txt")
    text = (tmp_path / "pcalib.txt").read_text()
    assert len(text.split()) == 256
    assert len(text.splitlines()) == 1
    codes = np.arange(256, dtype=np.uint8)
    # Six digits after the point of 255.
    assert np.abs(np.array(text.split(), float) - 255 * to_linear(codes, "srgb")).max() < 1e-4
    found = read_pcalib(tmp_path / "pcalib.txt")
    picture = np.repeat(codes[:, None], 3, axis=1)
    assert np.abs(found.to_linear(picture) - to_linear(picture, "srgb")).max() < 1e-6


def test_a_dark_level_goes_into_the_curve(tmp_path):
    with_dark = Calibration(response=Response("linear"), dark=Quantity.of([0.1] * 3, "1", "darks"))
    write_pcalib(with_dark, tmp_path / "pcalib.txt")
    values = np.array((tmp_path / "pcalib.txt").read_text().split(), float)
    expected = 255 * np.maximum(np.arange(256) / 255 - 0.1, 0) / 0.9
    assert np.abs(values - expected).max() < 1e-4


def test_a_vignette_survives_its_picture(tmp_path):
    write_vignette(known(), tmp_path / "vignette.png")
    picture = read_image(tmp_path / "vignette.png")
    assert (picture.dtype, picture.shape) == (np.uint16, (64, 96))
    v, u = 10, 80
    r2 = ((u + 0.5 - 48) ** 2 + (v + 0.5 - 32) ** 2) / (48**2 + 32**2)
    passed = 1 + FLAT @ [r2, r2**2, r2**3]
    centre = picture[31:33, 47:49].mean()
    # The centre's own pixels lie half a pixel off it, which is 1e-4 of what the lens passes.
    assert picture[v, u] / centre == pytest.approx(passed, rel=2e-4)
    found = read_vignette(tmp_path / "vignette.png")
    assert found.made_with == SIZE
    at = np.linspace(0, 1, 9)
    curves = [1 + np.stack([at**2, at**4, at**6], axis=1) @ terms for terms in (found.value, FLAT)]
    assert np.abs(curves[0] - curves[1]).max() < 3e-4


def test_files_go_there_and_back_by_the_command(tmp_path):
    path = tmp_path / "calibration.json"
    save_calibration(known(), path)
    for name in ("pcalib.txt", "vignette.png"):
        assert main(["calibrate", "convert", str(path), "--out", str(tmp_path / name)]) == 0
        again = tmp_path / "again.json"
        assert main(["calibrate", "convert", str(tmp_path / name), "--out", str(again)]) == 0
    back = load_calibration(tmp_path / "again.json")
    assert back.flat_field.value == pytest.approx(FLAT, abs=0.01)
    assert "TUM" in back.response.source


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1 2 3", "256"),
        (" ".join(["nan"] * 256), "finite"),
        (" ".join(map(str, range(255, -1, -1))), "rise"),
        (" ".join(["7"] * 256), "rise"),
        ("one two", "numbers"),
        ("", "256"),
        ("1 " * 70_000, "KiB"),
    ],
)
def test_what_is_no_response_is_refused(tmp_path, text, said):
    (tmp_path / "pcalib.txt").write_text(text)
    with pytest.raises(LensFileError, match=said):
        read_pcalib(tmp_path / "pcalib.txt")


def test_what_is_no_vignette_is_refused(tmp_path):
    write_png(tmp_path / "rgb.png", np.full((64, 96, 3), 200, np.uint8))
    write_png(tmp_path / "black.png", np.zeros((64, 96), np.uint8))
    write_png(tmp_path / "slope.png", np.tile(np.linspace(90, 250, 96).astype(np.uint8), (64, 1)))
    for name, said in (("rgb", "grey"), ("black", "black"), ("slope", "not radial"), ("none", "read")):
        with pytest.raises(LensFileError, match=said):
            read_vignette(tmp_path / f"{name}.png")


def test_what_is_not_known_is_not_written(tmp_path, capsys):
    path = tmp_path / "calibration.json"
    save_calibration(Calibration(flat_field=Quantity.of(FLAT, "1", "flats")), path)
    for name, said in (("pcalib.txt", "no response"), ("vignette.png", "size of pictures")):
        assert main(["calibrate", "convert", str(path), "--out", str(tmp_path / name)]) != 0
        assert said in capsys.readouterr().err
        assert not (tmp_path / name).exists()
    assert main(["calibrate", "convert", str(path), "--out", str(tmp_path / "lens.yml")]) != 0
