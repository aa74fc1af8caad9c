"""`meshskin cost SCENE`: measure the error of a scene against computing time for each setting."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from .options import integer, option
from .progress_bar import bar

if TYPE_CHECKING:
    from ..study.sensitivity.cost import Costs


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    option(parser, "scene SCENE", "name of a shipped scene, or a TOML file")
    option(parser, "--out DIR", "folder for page and figure", Path, default=Path("out"))
    option(parser, "--seeds SEEDS", "seeds per setting (default 1)", integer(1))
    knobs = "subset of faces, degree, contact, dt, integrator, lanes, rate, method, tolerance"
    option(parser, "--knobs KNOB", knobs, nargs="+")
    full = "3 seeds where --seeds is not given, and a reference that is twice as fine"
    option(parser, "--full", full)
    option(parser, "--quiet", "print no progress bar and no table")


def command(options: argparse.Namespace) -> int:
    """Measure, write the page, and print the table."""
    from ..core.atomic_io import check_folder
    from ..scene.scene import Scene
    from ..study.sensitivity.budget import budget
    from ..study.sensitivity.cost import KNOBS, cost

    scene = Scene.load(options.scene)
    check_folder(options.out)
    with bar(options.quiet) as progress:
        if scene.budget is not None:  # the budget chooses the effects, as in a run
            scene = budget(scene, progress=progress).scene
        costs = cost(
            scene,
            knobs=KNOBS if options.knobs is None else options.knobs,
            seeds=options.seeds or (3 if options.full else 1),
            finer=8 if options.full else 4,
            progress=progress,
        )
    write(costs, options.out)
    if not options.quiet:
        print(summary(costs))
        print(f"  page               {options.out / 'cost.html'}")
    return 0


def write(costs: Costs, folder: Path) -> None:
    """Write cost.html, the figure, and the record of every setting in cost.json."""
    from ..core.atomic_io import write_json
    from ..core.provenance import provenance
    from ..report import page, precision, theme
    from ..study.sensitivity.cost import TARGETS

    png, svg = theme.save(
        precision.work_precision(costs, TARGETS), folder / "figures", "work_precision"
    )
    page.write(folder / "cost.html", precision.page(costs, TARGETS, png, svg))
    record = {
        "scene": costs.scene,
        "reference": costs.reference.words(costs.base),
        "routes": [vars(route) for route in costs.routes],
        "settings": costs.records(),
        "provenance": provenance(scene=costs.scene, seeds=costs.seeds),
    }
    write_json(folder / "cost.json", record)


def summary(costs: Costs) -> str:
    """The text that the command prints."""
    from ..report import precision
    from ..study.sensitivity.cost import TARGETS

    rows = [precision.HEADER, *precision.table(costs, TARGETS)]
    width = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = [f"{costs.scene}: {len(costs.rows)} settings; numerical parts are counted from "
             f"{costs.reference.words(costs.base)}"]  # fmt: skip
    for row in rows:
        cells = (row[k].ljust(width[k]) if k == 1 else row[k].rjust(width[k]) for k in range(5))
        lines.append(("  " + "  ".join(cells)).rstrip())
    for route in costs.routes:
        lines.append(f"  confirmed by {route.name}: within {route.mean_mm:.2g} mm on average")
    return "\n".join(lines)
