"""The pieces of a page, and the HTML of each; every text from outside is escaped here."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from .theme import DPI

SVG_LIMIT = 150_000
"""Bytes of SVG beyond which a figure is inlined as PNG, if that is smaller."""


@dataclass(frozen=True)
class Number:
    """A big number of the summary."""

    label: str
    value: str
    unit: str = ""
    note: str = ""


@dataclass(frozen=True)
class Text:
    """Paragraphs; those after the first become a list if `listed`."""

    lines: tuple[str, ...]
    listed: bool = False


@dataclass(frozen=True)
class Table:
    """Rows of text; numeric columns (given by index) are aligned to the right."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numeric: tuple[int, ...] = ()
    folded: str = ""
    """Not empty: the table is folded away under this line."""


@dataclass(frozen=True)
class Picture:
    """A saved figure with its title, and a caption of what one sees and what is good."""

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
class View:
    """The 3D view: plotly's data and layout."""

    figure: Mapping[str, Any]
    caption: str


Block = Text | Table | Picture | View


@dataclass(frozen=True)
class Section:
    """A titled part of the page."""

    title: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True)
class Content:
    """All that a report says."""

    title: str
    verdict: str
    numbers: tuple[Number, ...]
    sections: tuple[Section, ...]
    subtitle: str = ""


def anchor(title: str) -> str:
    """The fragment by which a section's title is linked."""
    return "".join(c if c.isalnum() else "-" for c in title.lower()).strip("-")


def block(item: Block) -> str:
    """The HTML of one piece."""
    if isinstance(item, Text):
        return text(item)
    if isinstance(item, Table):
        return table(item)
    if isinstance(item, Picture):
        return picture(item)
    return view(item)


def text(item: Text) -> str:
    """Paragraphs, or one paragraph and a list."""
    first, rest = item.lines[:1], item.lines[1:]
    if not item.listed:
        return "".join(f"<p>{escape(line)}</p>" for line in item.lines)
    points = "".join(f"<li>{escape(line)}</li>" for line in rest)
    return "".join(f"<p>{escape(line)}</p>" for line in first) + f"<ul>{points}</ul>"


def table(item: Table) -> str:
    """A table, folded away where asked."""

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
    if item.folded:
        return f"<details><summary>{escape(item.folded)}</summary>{html}</details>"
    return html


def picture(item: Picture) -> str:
    """A figure inlined as SVG, as PNG where the SVG is large and the PNG smaller."""
    kind, data = "svg+xml", item.svg.read_bytes()
    if len(data) > max(SVG_LIMIT, item.png.stat().st_size):
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
    """Width at which a PNG has the size of its SVG, in CSS pixels (96 an inch)."""
    return round(int.from_bytes(png[16:20]) * 96 / DPI)


def view(item: View) -> str:
    """The place of the 3D view with its data; `page.html` draws it."""
    data = json.dumps(item.figure, separators=(",", ":"), allow_nan=False)
    data = data.replace("<", "\\u003c").replace("\u2028", "\\u2028")
    return (
        '<figure class="card"><div id="view" role="img" aria-label="3D view of body and taxels">'
        "</div><img id=view-print alt='3D view of body and taxels'>"
        "<noscript><p>The 3D view needs JavaScript; all figures below do not.</p></noscript>"
        f"<figcaption>{escape(item.caption)}</figcaption></figure>"
        f'<script type="application/json" id="view-data">{data}</script>'
    )


def number(item: Number) -> str:
    """One tile of the summary."""
    unit = f" <small>{escape(item.unit)}</small>" if item.unit else ""
    return (
        f"<div class=tile><dt>{escape(item.label)}</dt><dd>{escape(item.value)}{unit}</dd>"
        f"<dd class=note>{escape(item.note)}</dd></div>"
    )
