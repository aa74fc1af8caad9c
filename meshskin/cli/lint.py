"""`meshskin lint FILE`: what is wrong with a skin file, and what to do about it."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..skin.lint import Finding

SHOWN = 12
"""stretches of numbers that a line shows"""


def add(commands: Any) -> None:
    """Add the command to the parser's commands."""
    parser = commands.add_parser(
        "lint",
        help="find what is wrong with a skin file",
        description="Find what is wrong with a skin file. Exit code 0: nothing; 1: something; "
        "2: it cannot be read.",
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="a skin file, of any format")
    parser.add_argument("--part", help="of a URDF with several skins")
    parser.add_argument("--all", action="store_true", help="show every taxel of long lists")
    parser.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    """Print the findings."""
    from ..skin import files
    from ..skin.lint import check

    table = files.read(options.file, options.part)
    findings = check(table)
    count = int(table.is_taxel().sum())
    print(f"{options.file.name}: {table.format}, {count} taxels, {said(len(findings))}")
    for finding in findings:
        print()
        for line in lines(finding, None if options.all else SHOWN):
            print(line)
    return 1 if findings else 0


def said(count: int) -> str:
    """The number of findings in words."""
    return {0: "nothing found", 1: "1 finding"}.get(count, f"{count} findings")


def lines(finding: Finding, shown: int | None) -> Iterator[str]:
    """A finding in lines of text."""
    yield f"{finding.kind}: {finding.what}"
    if finding.taxels:
        yield f"  taxels   {numbers(finding.taxels, shown)}"
    if finding.modules:
        yield f"  modules  {numbers(finding.modules, shown)}"
    yield f"  remedy   {finding.remedy}"


def numbers(values: Sequence[int], shown: int | None) -> str:
    """Sorted numbers as stretches, "0-5, 7", of which at most `shown`."""
    stretches: list[list[int]] = []
    for value in values:
        if stretches and value == stretches[-1][1] + 1:
            stretches[-1][1] = value
        else:
            stretches.append([value, value])
    few = stretches[:shown]
    text = ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in few)
    left = sum(b - a + 1 for a, b in stretches[len(few) :])
    return f"{text}, and {left} more (--all)" if left else text
