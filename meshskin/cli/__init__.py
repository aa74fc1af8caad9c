"""The command line, one command a file: each adds its parser and a function `command`."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import TextIO

from ..core.errors import MeshskinError
from . import calibrate, check, cost, diff, lint, run, scenes, study

COMMANDS = (run, calibrate, scenes, cost, study, check, lint, diff)
INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command: 0 when it worked, 2 for bad input (one line on stderr), 130 on Ctrl-C."""
    options = _parser().parse_args(arguments)
    with _interruptions() as interrupted, warnings.catch_warnings():
        warnings.showwarning = _note
        try:
            return int(options.command(options))
        except MeshskinError as error:
            if not interrupted:
                print(f"meshskin: {error}", file=sys.stderr)
                return 2
        except KeyboardInterrupt:
            pass
        except Exception:
            # compiled libraries turn an interruption into errors of their own
            if not interrupted:
                raise
    print("meshskin: interrupted; no half-written file is left", file=sys.stderr)
    return INTERRUPTED


def _note(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Show a warning as one line, without the source that raised it."""
    print(f"meshskin: {message}", file=sys.stderr)


@contextmanager
def _interruptions() -> Iterator[list[int]]:
    """The interrupt signals received inside; each raises KeyboardInterrupt, too."""
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield received
        return
    before = signal.signal(signal.SIGINT, note)
    try:
        yield received
    finally:
        signal.signal(signal.SIGINT, before)


def _parser() -> argparse.ArgumentParser:
    from ..core.provenance import versions

    parser = argparse.ArgumentParser(
        prog="meshskin", description="Self-calibration of robot skin on any body mesh."
    )
    parser.add_argument("--version", action="version", version=f"meshskin {versions()['meshskin']}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for module in COMMANDS:
        module.add(commands)
    return parser
