"""Pieces of a page in HTML without scripts and without anything from elsewhere: it can be sent."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

_STYLE = """
:root { color-scheme: light dark; --page: #f7f6f3; --card: #fff; --ink: #1d1d1b; --quiet: #6d6b66;
  --line: #c9c6bf; --accent: #b4541a }
@media (prefers-color-scheme: dark) { :root { --page: #161615; --card: #1f1f1d; --ink: #ebe9e4;
  --quiet: #98958d; --line: #45433f; --accent: #f0a35c } }
body { margin: 0; background: var(--page); color: var(--ink); font: 15px/1.5 system-ui, sans-serif }
main { max-width: 1080px; margin: 0 auto; padding: 40px 24px 80px }
h1 { font-size: 28px; margin: 0 } h2 { font-size: 18px; margin: 40px 0 8px }
p { max-width: 78ch; margin: 6px 0 12px } .quiet, th, figcaption { color: var(--quiet) }
table { border-collapse: collapse; background: var(--card); font-size: 14px }
th, td { text-align: left; padding: 5px 14px; border: 1px solid var(--line);
  font-variant-numeric: tabular-nums }
.grid { display: grid; gap: 14px; grid-template-columns: repeat(auto-fill, minmax(420px, 1fr)) }
figure { margin: 0; background: var(--card); border: 1px solid var(--line); border-radius: 8px;
  padding: 10px }
figure svg { display: block; width: 100%; height: auto } figcaption { font-size: 13px; padding-top: 6px }
.warnings { border-left: 3px solid var(--accent); padding: 2px 0 2px 14px; list-style: none }
"""


def page(title: str, sections: Iterable[str]) -> str:
    """The whole page."""
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{_STYLE}</style></head>'
        f"<body><main>{''.join(sections)}</main></body></html>\n"
    )


def warnings(sentences: Sequence[str]) -> str:
    """What a reader must know first; nothing where there is nothing."""
    items = "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences)
    return f"<h2>To know</h2><ul class=warnings>{items}</ul>" if items else ""


def figure(drawing: str, caption: str) -> str:
    """A drawing with words under it."""
    return f"<figure>{drawing}<figcaption>{escape(caption)}</figcaption></figure>"


def section(title: str, body: str, about: str = "") -> str:
    """A part of the page."""
    intro = f"<p class=quiet>{escape(about)}</p>" if about else ""
    return f"<h2>{escape(title)}</h2>{intro}{body}"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Cells of plain text."""
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return "<table><tr>" + "".join(f"<th>{escape(name)}</th>" for name in head) + f"</tr>{body}</table>"
