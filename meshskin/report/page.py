"""The page: one self-contained HTML file that needs no network."""

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
from ..core.progress import Progress
from . import markup
from .markup import Content

if TYPE_CHECKING:
    from ..estimation.calibration import Calibration
    from ..estimation.cross_validation import CrossValidation
    from ..estimation.demonstration import Demonstration
    from ..geometry.body import Body
    from ..recording.recording import Recording
    from ..skin.skin import Skin
    from ..study.sensitivity.budget import BudgetReport
    from .data import ReportData


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
    budget: BudgetReport | None = None,
    validation: CrossValidation | None = None,
    progress: Progress | None = None,
) -> list[Path]:
    """Write the page `path` and, in the folder figures/ beside it, every figure as PNG and SVG.

    truth: the true skin of a simulation; without it the report gives the stated uncertainty in
    place of errors. comparisons: calibrations of the same recording by other methods.
    demonstration: the pose graph from the origin; without it, the first pose graph that kept its
    iterates is shown. metrics: as in metrics.json. seconds: of each stage. budget: the decisions
    of an error budget. validation: what `calibration.cross_validate` gave. progress(stage, done,
    total): called after each figure of the stage "report".

    Returns the paths written, the page first. Raises OutputError if a file cannot be written.
    """
    from .data import ReportData

    parts = {"budget": budget, "cross_validation": validation}
    data = ReportData(
        calibration,
        recording,
        truth,
        comparisons or {},
        demonstration,
        {key: part.metrics() for key, part in parts.items() if part} | dict(metrics or {}),
        seconds or {k: v for k, v in calibration.seconds.items() if k != "total"},
        provenance or calibration.provenance,
        body,
    )
    return draw(Path(path), data, progress)[0]


def draw(
    path: Path, data: ReportData, progress: Progress | None = None
) -> tuple[list[Path], list[str]]:
    """Write the page and its figures; the figures left out where `progress` raises OutOfTime.

    Returns the paths written, and the names of the figures left out.
    """
    from .figure_set import draw_figures
    from .sections import content

    started = perf_counter()
    pictures, left_out = draw_figures(path.parent / "figures", data, progress)
    data = replace(
        data,
        seconds={**data.seconds, "figures": perf_counter() - started},
        metrics={**data.metrics, "figures_left_out": left_out},
    )
    write(path, content(data, pictures))
    return [path, *(file for picture in pictures for file in picture.files)], left_out
