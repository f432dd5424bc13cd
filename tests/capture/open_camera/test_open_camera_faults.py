"""Whatever is done to a video and its sidecars, an import ends with a session or with one sentence."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from capture.errors import RelightError
from capture.importers.open_camera import import_videos
from capture.importers.options import ImportOptions
from capture.session import Session

Damage = Callable[[bytes], st.SearchStrategy[bytes]]


@pytest.fixture(scope="module")
def short_video(film, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Content of a film of one pulse."""
    return replace(film, seconds=1.2).write(tmp_path_factory.mktemp("short") / "a.mp4").read_bytes()


def check_import(folder: Path) -> None:
    out = folder / "S"
    try:
        import_videos([folder / "VID_20261102_101530.mp4"], out, ImportOptions())
    except RelightError as error:
        sentence = str(error)
    else:
        sentence = "imported."
        assert Session.open(out).status == "complete"
    assert sentence.endswith((".", ")"))
    assert "\n" not in sentence


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_video(data: st.DataObject, short_video: bytes, damage: Damage, scratch: Path) -> None:
    folder = scratch / "video"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    (folder / "VID_20261102_101530.mp4").write_bytes(data.draw(damage(short_video)))
    check_import(folder)


@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    frame_log=st.lists(st.integers(0, 2**64), max_size=40),
    flash_log=st.lists(st.integers(0, 2**64), max_size=5),
    subtitles=st.text(max_size=80),
)
def test_sidecars_that_contradict_the_video(
    frame_log: list[int], flash_log: list[int], subtitles: str, short_video: bytes, scratch: Path
) -> None:
    folder = scratch / "sidecars"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    stem = folder / "VID_20261102_101530"
    stem.with_suffix(".mp4").write_bytes(short_video)
    stem.with_suffix(".srt").write_bytes(subtitles.encode("utf-8", "surrogatepass"))
    for ending, times in (("_timestamps.csv", sorted(frame_log)), ("_flash.csv", sorted(flash_log))):
        Path(f"{stem}{ending}").write_text("\n".join(map(str, times)))
    check_import(folder)
