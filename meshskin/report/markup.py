"""The HTML of the parts of a page; all text is escaped here."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from .theme import DPI

MAX_SVG_BYTES = 160_000
"""Bytes above which a figure is inlined as PNG, if that is smaller; the largest figure of 80 taxels
without the path of the contact takes 153 kB."""
LONGEST = 30
"""Characters of a number with its unit, at most: longer texts in a column of numbers wrap."""
VIEW = '<div id="view" '
"""Beginning of the element of the 3D view: a page that has it needs the scripts."""


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
class Content:
    """The content of a page: texts, and HTML made by the functions of this module."""

    title: str
    summary: str
    tiles: Sequence[str]
    """HTML of the most important numbers."""
    sections: Mapping[str, Sequence[str]]
    """HTML of the blocks of each section, by title."""
    subtitle: str = ""


def anchor(title: str) -> str:
    """The fragment of a link to the section with this title."""
    return "".join(c if c.isalnum() else "-" for c in title.lower()).strip("-")


def section(title: str, blocks: Sequence[str]) -> str:
    """A titled part of the page."""
    inner = "\n".join(blocks)
    return f'<section id="{anchor(title)}"><h2>{escape(title)}</h2>{inner}</section>\n'


def paragraphs(*lines: str) -> str:
    """Lines of text, each a paragraph."""
    return "".join(f"<p>{escape(line)}</p>" for line in lines)


def bullets(first: str, points: Sequence[str]) -> str:
    """A paragraph, and a list below it."""
    listed = "".join(f"<li>{escape(point)}</li>" for point in points)
    return f"{paragraphs(first)}<ul>{listed}</ul>"


def table(
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    numeric: Sequence[int] = (),
    collapsed: str = "",
) -> str:
    """Rows of text; columns with the indices `numeric` are aligned to the right, but for sentences
    in them, which wrap.

    If `collapsed` is not empty, the table is hidden until this line is clicked.
    """

    def cell(k: int, text: str, tag: str) -> str:
        kind = " class=number" if k in numeric and len(text) <= LONGEST else ""
        return f"<{tag}{kind}>{escape(text)}</{tag}>"

    def row(cells: Sequence[str], tag: str) -> str:
        return f"<tr>{''.join(cell(k, text, tag) for k, text in enumerate(cells))}</tr>"

    body = "".join(row(r, "td") for r in rows)
    html = (
        f'<div class="wide"><table><thead>{row(header, "th")}</thead>'
        f"<tbody>{body}</tbody></table></div>"
    )
    if collapsed:
        return f"<details><summary>{escape(collapsed)}</summary>{html}</details>"
    return html


def saved_figure(item: SavedFigure) -> str:
    """A figure, inlined as SVG, or as PNG if the SVG is large and the PNG smaller."""
    kind, data, size = "svg+xml", item.svg.read_bytes(), ""
    if len(data) > max(MAX_SVG_BYTES, item.png.stat().st_size):
        kind, data = "png", item.png.read_bytes()
        # in CSS pixels (96 per inch), so that it has the size of its SVG
        size = f' width="{round(int.from_bytes(data[16:20]) * 96 / DPI)}"'
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    return (
        f'<figure class="card"><figcaption class="above">{escape(item.title)}</figcaption>'
        f'<img src="{source}"{size} alt="{escape(item.alt)}">'
        f"<figcaption>{escape(item.caption)} <span class=files>File: {escape(item.png.stem)}"
        "</span></figcaption></figure>"
    )


def view_3d(figure: Mapping[str, Any], caption: str) -> str:
    """The 3D view with its data, a figure of plotly; view.js draws it."""
    data = json.dumps(figure, separators=(",", ":"), allow_nan=False)
    data = data.replace("<", "\\u003c").replace("\u2028", "\\u2028")
    return (
        f'<figure class="card">{VIEW}role="img" aria-label="3D view of body and taxels">'
        "</div><img id=view-print alt='3D view of body and taxels'>"
        "<noscript><p>The 3D view needs JavaScript; the figures below do not.</p></noscript>"
        f"<figcaption>{escape(caption)}</figcaption></figure>"
        f'<script type="application/json" id="view-data">{data}</script>'
    )


def tile(label: str, value: str, unit: str = "", note: str = "") -> str:
    """One of the most important numbers, at the top of the page."""
    unit = f" <small>{escape(unit)}</small>" if unit else ""
    return (
        f"<div class=tile><dt>{escape(label)}</dt><dd>{escape(value)}{unit}</dd>"
        f"<dd class=note>{escape(note)}</dd></div>"
    )
