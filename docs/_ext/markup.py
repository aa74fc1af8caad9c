"""Docstrings, which are plain text with code between single backticks, as reStructuredText."""

from __future__ import annotations

import re
from collections.abc import Iterator
from textwrap import dedent

_CODE = re.compile(r"(`[^`\n]+`)")
_ITEM = re.compile(r"\s*(- |\d+\. )")


def rst(text: str) -> str:
    """A docstring as reStructuredText: indented paragraphs are code, all else is as it stands."""
    return "\n\n".join(_block(block) for block in _blocks(text))


def _blocks(text: str) -> Iterator[str]:
    """The paragraphs; one indented run of lines, with its empty lines, is one paragraph."""
    kept: list[str] = []
    for block in re.split(r"\n\s*\n", text.strip("\n")):
        if kept and block.startswith("    ") and kept[-1].startswith("    "):
            kept[-1] += f"\n\n{block}"
        else:
            kept.append(block)
    yield from filter(str.strip, kept)


def _block(block: str) -> str:
    if block.startswith(">>> "):
        return ".. doctest::\n\n" + "\n".join(f"    {line}" for line in block.splitlines())
    if block.startswith("    ") and not _ITEM.match(block):
        return f".. code-block:: {_language(dedent(block))}\n\n{block}"
    lines = block.splitlines()
    hanging = len(lines) > 1 and lines[1].startswith("    ") and not _ITEM.match(lines[0])
    if hanging or ("  " in lines[0].strip() and len(lines) > 1):  # a table set by spaces
        body = "\n".join(f"    {line}" for line in lines)
        return f".. code-block:: text\n\n{body}"
    text = "\n".join(_inline(line) for line in lines)
    return re.sub(r"(?m)^((?!- )\S.*\n)(?=- )", r"\1\n", text)  # a list begins after an empty line


def _language(code: str) -> str:
    """Python where it is valid Python and more than a formula, else plain text."""
    try:
        compile(code, "docstring", "exec")
    except SyntaxError:
        return "text"
    return "python" if re.search(r"\w\(|@|import ", code) else "text"


def _inline(line: str) -> str:
    parts = _CODE.split(line)
    return "".join(f"`{p}`" if _CODE.fullmatch(p) else _escaped(p) for p in parts)


def _escaped(text: str) -> str:
    return re.sub(r"([*|\\]|_(?!\w))", r"\\\1", text)
