"""What options of all commands share: numbers in a range, and which of them were given."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.arguments import check_real
from ..core.errors import ConfigError

if TYPE_CHECKING:
    from ..skin.skin import Skin

OPTIONS = {
    "open=True": "--open",
    " (scan=True)": "",
    'kind="collision"': "--link-mesh collision",
    "from_urdf folders=": "--folder",
}
"""Words of messages on arguments in Python, and those for the command line."""
RESULTS = "folder for the results"
QUIET = "print no progress bar and no summary"


def in_options(text: str) -> str:
    """A message with options of the command line in place of arguments in Python."""
    for argument, option in OPTIONS.items():
        text = text.replace(argument, option)
    text = re.sub(r"units=['\"](\w+)['\"]", r"--units \1", text)
    names = re.compile(r"\w+")
    return re.sub(
        r"unknown=\(([^)]*)\)", lambda m: " ".join(["--unknown", *names.findall(m[1])]), text
    )


def option(
    parser: argparse._ActionsContainer,
    names: str,
    words: str,
    type: Callable[[str], object] | None = None,
    **more: Any,
) -> None:
    """Add an option or an argument.

    names: its names, and those of its values in the help: "--out DIR", "scene SCENE"; an option
    without values is a switch.
    """
    first, *rest = names.split()
    flags = [first, *(name for name in rest if name.startswith("-"))]
    values = tuple(rest[len(flags) - 1 :])
    if values:
        more |= {"type": type, "metavar": values[0] if len(values) == 1 else values}
    else:
        more["action"] = "store_true"
    parser.add_argument(*flags, help=words, **more)


def real(
    *, above: float | None = None, least: float | None = None, most: float | None = None
) -> Callable[[str], float]:
    """The type of an option that is a finite number in a range: it is checked before the command
    begins."""

    def convert(text: str) -> float:
        try:
            return check_real("the number", float(text), above=above, least=least, most=most)
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"{text!r} is not a number") from error
        except ConfigError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return convert


def integer(least: int) -> Callable[[str], int]:
    """The type of an option that is an integer of at least `least`."""
    in_range = real(least=least)

    def convert(text: str) -> int:
        try:
            value = int(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"{text!r} is not an integer") from error
        in_range(text)
        return value

    return convert


def given(options: argparse.Namespace, names: Iterable[str]) -> str:
    """Those of the options that were given, as on the command line; "" for none."""
    values = {name: getattr(options, name, None) for name in names}
    found = [k for k, v in values.items() if v is not None and v is not False and v != []]
    return ", ".join(f"--{name.replace('_', '-')}" for name in found)


def refuse(
    options: argparse.Namespace, names: Iterable[str], what: str, remedy: str = "leave it out"
) -> None:
    """Raise ConfigError where one of the options was given; `what` is wrong, {} those given."""
    if found := given(options, names):
        raise ConfigError(what.replace("{}", found), remedy=remedy)


def add_part(parser: argparse._ActionsContainer) -> None:
    """Add --part."""
    option(parser, "--part PART", "skin to read from a URDF or MJCF file with several")


def check_part(part: str | None, *paths: Path | None) -> None:
    """Raise ConfigError where --part is given and none of the files can have several skins."""
    from ..skin import files

    if part is not None and not any(path is not None and files.has_parts(path) for path in paths):
        raise ConfigError(
            "--part chooses a skin of a URDF or MJCF file", value=f"--part {part}",
            remedy="leave it out",
        )  # fmt: skip


def load_skin(path: Path, part: str | None) -> Skin:
    """The skin of a file; `part` counts for formats with several. Raises SkinError."""
    from ..skin import files
    from ..skin.skin import Skin

    return Skin.load(path, part if files.has_parts(path) else None)
