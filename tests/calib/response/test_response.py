"""A known response is found again from simulated sweeps, with an honest uncertainty, and bad ones refused."""

import csv
import json
import struct

import numpy as np
import pytest

from calib.calibration import load_calibration
from calib.errors import ResponseError
from calib.response.check import compare_opencv, nearest_curve
from calib.response.fit import fit_response
from calib.response.groups import SweepFrame, gather_groups, grouped_median
from calib.stills import read_stills
from capture.controls import Controls
from capture.errors import SourceError
from capture.frame_record import FrameRecord
from capture.images import write_jpeg, write_png
from capture.session import Session
from capture.sim.sensor import SensorConfig
from capture.transfer import to_display, to_linear
from relight.cli import main

TIMES_S = np.geomspace(1 / 2000, 1 / 15, 10)


def scene(rng, height=120, width=160):
    """[H, W, 3] radiance at 1/60 s: patches with some texture, behind a lens that darkens its corners."""
    y, x = np.mgrid[0:height, 0:width]
    patches = np.kron(rng.uniform(0.05, 1.0, (6, 8)), np.ones((20, 20)))
    r2 = ((x - width / 2) ** 2 + (y - height / 2) ** 2) / (width**2 / 4 + height**2 / 4)
    texture = 1 + 0.05 * rng.standard_normal((height, width))
    return (patches * (1 - 0.35 * r2) * texture)[..., None] * np.array([0.8, 1.0, 0.6])


def sweep(transfer, seed=3, times_s=TIMES_S, jitter=0.0, wrong=None):
    """Frames of the simulated sensor; `wrong` is a frame and the factor that its light is off by."""
    rng = np.random.default_rng(seed)
    radiance = scene(rng)
    sensor = SensorConfig(transfer=transfer, seed=seed)
    frames = []
    for k, time_s in enumerate(times_s):
        off = np.exp(jitter * rng.standard_normal()) * (wrong[1] if wrong and wrong[0] == k else 1.0)
        frames.append(SweepFrame(f"f{k}", time_s, sensor.develop(radiance * time_s * off * 60, k)))
    return frames


def errors_of(result, transfer):
    """(error, standard deviation) of what was measured, 8 codes and more above black."""
    measured = (result.stored >= max(0.03, result.covered[0])) & (result.stored <= result.covered[1])
    truth = to_linear(result.stored, transfer)
    return (result.linear - truth)[measured], result.sigma[measured]


@pytest.mark.parametrize("transfer", ["linear", "srgb", "rec709", "gamma:2.2", "log:100"])
def test_a_known_curve_is_found_again(transfer):
    result = fit_response(gather_groups(sweep(transfer)))
    error, sigma = errors_of(result, transfer)
    assert result.linear.ndim == 1  # the channels have one curve
    # Half a percent of white: three times the largest of the stated standard deviations, 0.0022 or less.
    assert np.abs(error).max() < 0.005
    assert sigma.max() < 0.003
    assert result.linearity < 0.01
    assert (np.diff(result.linear) >= 0).all()
    assert not result.warnings
    if transfer in ("linear", "srgb", "gamma:2.2"):
        assert nearest_curve(result).name == transfer


def test_the_stated_uncertainty_is_that_of_the_errors():
    ratios = []
    for seed in range(5):
        result = fit_response(gather_groups(sweep("srgb", seed, jitter=0.005 * (seed % 2))))
        error, sigma = errors_of(result, "srgb")
        ratios.append(np.sqrt(np.mean((error / sigma) ** 2)))
    # A curve's errors go together, so 5 sweeps are about 10 numbers: rms 1 +- 0.22; rounding that is allowed
    # for but does not happen makes it smaller.
    assert 0.35 < np.sqrt(np.mean(np.square(ratios))) < 1.5


def test_exposures_that_scatter_are_in_the_uncertainty():
    steady = fit_response(gather_groups(sweep("srgb", 4)))
    shaky = fit_response(gather_groups(sweep("srgb", 4, jitter=0.02)))
    assert steady.jitter < 0.001
    assert 0.01 < shaky.jitter < 0.04  # 2 %, from ten numbers less two
    # 2 % of ten exposures leave a power of 0.02 / sqrt(sum of squares of ln t) = 0.4 % open.
    assert shaky.sigma[100] > 1.3 * steady.sigma[100]
    assert "scatter" in shaky.warnings[0]


@pytest.mark.parametrize("wrong", [(0, 1.1), (4, 0.9), (9, 1.2), (5, 1.04)])
def test_an_exposure_that_is_not_what_it_says_is_named_and_left_out(wrong):
    result = fit_response(gather_groups(sweep("srgb", jitter=0.002, wrong=wrong)))
    (frame,) = [check for check in result.frames if not check.used]
    assert frame.name == f"f{wrong[0]}"
    # Scatter of 0.2 % of this frame and of the line through the others.
    assert frame.off == pytest.approx(wrong[1] - 1, abs=0.012)
    assert frame.name in result.warnings[0]
    assert np.abs(errors_of(result, "srgb")[0]).max() < 0.006


def test_a_dark_level_that_is_known_is_taken_off():
    rng = np.random.default_rng(1)
    radiance, sensor, pedestal = scene(rng), SensorConfig(seed=1), 0.06
    frames = []
    for k, time_s in enumerate(TIMES_S):
        light = radiance * time_s * 60
        noisy = light + sensor.noise_sigma(light) * rng.standard_normal(light.shape)
        encoded = np.sign(noisy) * to_display(np.minimum(np.abs(noisy), 1.0), "srgb")
        stored = np.clip(pedestal + (1 - pedestal) * encoded, 0, 1)
        frames.append(SweepFrame(f"f{k}", time_s, np.rint(65535 * stored).astype(np.uint16)))
    result = fit_response(gather_groups(frames), np.full(3, pedestal))
    measured = (result.stored > 0.03) & (result.stored < result.covered[1])
    truth = to_linear(result.stored / (1 - pedestal), "srgb")
    assert np.abs(result.linear - truth)[measured].max() < 0.005  # as without a dark level
    assert np.interp(1 - pedestal, result.stored, result.linear) == pytest.approx(1.0, abs=1e-3)


def test_a_part_that_moves_is_left_out():
    frames = []
    for k, frame in enumerate(sweep("srgb")):
        image = frame.image.copy()
        image[:, :40] = np.roll(image[:, :40], 9 * k, axis=0)
        frames.append(SweepFrame(frame.name, frame.exposure_s, image))
    result = fit_response(gather_groups(frames))
    assert 0.05 < result.moved < 0.25
    assert np.abs(errors_of(result, "srgb")[0]).max() < 0.005


def test_channels_with_different_curves_get_one_each():
    frames = [
        SweepFrame(
            one.name, one.exposure_s, np.stack([one.image[..., 0], *np.moveaxis(other.image, 2, 0)[1:]], -1)
        )
        for one, other in zip(sweep("gamma:1.8"), sweep("srgb"), strict=True)
    ]
    result = fit_response(gather_groups(frames))
    assert result.linear.shape == (256, 3)
    assert result.linear[128, 0] == pytest.approx(to_linear(np.array(128 / 255.0), "gamma:1.8"), abs=0.01)
    assert result.linear[128, 1] == pytest.approx(to_linear(np.array(128 / 255.0), "srgb"), abs=0.01)
    assert "different curves" in result.warnings[0]


def test_opencv_agrees_within_its_own_scatter():
    frames = sweep("srgb")
    others = compare_opencv(frames, fit_response(gather_groups(frames)))
    assert [other.name for other in others] == ["Debevec (OpenCV)", "Robertson (OpenCV)"]
    # Noise of single pixels, and Debevec's smoothing: up to a tenth.
    assert all(other.median < 0.1 for other in others)


def test_a_grouped_median_finds_what_was_rounded():
    rng = np.random.default_rng(5)
    truth = rng.uniform(20, 30, 300)
    blocks = np.rint(truth[:, None, None] + 1.3 * rng.standard_normal((300, 400, 1))).astype(np.uint8)
    median, spread = grouped_median(blocks)
    # 1.2533 * sqrt(1.3^2 + 1/12) / sqrt(400) = 0.083 each.
    assert np.std(median[:, 0] - truth) < 0.11
    assert abs(np.mean(median[:, 0] - truth)) < 0.02
    assert np.median(spread) == pytest.approx(1.3, abs=0.3)


def _shifted(frames):
    return [
        SweepFrame(frame.name, frame.exposure_s, np.roll(frame.image, (17 * k, 13 * k), (0, 1)))
        for k, frame in enumerate(frames)
    ]


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        (lambda: sweep("srgb", times_s=np.geomspace(0.001, 0.1, 3)), "3 different exposure times"),
        (lambda: sweep("srgb", times_s=np.geomspace(0.01, 0.02, 6)), "2 times the shortest"),
        (lambda: sweep("srgb", times_s=np.geomspace(1e-6, 1e-5, 8)), "too dark"),
        (lambda: sweep("srgb", times_s=np.geomspace(1, 10, 8)), "saturated"),
        (lambda: sweep("srgb", times_s=np.geomspace(1e-4, 3e-3, 8)), "reach up to white"),
        (lambda: _shifted(sweep("srgb")), "does not follow|moved"),
        (
            lambda: [SweepFrame(f.name, f.exposure_s, sweep("srgb")[5].image) for f in sweep("srgb")],
            "automatic",
        ),
        (
            lambda: [
                SweepFrame(f.name, float(TIMES_S[3 * k % 10]), f.image) for k, f in enumerate(sweep("srgb"))
            ],
            "does not follow",
        ),
        (lambda: [SweepFrame("a", 0.1, np.zeros((40, 40, 3), np.float32))], "linear already"),
        (lambda: [SweepFrame("a", 0.0, np.zeros((40, 40, 3), np.uint8))], "positive"),
        (lambda: [SweepFrame("a", 0.1, np.zeros((8, 8, 3), np.uint8))], "at least 32"),
        (
            lambda: [SweepFrame("a", 0.1, np.zeros((n, n, 3), np.uint8)) for n in (40, 50)],
            "one size and format",
        ),
        (list, "no pictures"),
    ],
)
def test_a_poor_sweep_is_refused_with_its_reason(frames, words):
    with pytest.raises(ResponseError, match=words):
        fit_response(gather_groups(frames()))


def test_a_folder_with_a_list_becomes_a_response(tmp_path, capsys, read_page):
    folder = tmp_path / "sweep"
    folder.mkdir()
    with (folder / "exposures.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["picture", "exposure_s"])
        for frame in sweep("srgb"):
            write_png(folder / f"{frame.name}.png", frame.image)
            writer.writerow([f"{frame.name}.png", frame.exposure_s])
    out = tmp_path / "calibration.json"
    assert main(["calibrate", "response", str(folder), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "10 of 10 pictures used" in said
    assert "beside      srgb" in said
    response = load_calibration(out).response
    codes = np.arange(10, 250, dtype=np.uint8)[:, None].repeat(3, axis=1)
    assert np.abs(response.to_linear(codes) - to_linear(codes, "srgb")).max() < 0.005
    evidence = json.loads((tmp_path / "calibration.response.json").read_text())
    assert len(evidence["frames"]) == 10
    assert len(evidence["sigma"]) == 256
    page = read_page(out)
    assert "Response</td><td>good" in page
    assert "Debevec (OpenCV)" in page


def test_a_session_s_own_exposures_count_and_the_response_goes_into_it(tmp_path):
    frames = sweep("srgb")
    height, width = frames[0].image.shape[:2]
    path = tmp_path / "session"
    with Session.create(path, source={"kind": "test"}, width=width, height=height) as session:
        for index, frame in enumerate(frames):
            file = session.write_frame(index, frame.image)
            session.append_frame(
                FrameRecord(index=index, file=file, width=width, height=height, exposure_s=frame.exposure_s)
            )
    assert main(["calibrate", "response", str(path), "--out", str(path)]) == 0
    session = Session.open(path)
    radiance = session.load_radiance(session.frames[5])
    assert np.abs(radiance - to_linear(frames[5].image, "srgb")).max() < 0.006


def test_a_camera_is_driven_through_its_sweep(tmp_path, capsys):
    url = "fake-v4l2:seed=1;width=160;height=120"
    arguments = ["calibrate", "response", "--camera", url, "--steps", "9", "--frames", "1"]
    kept = tmp_path / "kept"
    assert main([*arguments, "--keep", str(kept), "--out", str(tmp_path / "live.json")]) == 0
    assert "beside      srgb" in capsys.readouterr().out
    live = load_calibration(tmp_path / "live.json").response
    truth = to_linear(live.stored, "srgb")
    assert np.abs(live.linear - truth).max() < 0.015  # JPEG of 8 x 8 blocks, 160 x 120 pixels
    assert main(["calibrate", "response", str(kept), "--out", str(tmp_path / "kept.json")]) == 0
    again = load_calibration(tmp_path / "kept.json").response
    assert np.allclose(again.linear, live.linear, atol=1e-9)


def test_a_curve_can_be_named(tmp_path, capsys):
    out = tmp_path / "calibration.json"
    assert main(["calibrate", "response", "--name", "strong", "--out", str(out)]) == 0
    assert load_calibration(out).response.transfer == "log:224@64"
    assert main(["calibrate", "response", "--name", "nice", "--out", str(out)]) == 1
    assert "extra_strong" in capsys.readouterr().err


def test_exif_tells_the_exposure(tmp_path):
    picture = tmp_path / "a.jpg"
    write_jpeg(picture, np.zeros((32, 32, 3), np.uint8))
    entries = [(33434, 5, 1, 44), (34855, 3, 1, 200)]
    tiff = b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", 2)
    tiff += b"".join(struct.pack("<HHII", *entry) for entry in entries) + struct.pack("<I", 0)
    tiff += bytes(44 - len(tiff)) + struct.pack("<II", 1, 50)
    block = b"Exif\0\0" + tiff
    data = picture.read_bytes()
    picture.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(block) + 2) + block + data[2:])
    (still,) = read_stills([picture])
    assert still.exposure_s == pytest.approx(2 / 50)  # 1/50 s at ISO 200, as ISO 100
    assert still.controls == Controls(width=32, height=32, exposure_s=1 / 50, gain=2.0)


@pytest.mark.parametrize(
    ("content", "words"), [("", "lists no pictures"), ("a.png, soon\nb.png, 1/50\nc.png, 0\n", "'c.png")]
)
def test_a_list_that_says_no_times_is_refused(tmp_path, content, words):
    write_png(tmp_path / "b.png", np.zeros((32, 32, 3), np.uint8))
    (tmp_path / "exposures.csv").write_text(content)
    with pytest.raises(SourceError, match=words):
        list(read_stills([tmp_path]))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "one of the three"),
        (["nowhere"], "nowhere does not exist"),
        (["--name", "srgb", "--keep", "k"], "--keep goes with --camera"),
        (["--camera", "sofa:"], "names no camera"),
    ],
)
def test_what_cannot_be_done_is_one_sentence(tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert main(["calibrate", "response", *arguments, "--out", "c.json"]) == 1
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
