"""One self-contained HTML file: it opens without a network, prints, and can be mailed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from time import perf_counter
from typing import TYPE_CHECKING, Any

from ..core.atomic_io import write_text
from . import markup
from .markup import Content, Section

if TYPE_CHECKING:
    from ..estimation.calibration import Calibration
    from ..estimation.demonstration import Demonstration
    from ..geometry.body import Body
    from ..recording.recording import Recording
    from ..skin.skin import Skin
    from ..study.sensitivity.budget import BudgetReport


def write(path: str | Path, content: Content) -> Path:
    """Write `content` to `path` as one HTML file, whole or not at all.

    Raises OutputError if the place cannot be written.
    """
    path = Path(path)
    viewed = any(isinstance(b, markup.View) for s in content.sections for b in s.blocks)
    links = (f'<a href="#{markup.anchor(s.title)}">{escape(s.title)}</a>' for s in content.sections)
    page = Template(_piece("page.html")).substitute(
        title=escape(content.title),
        subtitle=escape(content.subtitle),
        verdict=escape(content.verdict),
        style=_piece("style.css"),
        numbers="".join(map(markup.number, content.numbers)),
        navigation="".join(links),
        sections="".join(map(_section, content.sections)),
        scripts=_scripts() if viewed else "",
    )
    write_text(path, page)
    return path


def _piece(name: str) -> str:
    return (resources.files(__package__) / name).read_text(encoding="utf-8")


def _section(section: Section) -> str:
    inner = "\n".join(map(markup.block, section.blocks))
    title = escape(section.title)
    return f'<section id="{markup.anchor(section.title)}"><h2>{title}</h2>{inner}</section>\n'


def _scripts() -> str:
    """plotly.js from plotly's wheel, and the lines that draw the view."""
    library = resources.files("plotly") / "package_data" / "plotly.min.js"
    plotly = library.read_text(encoding="utf-8").replace("</script", "<\\/script")
    return f"<script>{plotly}</script>\n<script>{_piece('view.js')}</script>"


def report(
    path: str | Path,
    *,
    body: Body | None,
    calibration: Calibration,
    recording: Recording | None = None,
    truth: Skin | None = None,
    comparisons: Mapping[str, Calibration] | None = None,
    demonstration: Demonstration | None = None,
    metrics: Mapping[str, Any] | None = None,
    seconds: Mapping[str, float] | None = None,
    provenance: Mapping[str, Any] | None = None,
    ledger: BudgetReport | None = None,
) -> list[Path]:
    """Write the page and, in the folder figures/ beside it, every figure as PNG and SVG.

    truth: the true skin, of a simulation; without it the report gives the stated uncertainty in
    the place of errors. comparisons: other methods on the same recording. demonstration: the
    pose graph from the origin (without it: the first pose graph that kept its iterates).
    metrics: as in metrics.json. seconds: of each stage. ledger: what an error budget decided.

    Returns the paths written, the page first. Raises OutputError if a place cannot be written.
    """
    from .data import ReportData
    from .figure_set import album
    from .sections import content

    started = perf_counter()
    findings = ReportData.collect(
        calibration,
        recording=recording,
        truth=truth,
        comparisons=comparisons or {},
        demonstration=demonstration,
        metrics=metrics or {},
        seconds=seconds or {},
        provenance=provenance or {},
    )
    path = Path(path)
    pictures = album(path.parent / "figures", findings)
    times = {**findings.seconds, "figures": perf_counter() - started}
    findings = replace(findings, seconds=times, ledger=ledger)
    write(path, content(findings, pictures, body))
    return [path, *(file for picture in pictures for file in picture.files)]
