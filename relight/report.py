"""report.html: one file that shows what a portrait is made of, what it looks like and how good it is.

It is put together from what lies in the session and the portrait's folder, so it can be written again at any
time; what is not there (measures without a truth, say) has no section. Pictures are embedded: the file can be
sent.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from capture.atomic import atomic_write
from capture.frame_record import FrameRecord
from capture.json_fields import read_json
from capture.session import Session
from relight.errors import PortraitError
from relight.measure_table import measure_rows
from relight.report_style import CSS

_GROUPS = (
    ("relit", "Relit", "The same head under lights that were never there.", "grid"),
    (
        "captured",
        "Captured and rendered",
        "Left the frame, right the portrait under the same light.",
        "grid pairs",
    ),
    ("maps", "What the light was taken apart into", "", "grid"),
    ("orbit", "Around the head", "", "grid wide"),
    ("masks", "What was taken for the subject", "", "grid"),
)

_ACTION_WORDS = {"run": "runs", "skip": "skipped", "given": "given", "kept": "kept", "refuse": "missing"}


def write_report(session_path: Path, portrait: str) -> Path:
    """Writes portraits/NAME/report.html and returns its path.

    Raises:
        SessionError: The session cannot be read.
        PortraitError: It has no such portrait.
    """
    session = Session.open(session_path)
    folder = session.portraits_dir / portrait
    if not (folder / "portrait.json").is_file():
        raise PortraitError(f"{session_path} has no portrait {portrait!r}; make it with `relight fit`.")
    metrics = _optional_json(folder / "metrics.json")
    plan = _optional_json(folder / "plan.json")
    sections = [
        _warnings([*session.info.get("warnings", []), *session.repairs, *metrics.get("warnings", [])]),
        *_pictures(folder / "previews"),
        _measures(_optional_json(folder / "evaluation.json")),
        _plan(plan),
        _geometry(metrics.get("geometry", {})),
        _frames(session, frozenset(plan.get("frames", []))),
        _times(metrics),
    ]
    title = f"{session.path.resolve().name} · {portrait}"
    page = (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{CSS}</style></head><body><main>"
        f"{_header(title, session, metrics)}{''.join(sections)}{_footer(metrics)}</main></body></html>\n"
    )
    path = folder / "report.html"
    atomic_write(path, page.encode())
    return path


def _header(title: str, session: Session, metrics: Mapping[str, Any]) -> str:
    image = session.info["image"]
    lit = sum(record.flash == 1 for record in session.frames if record.usable)
    unlit = sum(record.flash == 0 for record in session.frames if record.usable)
    facts = [
        ("frames looked at", f"{len(session.frames):,}"),
        ("lit and unlit frames", f"{lit} and {unlit}"),
        ("pixels", f"{image['width']} × {image['height']}"),
    ]
    if "points" in metrics:
        facts.append(("points", f"{metrics['points']:,}"))
    if "total_s" in metrics:
        facts.append(("fitted in", f"{metrics['total_s']:.1f} s on {metrics['device']}"))
    items = "".join(
        f"<li><b>{escape(value)}</b> <span class=quiet>{name}</span></li>" for name, value in facts
    )
    return f"<h1>{escape(title)}</h1><ul class=facts>{items}</ul>"


def _warnings(sentences: Sequence[str]) -> str:
    if not sentences:
        return ""
    items = "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences)
    return _section("To know", f"<ul class=warnings>{items}</ul>")


def _pictures(folder: Path) -> list[str]:
    previews = _optional_json(folder / "previews.json").get("previews", [])
    sections = []
    for group, title, about, style in _GROUPS:
        figures = "".join(
            f'<figure><img alt="{escape(preview["caption"])}" src="{_embedded(folder / preview["file"])}">'
            f"<figcaption>{escape(preview['caption'])}</figcaption></figure>"
            for preview in previews
            if preview["group"] == group
        )
        if figures:
            intro = f"<p class=quiet>{about}</p>" if about else ""
            sections.append(_section(title, f'{intro}<div class="{style}">{figures}</div>'))
    return sections


def _measures(evaluation: Mapping[str, Any]) -> str:
    if not evaluation:
        return ""
    rows = (
        f"<tr><td>{escape(name)}</td><td class=number>{escape(value)}</td>"
        f"<td class=quiet>{escape(note)}</td></tr>"
        for name, value, note in measure_rows(evaluation)
    )
    return _section("Measured against the truth", _table(("measure", "value", ""), rows))


def _plan(plan: Mapping[str, Any]) -> str:
    if not plan:
        return ""
    rows = (
        f"<tr><td>{escape(decision['name'].replace('_', ' '))}</td>"
        f'<td><span class="tag {decision["action"]}">{_ACTION_WORDS[decision["action"]]}</span></td>'
        f"<td>{escape(decision['reason'])}</td><td class=quiet>{escape(decision['saving'])}</td></tr>"
        for decision in plan["decisions"]
    )
    return _section("Plan", _table(("step", "", "why", "saves"), rows))


def _geometry(stages: Mapping[str, Any]) -> str:
    """What was found from the frames: a row for each number that a stage reports."""
    rows = []
    for stage, report in stages.items():
        facts = [(name, value) for name, value in report.items() if isinstance(value, (int, float, str))]
        for place, (name, value) in enumerate(facts):
            said = f"{value:.4g}" if isinstance(value, float) else str(value)
            rows.append(
                f"<tr><td>{escape(stage) if place == 0 else ''}</td><td>{escape(name.replace('_', ' '))}</td>"
                f"<td>{escape(said)}</td></tr>"
            )
    return _section("Found in the frames", _table(("", "", ""), rows)) if rows else ""


def _frames(session: Session, fitted: frozenset[int]) -> str:
    legend = (
        "<p class='quiet legend'><span class=lit><i></i>flash</span><span class=unlit><i></i>no flash</span>"
        "<span class=partial><i></i>partly lit or unknown</span><span class=out><i></i>left out</span>"
        "tall bars are fitted</p>"
    )
    return _section("Frames", _strip(session.frames, fitted) + legend)


def _strip(frames: Sequence[FrameRecord], fitted: frozenset[int]) -> str:
    """One bar a frame in capture order; a strip of hundreds stays readable because it scales."""
    if not frames:
        return ""
    bars = []
    for position, record in enumerate(frames):
        kind = {1: "lit", 0: "unlit", None: "partial"}[record.flash]
        if not record.usable and record.flash is not None:
            kind = "out" if record.flash == 0 else "lit"
        height = 40 if record.index in fitted else 18
        said = ", ".join(record.reasons)
        bars.append(
            f'<rect class={kind} x="{position}" y="{47 - height}" width=".82" height="{height}">'
            f"<title>frame {record.index}{': ' + escape(said) if said else ''}</title></rect>"
        )
    return (
        f'<svg class=strip viewBox="0 0 {len(frames)} 54" preserveAspectRatio="none" role="img" '
        f'aria-label="flash state of {len(frames)} frames">{"".join(bars)}</svg>'
    )


def _times(metrics: Mapping[str, Any]) -> str:
    if "seconds" not in metrics:
        return ""
    rows = [
        f"<tr><td>{escape(stage)}</td><td class=number>{seconds:.2f} s</td></tr>"
        for stage, seconds in metrics["seconds"].items()
    ]
    rows.append(f"<tr><td><b>all</b></td><td class=number><b>{metrics['total_s']:.2f} s</b></td></tr>")
    memory = metrics.get("peak_memory_mb")
    if memory is not None:
        rows.append(f"<tr><td>peak memory</td><td class=number>{memory:,.0f} MB</td></tr>")
    return _section("Time and memory", _table(("stage", ""), rows))


def _footer(metrics: Mapping[str, Any]) -> str:
    versions = metrics.get("versions", {})
    said = ", ".join(f"{name} {version}" for name, version in versions.items())
    made = f"Made {metrics['finished']}" if "finished" in metrics else "Made"
    return f"<footer>{escape(made)}{' with ' + escape(said) if said else ''}.</footer>"


def _section(title: str, body: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{body}</section>"


def _table(heads: Sequence[str], rows: Iterable[str]) -> str:
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    return f"<table><tr>{head}</tr>{''.join(rows)}</table>"


def _embedded(path: Path) -> str:
    """A JPEG as a data URL."""
    return f"data:image/jpeg;base64,{base64.b64encode(path.read_bytes()).decode()}"


def _optional_json(path: Path) -> Mapping[str, Any]:
    return read_json(path, PortraitError).values if path.is_file() else {}
