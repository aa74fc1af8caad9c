"""`meshskin recalibrate PREVIOUS [RECORDING] --out DIR`: test an earlier map by a few touches.

PREVIOUS is the earlier map: a saved calibration (its folder, or the file calibration.parquet) or a
skin file. With RECORDING, as `meshskin calibrate` reads it, every module (every taxel where there
are no modules) is tested for having been moved, turned, exchanged, for being dead and for another
gain; the updated map is written to DIR/calibration, the states to DIR/recalibration.json, and the
touches that test best what is still open to DIR/touches.csv. Without RECORDING, the touches that
test the whole map best are planned.

Exit code 0: no change was found; 1: there are changes; 2: bad input.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.errors import CalibrationError, ConfigError
from . import belief_options
from .diff import earlier_map
from .options import RESULTS, integer, option, real, refuse
from .progress_bar import bar

if TYPE_CHECKING:
    from ..estimation.recalibrate.touch_design import TouchDesign
    from ..recording.recording import Recording
    from ..scene.belief import Belief

CHANGED = 1
"""Exit code where a change was found."""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    positive = real(above=0.0)
    option(parser, "previous PREVIOUS", "earlier map", Path)
    option(parser, "recording RECORDING", "recorded log of the touches", Path, nargs="?")
    option(parser, "--out DIR", RESULTS, Path, required=True)
    option(parser, "--touches K", "touches to plan (default 20)", integer(1), default=20)
    option(
        parser, "--force-n N", "force of the planned touches (default: that of --scene, or the "
        "median of RECORDING)", positive,
    )  # fmt: skip
    option(
        parser, "--false-alarm P", "probability, at most, that any change is found where there is "
        "none (default 0.01)", real(above=0.0, most=0.5),
    )  # fmt: skip
    option(
        parser, "--map-sigma-mm MM", "standard deviation of the taxels' places in a map that "
        "states none (default 0.3)", positive,
    )  # fmt: skip
    option(parser, "--all", "print long lists in full")
    belief_options.add(parser)


def command(options: argparse.Namespace) -> int:
    """Test the map, or plan the touches, write the results and print them."""
    from ..core.atomic_io import check_folder, write_json
    from ..estimation.recalibrate.recalibrate import recalibrate
    from ..estimation.recalibrate.touch_design import next_touches
    from ..recording.recording import Recording

    if options.recording is None:
        names = ("false_alarm", "map_sigma_mm", "all")
        refuse(options, names, "{} is for the test of a map", "give RECORDING, too")
    previous = earlier_map(options.previous, options.part)
    belief = belief_options.belief_of(options, previous.ids)
    recording = None if options.recording is None else Recording.load(options.recording)
    planning = replace(belief, force_reference=_force(options, belief, recording))
    check_folder(options.out)
    if recording is None:
        with bar(quiet=False) as progress:
            design = next_touches(previous, planning, options.touches, progress=progress)
        save(design, options.out / "touches.csv")
        print(f"{options.touches} touches to test the map: {options.out / 'touches.csv'}")
        return 0
    changes = {
        "false_alarm": options.false_alarm,
        "sigma": None if options.map_sigma_mm is None else 1e-3 * options.map_sigma_mm,
    }
    with bar(quiet=False) as progress:
        found = recalibrate(
            previous,
            recording,
            belief,
            progress=progress,
            **{name: value for name, value in changes.items() if value is not None},
        )
        found.calibration.save(options.out / "calibration")
        write_json(options.out / "recalibration.json", found.metrics())
        lines = found.lines(None) if options.all else found.lines()
        try:
            design = found.next_contacts(options.touches, planning, progress)
            save(design, options.out / "touches.csv")
        except CalibrationError as error:
            lines.append(f"no touches are planned: {error}")
    print("\n".join(lines))
    return CHANGED if found.findings else 0


def _force(options: argparse.Namespace, belief: Belief, recording: Recording | None) -> float:
    """The force, N, of the touches that are planned. Raises ConfigError where nothing says it."""
    if options.force_n is not None:
        return float(options.force_n)
    if belief.force_reference is not None:
        return belief.force_reference
    if recording is None:
        raise ConfigError("touches are planned for a force", remedy="give --force-n")
    return float(np.median(recording.force))


def save(design: TouchDesign, path: Path) -> None:
    """Write the touches as CSV: points in mm, normals, and the module or taxel that each tests."""
    from ..core.atomic_io import write_text

    rows = ["x_mm,y_mm,z_mm,nx,ny,nz,tests"]
    for point, normal, unit in zip(design.points, design.normals, design.unit, strict=True):
        numbers = [f"{1e3 * x:.4f}" for x in point] + [f"{x:.6f}" for x in normal]
        rows.append(",".join([*numbers, str(unit)]))
    write_text(path, "\n".join(rows) + "\n")
