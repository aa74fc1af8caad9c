"""The command line, one command a file: each adds its parser and a function `command`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from ..errors import MeshskinError
from . import run, scenes

COMMANDS = (run, scenes)
INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command: 0 when it worked, 2 for bad input (one line on stderr), 130 on Ctrl-C."""
    options = _parser().parse_args(arguments)
    try:
        return int(options.command(options))
    except MeshskinError as error:
        print(f"meshskin: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("meshskin: interrupted; no half-written file is left", file=sys.stderr)
        return INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    from ..provenance import versions

    parser = argparse.ArgumentParser(
        prog="meshskin", description="Self-calibration of robot skin on any body mesh."
    )
    parser.add_argument("--version", action="version", version=f"meshskin {versions()['meshskin']}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for module in COMMANDS:
        module.add(commands)
    return parser
