"""The blocks of a page and their HTML; all text is escaped here."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from .theme import DPI

MAX_SVG_BYTES = 150_000
"""Bytes above which a figure is inlined as PNG, if that is smaller."""


@dataclass(frozen=True)
class KeyNumber:
    """One of the most important numbers, at the top of the page."""

    label: str
    value: str
    unit: str = ""
    note: str = ""


@dataclass(frozen=True)
class Text:
    """Paragraphs; those after the first are list items if `listed`."""

    lines: tuple[str, ...]
    listed: bool = False


@dataclass(frozen=True)
class Table:
    """Rows of text; columns with the indices `numeric` are aligned to the right."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numeric: tuple[int, ...] = ()
    collapsed: str = ""
    """If not empty, the table is hidden until this line is clicked."""


@dataclass(frozen=True)
class SavedFigure:
    """A saved figure with its title, and a caption that says what it shows and what is good."""

    png: Path
    svg: Path
    title: str
    caption: str
    alt: str
    also: tuple[Path, ...] = ()
    """Further files saved with it (single panels)."""

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file of the figure."""
        return (self.png, self.svg, *self.also)


@dataclass(frozen=True)
class View3D:
    """The 3D view: data and layout of plotly."""

    figure: Mapping[str, Any]
    caption: str


Block = Text | Table | SavedFigure | View3D


@dataclass(frozen=True)
class Section:
    """A titled part of the page."""

    title: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True)
class Content:
    """The content of a page."""

    title: str
    summary: str
    numbers: tuple[KeyNumber, ...]
    sections: tuple[Section, ...]
    subtitle: str = ""


def anchor(title: str) -> str:
    """The fragment of a link to the section with this title."""
    return "".join(c if c.isalnum() else "-" for c in title.lower()).strip("-")


def block(item: Block) -> str:
    """The HTML of one block."""
    if isinstance(item, Text):
        return text(item)
    if isinstance(item, Table):
        return table(item)
    if isinstance(item, SavedFigure):
        return saved_figure(item)
    return view_3d(item)


def text(item: Text) -> str:
    """The HTML of paragraphs, or of one paragraph and a list."""
    first, rest = item.lines[:1], item.lines[1:]
    if not item.listed:
        return "".join(f"<p>{escape(line)}</p>" for line in item.lines)
    points = "".join(f"<li>{escape(line)}</li>" for line in rest)
    return "".join(f"<p>{escape(line)}</p>" for line in first) + f"<ul>{points}</ul>"


def table(item: Table) -> str:
    """The HTML of a table."""

    def row(cells: Sequence[str], tag: str) -> str:
        inner = "".join(
            f"<{tag}{' class=number' if k in item.numeric else ''}>{escape(c)}</{tag}>"
            for k, c in enumerate(cells)
        )
        return f"<tr>{inner}</tr>"

    body = "".join(row(r, "td") for r in item.rows)
    html = (
        f'<div class="wide"><table><thead>{row(item.header, "th")}</thead>'
        f"<tbody>{body}</tbody></table></div>"
    )
    if item.collapsed:
        return f"<details><summary>{escape(item.collapsed)}</summary>{html}</details>"
    return html


def saved_figure(item: SavedFigure) -> str:
    """The HTML of a figure, inlined as SVG, or as PNG if the SVG is large and the PNG smaller."""
    kind, data = "svg+xml", item.svg.read_bytes()
    if len(data) > max(MAX_SVG_BYTES, item.png.stat().st_size):
        kind, data = "png", item.png.read_bytes()
    size = f' width="{_width(data)}"' if kind == "png" else ""
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    return (
        f'<figure class="card"><figcaption class="above">{escape(item.title)}</figcaption>'
        f'<img src="{source}"{size} alt="{escape(item.alt)}">'
        f"<figcaption>{escape(item.caption)} <span class=files>File: {escape(item.png.stem)}"
        "</span></figcaption></figure>"
    )


def _width(png: bytes) -> int:
    """Width of a PNG in CSS pixels (96 per inch) at which it has the size of its SVG."""
    return round(int.from_bytes(png[16:20]) * 96 / DPI)


def view_3d(item: View3D) -> str:
    """The HTML of the 3D view, with its data; view.js draws it."""
    data = json.dumps(item.figure, separators=(",", ":"), allow_nan=False)
    data = data.replace("<", "\\u003c").replace("\u2028", "\\u2028")
    return (
        '<figure class="card"><div id="view" role="img" aria-label="3D view of body and taxels">'
        "</div><img id=view-print alt='3D view of body and taxels'>"
        "<noscript><p>The 3D view needs JavaScript; the figures below do not.</p></noscript>"
        f"<figcaption>{escape(item.caption)}</figcaption></figure>"
        f'<script type="application/json" id="view-data">{data}</script>'
    )


def key_number(item: KeyNumber) -> str:
    """The HTML of one of the most important numbers."""
    unit = f" <small>{escape(item.unit)}</small>" if item.unit else ""
    return (
        f"<div class=tile><dt>{escape(item.label)}</dt><dd>{escape(item.value)}{unit}</dd>"
        f"<dd class=note>{escape(item.note)}</dd></div>"
    )
