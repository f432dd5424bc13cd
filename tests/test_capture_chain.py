"""The whole chain: the real firmware lights a simulated sitter, who is recorded, fitted and relit."""

import json

import numpy as np
import pytest
from flash_doubles import LiveDevice, build

from capture.cli import main as relight_capture
from capture.images import read_image
from capture.session import Session
from relight.cli import main as relight

SECONDS = 6


@pytest.fixture(scope="module", params=["simavr", "host"])
def captured(request, tmp_path_factory):
    """Session, and the lamp's edges by CLOCK_MONOTONIC: the chip's image in simavr, or the C on the host."""
    base = tmp_path_factory.getbasetemp()
    programs = (base.parent if base.name.startswith("popen-") else base) / "flash_doubles"
    work = tmp_path_factory.mktemp("chain")
    if request.param == "simavr":
        command = build(programs, "runner"), build(programs, "flash.elf")
    else:
        command = (build(programs, "flash_double"),)
    device = LiveDevice(*command, edges_file=work / "edges")
    try:
        camera = f"sim:coarse;fps=29.6;edges={work / 'edges'}"
        code = relight_capture(
            [
                *("--flash", device.path, "--camera", camera, "--duration", str(SECONDS)),
                *("--quiet", "--out", str(work / "S")),
            ]
        )
        assert code == 0
        lamp = device.lamp()
    finally:
        device.close()
    return Session.open(work / "S"), lamp


def test_the_firmware_blinks_once_a_second_and_ends_dark(captured):
    session, lamp = captured
    on_s = np.array([time_s for time_s, on in lamp if on])
    off_s = np.array([time_s for time_s, on in lamp if not on])
    assert len(on_s) == len(off_s) >= SECONDS - 1
    # The chip's tick is 4 us; the host sees its clock through a pseudo-terminal.
    np.testing.assert_allclose(np.diff(on_s), 30.382 / 29.6, atol=1e-3)
    np.testing.assert_allclose(off_s - on_s, 0.1, atol=1e-4)
    assert session.info["device"]["flash"]["back_end"] == "serial"


def test_no_frame_is_tagged_against_the_lamps_real_light(captured):
    """Judged by the edges that the chip's own clock gives, not by anything that the host believes."""
    session, lamp = captured
    sensor_readout_s, lit, unlit = 0.020, 0, 0
    for record in session.frames:
        start_s = record.device_timestamp_ns * 1e-9
        end_s = start_s + sensor_readout_s + record.exposure_s
        touched = any(
            on < end_s and start_s < off + 0.001
            for (on, _), (off, _) in zip(lamp[::2], lamp[1::2], strict=True)
        )
        full = any(
            on + 0.0015 <= start_s and end_s <= off
            for (on, _), (off, _) in zip(lamp[::2], lamp[1::2], strict=True)
        )
        lit += record.flash == 1
        unlit += record.flash == 0
        # The lamp's rise is half over after 0.7 ms; a frame that begins within it is 98 % lit all the same.
        assert not (record.flash == 0 and full), record
        assert not (record.flash == 1 and not touched), record
    assert lit >= SECONDS
    assert unlit >= 20 * SECONDS


def test_the_reported_edges_lie_on_the_frames_axis_to_a_millisecond(captured):
    session, lamp = captured
    first = session.frames[0]
    zero_s = first.device_timestamp_ns * 1e-9 - first.pts_s
    reported = [json.loads(line) for line in (session.path / "flash.jsonl").read_text().splitlines()]
    on_s = np.array([edge["time_s"] for edge in reported if edge["on"]]) + zero_s
    true_s = np.array([time_s for time_s, on in lamp if on])[: len(on_s)]
    # Round trips through a pseudo-terminal on a busy machine; idle it is a tenth of this.
    assert np.max(np.abs(on_s - true_s)) < 2e-3


def test_what_was_captured_is_fitted_and_relit(captured, tmp_path):
    session, _ = captured
    assert relight(["fit", str(session.path), "--device", "cpu"]) == 0
    assert (
        relight(["render", str(session.path), "--light", "room", "--light", "flash", "--out", str(tmp_path)])
        == 0
    )
    pictures = [read_image(path).astype(float) for path in sorted(tmp_path.rglob("*.png"))]
    assert len(pictures) >= 2
    assert all(20 < picture.max() <= 255 and picture.std() > 5 for picture in pictures)
    metrics = json.loads(next((session.path / "portraits").rglob("metrics.json")).read_text())
    assert metrics
