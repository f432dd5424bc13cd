"""Several files of one capture: found, ordered and put on one time axis by the rule the module states."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from capture.errors import SourceError
from capture.importers.recording_parts import open_recording, start_by_name
from capture.video import VideoWriter


def film(path: Path, seconds: float, *, start_s: float = 0.0, size: int = 64, **options: object) -> Path:
    """A video at 10 Hz of noise, so that its file grows with its length."""
    rng = np.random.default_rng(0)
    with VideoWriter(path, size, 64, **options) as writer:  # type: ignore[arg-type]
        for k in range(round(seconds * 10)):
            writer.write(rng.integers(0, 256, (64, size, 3)).astype(np.uint8), start_s + k / 10)
    return path


@pytest.mark.parametrize(
    ("name", "start"),
    [
        ("VID_20261102_101530.mp4", datetime(2026, 11, 2, 10, 15, 30)),
        ("VID_20261102_101530Z.mp4", datetime(2026, 11, 2, 10, 15, 30)),
        ("VID_20261102_101530_2.mp4", datetime(2026, 11, 2, 10, 15, 30)),
        ("VID_20261102_101530250.mp4", datetime(2026, 11, 2, 10, 15, 30, 250_000)),
        ("head 20261102_101530.mp4", datetime(2026, 11, 2, 10, 15, 30)),
        ("VID_20261399_101530.mp4", None),
        ("VID_20261102.mp4", None),
        ("holiday.mp4", None),
    ],
)
def test_the_start_is_in_the_name(name: str, start: datetime | None) -> None:
    assert start_by_name(Path(name)) == start


def test_a_single_file_keeps_its_own_times(tmp_path: Path) -> None:
    ended = datetime(2026, 11, 2, 9, 15, 32, tzinfo=UTC)
    path = film(tmp_path / "VID_20261102_101530.mp4", 2, start_s=0.35, creation_time=ended)
    recording = open_recording([path])
    assert [part.shift_s for part in recording.parts] == [0.0]
    assert recording.started == datetime(2026, 11, 2, 10, 15, 30)
    assert recording.ended == ended
    assert recording.warnings == ()


def test_a_split_is_found_and_joined_without_a_gap(tmp_path: Path) -> None:
    first = film(tmp_path / "VID_20261102_101530.mp4", 4, start_s=0.2)
    film(tmp_path / "VID_20261102_101534.mp4", 4, start_s=0.1)
    film(tmp_path / "VID_20261102_101538.mp4", 2)
    recording = open_recording([first])
    assert [part.video.path.name[-10:-4] for part in recording.parts] == ["101530", "101534", "101538"]
    # The second's first frame comes when the first's last frame ends, whatever its own start offset.
    assert recording.parts[1].shift_s + 0.1 == pytest.approx(0.2 + 4.0)
    assert recording.parts[2].shift_s == pytest.approx(0.2 + 8.0)
    assert "was joined to it" in recording.warnings[0]


def test_joining_can_be_declined(tmp_path: Path) -> None:
    first = film(tmp_path / "VID_20261102_101530.mp4", 4)
    film(tmp_path / "VID_20261102_101534.mp4", 2)
    assert len(open_recording([first], join_split=False).parts) == 1


@pytest.mark.parametrize(
    ("name", "seconds", "options"),
    [
        ("VID_20261102_101537.mp4", 2, {}),  # three seconds later: the next capture
        ("VID_20261102_101534.mp4", 8, {}),  # larger than the first: not the remainder of a split
        ("VID_20261102_101534.mp4", 2, {"rotation_deg": 90}),
        ("VID_20261102_101534.mp4", 2, {"size": 128}),
        ("IMG_20261102_101534.mp4", 2, {}),
        ("VID_20261102_101534Z.mp4", 2, {}),
        ("VID_20261102_101534.webm", 2, {}),
    ],
)
def test_another_capture_is_not_joined(
    name: str, seconds: int, options: dict[str, object], tmp_path: Path
) -> None:
    first = film(tmp_path / "VID_20261102_101530.mp4", 4)
    other = film(tmp_path / "other.mp4", seconds, **options)  # type: ignore[arg-type]
    other.rename(tmp_path / name)
    assert len(open_recording([first]).parts) == 1


def test_a_continuation_that_cannot_be_read_is_left_out_and_named(tmp_path: Path) -> None:
    first = film(tmp_path / "VID_20261102_101530.mp4", 4)
    (tmp_path / "VID_20261102_101534.mp4").write_bytes(b"damaged")
    recording = open_recording([first])
    assert len(recording.parts) == 1
    assert "looks like the continuation but was left out" in recording.warnings[0]


def test_files_given_together_are_put_in_order_with_their_gap(tmp_path: Path) -> None:
    first = film(tmp_path / "VID_20261102_101530.mp4", 4)
    later = film(tmp_path / "VID_20261102_101540.mp4", 8)
    recording = open_recording([later, first])
    assert [part.video.path for part in recording.parts] == [first, later]
    assert recording.parts[1].shift_s == pytest.approx(10.0)
    assert "6.0 s are missing" in recording.warnings[0]


def test_files_without_times_in_their_names_keep_the_given_order(tmp_path: Path) -> None:
    b, a = film(tmp_path / "b.mp4", 1), film(tmp_path / "a.mp4", 1)
    recording = open_recording([b, a])
    assert [part.video.path for part in recording.parts] == [b, a]
    assert recording.parts[1].shift_s == pytest.approx(1.0)
    assert "names do not tell the time" in recording.warnings[0]


def test_parts_that_overlap_are_refused(tmp_path: Path) -> None:
    first = film(tmp_path / "VID_20261102_101530.mp4", 6)
    second = film(tmp_path / "VID_20261102_101532.mp4", 1)
    with pytest.raises(SourceError, match=r"starts 4\.0 s before .* ends"):
        open_recording([first, second])


@pytest.mark.parametrize(
    ("option", "difference"),
    [
        ({"size": 128}, "size differs"),
        ({"rotation_deg": 90}, "rotation differs"),
        ({"codec": "hevc"}, "codec differs"),
        ({"color_range": "full"}, "colour range differs"),
        ({"matrix": "bt601"}, "colour matrix differs"),
        ({"transfer": "srgb"}, "transfer differs"),
        ({"bits": 10}, "bit depth differs"),
    ],
)
def test_files_of_different_kinds_are_no_capture(
    option: dict[str, object], difference: str, tmp_path: Path
) -> None:
    first = film(tmp_path / "VID_20261102_101530.mp4", 1)
    second = film(tmp_path / "VID_20261102_101540.mp4", 1, **option)  # type: ignore[arg-type]
    with pytest.raises(SourceError, match=difference):
        open_recording([first, second])


def test_a_file_given_twice_and_no_file_are_refused(tmp_path: Path) -> None:
    first = film(tmp_path / "a.mp4", 1)
    with pytest.raises(SourceError, match="more than once"):
        open_recording([first, tmp_path / "." / "a.mp4"])
    with pytest.raises(SourceError, match="No video"):
        open_recording([])
