"""The page: one self-contained HTML file that needs no network."""

from __future__ import annotations

from dataclasses import fields, replace
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from time import perf_counter
from typing import TYPE_CHECKING, Any

from ..core.atomic_io import write_text
from ..core.beside import Beside
from ..core.progress import Progress
from . import markup
from .data import ReportData
from .figure_set import EARLY, Drawn, draw_figures, draw_named
from .markup import Content
from .sections import content

if TYPE_CHECKING:
    from ..estimation.cross_validation import CrossValidation
    from ..study.sensitivity.budget import BudgetReport


def write(path: str | Path, content: Content) -> Path:
    """Write `content` to `path` as one HTML file, atomically.

    Raises OutputError if it cannot be written.
    """
    path = Path(path)
    links = (f'<a href="#{markup.anchor(t)}">{escape(t)}</a>' for t in content.sections)
    sections = "".join(markup.section(*item) for item in content.sections.items())
    page = Template(_resource("page.html")).substitute(
        title=escape(content.title),
        subtitle=escape(content.subtitle),
        summary=escape(content.summary),
        style=_resource("style.css"),
        numbers="".join(content.tiles),
        navigation="".join(links),
        sections=sections,
        scripts=_scripts() if markup.VIEW in sections else "",
    )
    write_text(path, page)
    return path


def _resource(name: str) -> str:
    return (resources.files(__package__) / name).read_text(encoding="utf-8")


def _scripts() -> str:
    """The script plotly.js of the package plotly, and view.js, which draws the view."""
    library = resources.files("plotly") / "package_data" / "plotly.min.js"
    plotly = library.read_text(encoding="utf-8").replace("</script", "<\\/script")
    return f"<script>{plotly}</script>\n<script>{_resource('view.js')}</script>"


FIGURES = "figures"
"""Folder of the figures, beside the page."""
OPTIONS = (*(item.name for item in fields(ReportData)), "budget", "progress")
"""Names of the options of a report."""


def report(
    path: str | Path,
    *,
    budget: BudgetReport | None = None,
    validation: CrossValidation | None = None,
    progress: Progress | None = None,
    **facts: Any,
) -> list[Path]:
    """Write the page `path` and, in the folder figures/ beside it, every figure as PNG and SVG.

    facts: fields of ReportData, at least its calibration; those that are None are left out. budget:
    the decisions of an error budget. validation: what `calibration.cross_validate` gave.
    progress(stage, done, total): called after each figure of the stage "report".

    Returns the paths written, the page first. Raises OutputError if a file cannot be written.
    """
    facts["validation"] = validation
    data = ReportData(**{name: fact for name, fact in facts.items() if fact is not None})
    parts = {"budget": budget, "cross_validation": validation}
    metrics = {key: part.metrics() for key, part in parts.items() if part}
    data = replace(data, metrics={**metrics, **data.metrics})
    return draw(Path(path), data, progress, beside=True)[0]


def draw_early(folder: Path, data: ReportData, forked: bool) -> Beside[Drawn]:
    """The figures of EARLY, drawn into the folder of the page in a forked process, or on demand."""
    if forked:
        import matplotlib.figure  # noqa: F401  once, not in both processes
    return Beside(lambda: draw_named(folder / FIGURES, data, EARLY), forked)


def draw(
    path: Path, data: ReportData, progress: Progress | None = None, **how: Any
) -> tuple[list[Path], list[str]]:
    """Write the page and its figures; the figures left out where `progress` raises OutOfTime.

    how: options of `draw_figures`. Returns the paths, and the names of the figures left out.
    """
    started = perf_counter()
    pictures, left_out = draw_figures(path.parent / FIGURES, data, progress, **how)
    data = replace(
        data,
        seconds={**data.seconds, "figures": perf_counter() - started},
        metrics={**data.metrics, "figures_left_out": left_out},
    )
    write(path, content(data, pictures))
    return [path, *(file for picture in pictures for file in picture.files)], left_out
