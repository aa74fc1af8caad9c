"""The command line, one command a file, with functions `add` (its arguments) and `command`.

The docstring of a file is the command's help, and from the second paragraph on its description.
"""

from __future__ import annotations

import argparse
import atexit
import gc
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from types import FrameType
from typing import NoReturn, TextIO

from .. import __version__
from ..core.errors import MeshskinError
from .options import in_options

COMMANDS = (
    "run", "calibrate", "recalibrate", "live", "report", "init", "log", "scenes", "effects", "cost",
    "study", "check", "lint", "diff",
)  # fmt: skip
"""Names of the commands and of their modules."""
BAD_INPUT = 2
"""Exit code for input that meshskin refuses."""
INTERRUPTED = 130
"""Exit code after Ctrl-C, 128 + SIGINT, as shells have it."""
CLOSED_PIPE = 141
"""Exit code when the reader of the output is gone, 128 + SIGPIPE, as shells have it."""
atexit.register(gc.freeze)  # the objects that are left at exit are not searched again: 0.6 s less


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code.

    0 when it worked, 2 for bad input (one line on stderr), 130 after Ctrl-C, 141 when the output
    is piped into a command that ended; a command may document others.
    """
    with _interruptions() as interrupted, _rare_collections(), warnings.catch_warnings():
        warnings.showwarning = _note
        try:
            try:
                given = sys.argv[1:] if arguments is None else arguments
                options, unknown = _parser(given).parse_known_args(given)
                if unknown:
                    options.parser.error(f"unknown arguments: {' '.join(unknown)}")
            except SystemExit as ended:  # after --help or --version, or a wrong command line
                return int(ended.code or 0)
            code = int(options.command(options))
            sys.stdout.flush()
            if not interrupted:
                return code
        except BrokenPipeError:
            # the interpreter flushes stdout once more when it exits
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return CLOSED_PIPE
        except MeshskinError as error:
            if not interrupted:
                print(f"meshskin: {in_options(str(error))}", file=sys.stderr)
                return BAD_INPUT
        except KeyboardInterrupt:
            pass
        except Exception:
            # compiled libraries turn an interruption into errors of their own
            if not interrupted:
                raise
    print("meshskin: interrupted; no half-written file is left", file=sys.stderr)
    return INTERRUPTED


@contextmanager
def _rare_collections() -> Iterator[None]:
    """Objects are searched for garbage less often: imports make 190,000, which are searched 480
    times by default."""
    before = gc.get_threshold()
    gc.set_threshold(50_000)
    try:
        yield
    finally:
        gc.set_threshold(*before)


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
    """The interrupt signals received inside; each raises KeyboardInterrupt, too.

    An interruption that a compiled library swallows in a callback is not printed as a traceback.
    """
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield received
        return
    before, hook = signal.signal(signal.SIGINT, note), sys.unraisablehook
    sys.unraisablehook = lambda raised: None if received else hook(raised)
    try:
        yield received
    finally:
        signal.signal(signal.SIGINT, before)
        sys.unraisablehook = hook


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, as all others of the command line."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"{self.prog}: {message}; {self.prog} --help lists what it takes\n")


def _parser(arguments: Sequence[str] = ()) -> argparse.ArgumentParser:
    """The parser of the command that the arguments begin with, of all where it is none."""
    parser = _Parser(
        prog="meshskin", description="Self-calibration of robot skin on any body mesh."
    )
    parser.add_argument("--version", action="version", version=f"meshskin {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name in set(arguments[:1]) & set(COMMANDS) or COMMANDS:
        module = import_module(f".{name}", __name__)
        title, _, description = str(module.__doc__).partition("\n\n")
        command = commands.add_parser(
            name, help=title.partition(": ")[2].rstrip("."), description=description or None
        )
        module.add(command)
        command.set_defaults(command=module.command, parser=command)
    return parser
