"""`meshskin diff A B`: compare two skin files or calibrations.

Compare two skin files, or saved calibrations (their folders, calibration.parquet or .csv). What a
new recording says of a map is shown by `meshskin recalibrate`, what it changed by this command.
Exit code 0: the same taxels within 1 um; 1: they differ; 2: a file cannot be read.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .options import add_part, check_part, integer, load_skin, option

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ..estimation.calibration import Calibration
    from ..skin.compare import Difference
    from ..skin.skin import Skin

SHOWN = 20
"""Lines about exchanged ids that are printed without --all."""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    option(parser, "a A", "first skin file or calibration", Path)
    option(parser, "b B", "second one", Path)
    add_part(parser)
    option(parser, "--all", "print long lists in full")
    worst = "number of worst taxels to list (default 10)"
    option(parser, "--worst N", worst, integer(0), default=10)


def command(options: argparse.Namespace) -> int:
    """Print the comparison."""
    from ..skin.compare import compare

    check_part(options.part, options.a, options.b)
    a, b = (_skin(path, options.part) for path in (options.a, options.b))
    difference = compare(a, b)
    for name, path, skin in (("A", options.a, a), ("B", options.b, b)):
        kind = "module frames" if name == difference.frames else "taxels"
        print(f"{name}: {path.name}, {len(skin)} {kind}")
    if difference.by_modules:
        print("modules are compared: the ids of one file are numbers of modules")
    for line in lines(difference, options.worst, None if options.all else SHOWN):
        print(line)
    return 0 if same(difference) else 1


def earlier_map(path: Path, part: str | None) -> Calibration | Skin:
    """The calibration saved at `path` or in that folder, or the skin `part` of a file."""
    from ..estimation.calibration import Calibration

    file = saved_calibration(path)
    return load_skin(path, part) if file is None else Calibration.load(file)


def _skin(path: Path, part: str | None) -> Skin:
    """The skin of a file, or the determined taxels of a calibration. Raises SkinError."""
    from ..skin.skin import Skin

    found = earlier_map(path, part)
    if isinstance(found, Skin):
        return found
    good = np.isfinite(found.positions).all(axis=1)
    return Skin(found.poses[good], found.ids[good])


def saved_calibration(path: Path) -> Path | None:
    """The file of the calibration saved at `path`, beside its table calibration.csv, or in that
    folder; None: there is none."""
    beside = path.parent / (path.name.replace("calibration.csv", "calibration") + ".parquet")
    for file in (path, beside, path / "calibration.parquet"):
        if file.suffix == ".parquet" and file.is_file():
            return file
    return None


def same(difference: Difference) -> bool:
    """Whether both skins have the same taxels at the same positions."""
    from ..skin.files.table import LAST_DIGIT

    alone = len(difference.only_a) + len(difference.only_b)
    return not alone and float(difference.unaligned.max(initial=0.0)) <= LAST_DIGIT


def lines(difference: Difference, worst: int, shown: int | None) -> Iterator[str]:
    """The lines of text that describe the comparison."""
    from ..core import se3
    from ..skin.files.table import LAST_DIGIT

    d = difference
    entity = "module" if d.by_modules else "taxel"
    yield f"{len(d.ids)} in both, {len(d.only_a)} only in A, {len(d.only_b)} only in B"
    if same(d):
        yield "equal within 1 um"
        return
    yield f"{'distance (mm)':28}{entity + 's':>8}{'mean':>10}{'rms':>10}{'max':>10}"
    yield row("without alignment", d.unaligned)
    yield row("aligned", d.aligned)
    if d.permutation:
        yield row(f"aligned and {d.unit}s permuted", d.paired)
    if d.reshape is not None:
        yield row("aligned, mirrored or scaled", d.reshaped)
    shift = d.alignment[:3, 3]
    angle = np.degrees(np.linalg.norm(se3.log_so3(d.alignment[:3, :3])))
    yield (
        f"alignment: B rotated by {angle:.3f} deg, translated by "
        + " ".join(f"{1e3 * value:.3f}" for value in shift)
        + " mm"
    )
    sentences = d.sentences()
    yield from sentences[:shown]
    if len(left := sentences[len(sentences[:shown]) :]):
        yield f"and {len(left)} more lines (--all)"
    if d.reshape is not None:
        yield str(d.reshape)
    if d.permutation or d.reshape is not None:
        yield "this explains the difference: it removes at least half of it"
    else:
        yield "no exchange of ids explains a difference"
    listed = [(taxel, off) for taxel, off in d.worst(worst) if off > LAST_DIGIT]
    if listed:
        yield f"worst {entity}s (mm): " + ", ".join(f"{t}: {1e3 * off:.3f}" for t, off in listed)


def row(name: str, distance: NDArray[np.float64]) -> str:
    """One line of the table of distances."""
    from ..skin.compare import rms

    if not len(distance):
        return f"{name:28}{0:>8}"
    values = (float(distance.mean()), rms(distance), float(distance.max()))
    return f"{name:28}{len(distance):>8}" + "".join(f"{1e3 * value:>10.4f}" for value in values)
