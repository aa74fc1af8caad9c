"""What a study of speed writes: its numbers as JSON, and a figure of the most important ones."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def add_out(parser: argparse.ArgumentParser) -> None:
    """Add the option --out."""
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for JSON and a figure")


def write(
    folder: Path | None,
    name: str,
    numbers: Any,
    rows: Mapping[str, Mapping[str, float | None]],
    label: str,
    limits: Mapping[str, float] | None = None,
) -> None:
    """Write name.json, name.png and name.svg to `folder`, if there is one; rows, label and limits
    are those of studies/dots.py."""
    if folder is None:
        return
    from meshskin.core.atomic_io import write_json  # imported last, as memory is measured
    from meshskin.report import theme

    sys.path.append(str(Path(__file__).parents[1]))
    from dots import dots

    theme.save(dots(rows, label, limits=limits), folder, name)
    write_json(folder / f"{name}.json", numbers)
