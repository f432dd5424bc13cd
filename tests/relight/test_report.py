"""report.html: everything that lies in the folder is shown, nothing from elsewhere, and no text is code."""

import json
import re

import numpy as np
import pytest

from capture.frame_record import FrameRecord
from capture.images import write_jpeg
from capture.session import Session
from relight.errors import PortraitError
from relight.report import write_report

PLAN = {
    "decisions": [
        {
            "name": "room_shading",
            "action": "skip",
            "reason": "dark <room>",
            "saving": "much",
            "forced": False,
        },
        {"name": "poses", "action": "given", "reason": "poses of 3 frames", "saving": "", "forced": False},
    ],
    "frames": [0, 1],
}
METRICS = {
    "points": 195446,
    "device": "cpu (2 threads)",
    "seconds": {"read": 0.5, "solve": 12.25},
    "total_s": 12.75,
    "peak_memory_mb": 1390.0,
    "finished": "2026-11-22T07:00:00+00:00",
    "versions": {"torch": "2.13"},
    "warnings": ["the flash is <b>weak</b>"],
}
EVALUATION = {
    "truth": "rig",
    "views": 2,
    "normals": {"mean_deg": 4.3, "median_deg": 2.9, "within_10_deg": 0.9, "views": 2},
}


@pytest.fixture
def session(tmp_path):
    """A session of three frames with the portrait "solve" in which every part of a report is there."""
    path = tmp_path / "S"
    with Session.create(path, source={"kind": "test"}, width=8, height=6) as made:
        for index, (flash, reasons) in enumerate([(1, ()), (0, ()), (None, ("partial_flash", "<odd>"))]):
            file = made.write_frame(index, np.zeros((6, 8, 3), np.uint8))
            made.append_frame(
                FrameRecord(index=index, file=file, width=8, height=6, flash=flash, reasons=reasons)
            )
    folder = path / "portraits" / "solve"
    (folder / "previews").mkdir(parents=True)
    for name, content in (("portrait", {}), ("plan", PLAN), ("metrics", METRICS), ("evaluation", EVALUATION)):
        (folder / f"{name}.json").write_text(json.dumps(content))
    previews = []
    for group in ("relit", "captured", "maps", "orbit"):
        write_jpeg(folder / "previews" / f"{group}.jpg", np.full((6, 8, 3), 128, np.uint8))
        previews.append({"file": f"{group}.jpg", "group": group, "caption": f"a {group} & more"})
    (folder / "previews" / "previews.json").write_text(json.dumps({"previews": previews}))
    return path


def read(session):
    return write_report(session, "solve").read_text()


def test_every_part_is_shown(session):
    page = read(session)
    for said in ("S · solve", "195,446", "12.8 s on cpu", "1,390 MB", "room shading", "skipped", "4.30°"):
        assert said in page, said
    assert page.count("<figure>") == 4
    for title in ("Relit", "Captured and rendered", "Around the head", "Plan", "Frames", "Time and memory"):
        assert f"<h2>{title}</h2>" in page, title


def test_the_file_stands_alone(session):
    page = read(session)
    assert page.count('src="data:image/jpeg;base64,') == 4
    for outside in ("http:", "https:", "<script", "<link", "@import", "url("):
        assert outside not in page


def test_text_is_never_markup(session):
    page = read(session)
    assert "dark &lt;room&gt;" in page
    assert "the flash is &lt;b&gt;weak&lt;/b&gt;" in page
    assert "a relit &amp; more" in page
    assert "&lt;odd&gt;" in page


def test_the_strip_has_a_bar_for_every_frame_and_its_flash(session):
    bars = re.findall(r'<rect class=(\w+) x="(\d+)" y="[\d.]+" width="[\d.]+" height="(\d+)"', read(session))
    assert bars == [("lit", "0", "40"), ("unlit", "1", "40"), ("partial", "2", "18")]


@pytest.mark.parametrize("missing", ["plan", "metrics", "evaluation", "previews/previews"])
def test_what_is_not_there_has_no_section(session, missing):
    (session / "portraits" / "solve" / f"{missing}.json").unlink()
    page = read(session)
    titles = {
        "plan": "Plan",
        "metrics": "Time and memory",
        "evaluation": "Measured against the truth",
        "previews/previews": "Relit",
    }
    assert f"<h2>{titles[missing]}</h2>" not in page
    assert page.endswith("</html>\n")


def test_tags_are_closed(session):
    page = re.sub(r"<style>.*?</style>|<!doctype html>", "", read(session), flags=re.DOTALL)
    open_tags = []
    for closing, tag in re.findall(r"<(/?)([a-z0-9]+)[^>]*>", page):
        if closing:
            assert open_tags.pop() == tag
        elif tag not in ("meta", "img"):
            open_tags.append(tag)
    assert open_tags == []


def test_a_portrait_that_is_not_there_is_said(session):
    with pytest.raises(PortraitError, match="no portrait 'other'"):
        write_report(session, "other")


def test_damaged_metrics_are_said(session):
    (session / "portraits" / "solve" / "metrics.json").write_text("{")
    with pytest.raises(PortraitError, match=r"metrics\.json"):
        write_report(session, "solve")
