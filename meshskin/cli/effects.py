"""`meshskin effects [NAME]`: list the effects, or say all about one.

Without NAME, every effect with the stage at which it acts; with NAME, its equation, its parameters
with their units, limits and defaults, what it requires and excludes, and the table that switches it
on in a scene file.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING

from .options import option

if TYPE_CHECKING:
    from ..effects import Effect


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    option(parser, "name NAME", "effect to describe", nargs="?")


def command(options: argparse.Namespace) -> int:
    """Print the list, or the details of one effect."""
    from .. import effects

    if options.name is not None:
        for line in details(effects.find(options.name)):
            print(line)
        return 0
    for name in effects.every_name():
        kind = effects.find(name)
        print(f"{name:18} {kind.stage:10} {head(kind)}")
    return 0


def head(kind: type[Effect]) -> str:
    """The first line of the docstring of an effect."""
    return (kind.__doc__ or "").strip().partition("\n")[0]


def details(kind: type[Effect]) -> Iterator[str]:
    """The lines about one effect."""
    from ..core.field_docs import field_docs, toml_lines

    text = sys.modules[kind.__module__].__doc__ or head(kind)
    yield from (f"{kind.name}: {text.strip()}").splitlines()
    yield ""
    yield f"stage     {kind.stage}"
    for what in ("requires", "excludes"):
        if names := getattr(kind, what, ()):
            yield f"{what}  {', '.join(names)}"
    yield f"cost      {1e9 * kind.cost:.3g} ns per taxel and frame"
    if docs := field_docs(kind):
        yield "\nParameters, SI units:"
        yield from (str(doc) for doc in docs)
    yield "\nIn a scene file:"
    yield "[[effects]]"
    yield f'kind = "{kind.name}"'
    yield from toml_lines(kind)
