"""The readout of a known rolling shutter is found within its stated uncertainty and given to the tagger."""

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.blinking_video import Video, frames
from calib.calibration import load_calibration
from calib.errors import ReadoutError
from calib.sensor.readout import judge_readout
from capture.calibration_file import Quantity, write_calibration_entries
from capture.controls import Controls, controls_of_session
from capture.errors import CalibrationError
from capture.frame_record import FrameRecord
from capture.session import Session
from capture.tagging import ProfileAccumulator, TaggingConfig
from capture.tagging.given_readout import with_given_readout
from capture.tagging.readout import measure_readout
from capture.video import VideoWriter
from relight.cli import main

# Thirteen flashes whose period is no multiple of the frame interval, filmed by hand.
FILM = Video(
    width=160, height=90, duration_s=8.5, period_s=0.647, on_s=0.08, motion="hand", background_gain=0.1
)
# 97.5 % of a normal distribution.
WITHIN = 1.96


def measured(video):
    accumulator = ProfileAccumulator(video.width, video.height, transfer="srgb")
    for picture, pts_s in frames(video):
        accumulator.add(picture, pts_s)
    return measure_readout(accumulator.profiles(), TaggingConfig(exposure_s=video.exposure_s))


def judged(found):
    return judge_readout(
        found.readout_s, found.fit_sigma_s, found.exposure_s, found.interval_s, found.on_s, found.without_s
    )


@pytest.mark.parametrize(("readout_s", "seed"), [(0.010, 0), (-0.033, 2)])  # 0.020: below, out of a film
def test_a_known_readout_is_within_its_stated_uncertainty(readout_s, seed):
    result = judged(measured(replace(FILM, readout_s=readout_s, seed=seed)))
    assert abs(result.readout_s - readout_s) < WITHIN * result.sigma_s
    assert result.sigma_s < 0.1 * abs(readout_s)
    assert result.flashes == 13


def test_a_global_shutter_has_no_readout():
    with pytest.raises(ReadoutError, match="told from none"):
        judged(measured(replace(FILM, readout_s=0.0, exposure_s=0.008, seed=3)))


def given_fits(rng, noise_s, truth_s=0.02, flashes=24):
    """Of an estimator whose law is known: the mean of one number a flash; and without each fourth of them."""
    values = truth_s + noise_s * rng.standard_normal(flashes)
    parts = [values[np.arange(flashes) % 4 != number].mean() for number in range(4)]
    return values.mean(), parts


def test_the_spread_over_parts_covers_the_truth_as_often_as_it_says():
    rng = np.random.default_rng(0)
    on_s = 1.013 * np.arange(24)
    inside, trials = 0, 2000
    for _ in range(trials):
        readout_s, parts_s = given_fits(rng, 0.002)
        result = judge_readout(readout_s, 0.0, 0.0, 1 / 30, on_s, parts_s)
        inside += abs(readout_s - 0.02) < WITHIN * result.sigma_s
    # The share of 2000 trials has a deviation of 0.005; what the model leaves comes on top: it may be more.
    assert 0.935 < inside / trials < 0.98


STEADY = {"readout_s": 0.02, "fit_sigma_s": 1e-4, "exposure_s": 0.005, "interval_s": 1 / 30, "without_s": ()}


@pytest.mark.parametrize(
    ("other", "words"),
    [
        ({"on_s": 1.013 * np.arange(5)}, "5 flashes are too few"),
        ({"on_s": []}, "0 flashes are too few"),
        ({"on_s": 1.0 * np.arange(30)}, "in step with the camera"),
        ({"readout_s": 1e-4, "fit_sigma_s": 1e-6}, "told from none"),
        ({"readout_s": -0.004, "fit_sigma_s": 0.003}, "told from none"),
        ({"fit_sigma_s": 0.004}, "known to 20% only"),
        ({"without_s": [0.0188, 0.02, 0.0212, 0.02]}, "known to 12% only"),
    ],
)
def test_what_does_not_tell_a_readout_is_refused(other, words):
    told = STEADY | {"on_s": 1.013 * np.arange(30)}
    assert judge_readout(**told).sigma_s == pytest.approx(np.hypot(1e-4, 0.015 * 0.025))
    with pytest.raises(ReadoutError, match=words) as refusal:
        judge_readout(**(told | other))
    assert str(refusal.value).endswith(".")


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """A film as a file, with frames at their own times."""
    path = tmp_path_factory.mktemp("film") / "film.mp4"
    with VideoWriter(path, 160, 90, crf=8) as writer:
        for picture, pts_s in frames(replace(FILM, motion="still", seed=4)):
            writer.write(np.repeat(picture[..., None], 3, axis=2) if picture.ndim == 2 else picture, pts_s)
    return path


def test_a_film_becomes_an_entry_that_an_import_is_given(film, tmp_path, capsys):
    out = tmp_path / "calibration.json"
    flags = ["--exposure-ms", "5", "--transfer", "srgb", "--out", str(out)]
    assert main(["calibrate", "readout", str(film), *flags]) == 0
    said = capsys.readouterr().out
    assert "the top row first, from 13 flashes; holds for 160 x 90 at 30 frames a second" in said
    entry = load_calibration(out).readout_s
    assert abs(entry.value - 0.02) < WITHIN * entry.sigma
    assert (entry.unit, entry.source) == ("s", "13 flashes of film.mp4")
    assert entry.made_with == Controls(width=160, height=90, rate_hz=pytest.approx(30.0, rel=1e-3))

    given, fitted = tmp_path / "given", tmp_path / "fitted"
    arguments = ["import", str(film), "--transfer", "srgb", "--out"]
    assert main([*arguments, str(given), "--calibration", str(out)]) == 0
    told = json.loads((given / "session.json").read_text())["tagging"]
    assert (told["readout_s"], told["readout_sigma_s"]) == (pytest.approx(float(entry.value)), 0.0)
    # What was given is no measurement of it.
    assert main(["calibrate", "readout", str(given), "--out", str(out)]) == 1
    assert "no readout that was measured in it" in capsys.readouterr().err

    assert main([*arguments, str(fitted)]) == 0
    again = tmp_path / "again.json"
    assert main(["calibrate", "readout", str(fitted), "--out", str(again)]) == 0
    found = load_calibration(again).readout_s
    assert abs(found.value - 0.02) < WITHIN * found.sigma
    assert found.made_with.rate_hz == pytest.approx(30.0, rel=1e-3)


LIGHT = {
    "readout_s": -0.0151,
    "readout_sigma_s": 2e-4,
    "exposure_s": 0.005,
    "period_s": 1.013,
    "pulses": 40,
}


def captured(path, light):
    """A session as a capture leaves it, of a camera that promises 30 frames a second."""
    device = {"camera": {"name": "C920"}, "stream": {"fps": 30.0}}
    with Session.create(
        path, source={"kind": "capture"}, width=64, height=48, transfer="srgb", device=device
    ) as session:
        session.update_info(capture={"light": light})
        session.finish()
    return str(path)


def test_what_a_capture_recorded_is_taken_with_a_wider_uncertainty(tmp_path, capsys):
    out = tmp_path / "calibration.json"
    assert main(["calibrate", "readout", captured(tmp_path / "S", LIGHT), "--out", str(out)]) == 0
    assert "the bottom row first, from 40 flashes" in capsys.readouterr().out
    entry = load_calibration(out).readout_s
    assert entry.value == -0.0151
    assert entry.sigma == pytest.approx(np.hypot(2e-4, 0.015 * 0.0201))
    assert entry.made_with == Controls(camera="C920", width=64, height=48, rate_hz=30.0)


@pytest.mark.parametrize(
    ("light", "words"),
    [
        (None, "no readout that was measured in it"),
        (LIGHT | {"readout_s": None, "readout_sigma_s": None}, "no readout that was measured in it"),
        (LIGHT | {"period_s": 1.0}, "in step with the camera"),
        (LIGHT | {"period_s": None}, "in step with the camera"),
        (LIGHT | {"pulses": 4}, "4 flashes are too few"),
    ],
)
def test_a_capture_that_does_not_tell_is_refused(tmp_path, capsys, light, words):
    out = tmp_path / "calibration.json"
    assert main(["calibrate", "readout", captured(tmp_path / "S", light), "--out", str(out)]) == 1
    assert words in capsys.readouterr().err
    assert not out.exists()


def test_a_readout_is_given_where_size_and_rate_are_its_own(tmp_path):
    path = tmp_path / "calibration.json"
    made_with = Controls(width=1920, height=1080, rate_hz=30.0)
    entry = Quantity.of(-0.0201, "s", "30 flashes", 2e-4, made_with)
    write_calibration_entries(path, {"readout_s": entry.to_json()})
    config = TaggingConfig(exposure_s=0.005)
    known = with_given_readout(config, path, Controls(width=1920, height=1080, rate_hz=29.97))
    assert known == replace(config, readout_s=-0.0201, readout_sigma_s=2e-4)
    for live in (
        Controls(width=1280, height=720, rate_hz=30.0),
        Controls(width=1920, height=1080, rate_hz=60.0),
    ):
        assert with_given_readout(config, path, live) == config
    write_calibration_entries(tmp_path / "empty.json", {})
    assert with_given_readout(config, tmp_path / "empty.json", made_with) == config
    assert with_given_readout(config, None, made_with) == config
    with pytest.raises(CalibrationError):
        with_given_readout(config, tmp_path / "none.json", made_with)


@pytest.mark.parametrize(
    ("value", "sigma", "live"),
    [(0.05, 1e-4, Controls(rate_hz=30.0)), (0.02, 0.5, Controls(rate_hz=30.0)), (-20.0, 0.06, Controls())],
)
def test_what_is_no_readout_of_a_frame_is_refused(tmp_path, value, sigma, live):
    path = tmp_path / "calibration.json"
    write_calibration_entries(path, {"readout_s": Quantity.of(value, "s", "by hand", sigma).to_json()})
    with pytest.raises(CalibrationError, match="that a frame takes"):
        with_given_readout(TaggingConfig(), path, live)


@pytest.mark.parametrize(
    ("times", "promised", "rate_hz"),
    [
        ((0.0, 1 / 30, 2 / 30, 4 / 30), 60.0, 30.0),  # what came goes before what was promised
        ((), 60.0, 60.0),
        ((0.0, 1.0, 2.0), None, None),  # stills
        ((None, None), None, None),
        ((0.5,), None, None),
    ],
)
def test_a_session_tells_its_rate_by_its_frames(times, promised, rate_hz):
    info = {"device": {"stream": {"fps": promised}}, "image": {"width": 4, "height": 3}}
    records = [
        FrameRecord(index=index, file=None, width=4, height=3, pts_s=pts_s)
        for index, pts_s in enumerate(times)
    ]
    found = controls_of_session(info, records).rate_hz
    assert found == (None if rate_hz is None else pytest.approx(rate_hz))
