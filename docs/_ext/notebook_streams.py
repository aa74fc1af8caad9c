"""Joins the chunks of a stream of a notebook as they are, and shows warnings without the file of
their cell, which is the kernel's own.

The output of a command (%%bash) comes in chunks. myst-nb (1.4) ends each with a new line, which
breaks lines in the middle.
"""

import re

from myst_nb.core import render
from nbformat import NotebookNode
from sphinx.application import Sphinx

coalesce = render.coalesce_streams
CELL = re.compile(r"^\S*ipykernel_\d+\S*:\d+: ", re.MULTILINE)
"""Place of a warning in a cell."""


def joined(outputs: list[NotebookNode]) -> list[NotebookNode]:
    """The outputs, each stream as one of them, at the place of its first chunk."""
    kept: list[NotebookNode] = []
    streams: dict[str, NotebookNode] = {}
    for output in outputs:
        if output["output_type"] == "stream" and output["name"] in streams:
            streams[output["name"]]["text"] += output["text"]
            continue
        kept.append(output)
        if output["output_type"] == "stream":
            streams[output["name"]] = output
    for output in streams.values():
        output["text"] = CELL.sub("", output["text"])
    return coalesce(kept)


def setup(app: Sphinx) -> dict[str, bool]:
    """Take the place of myst-nb's function."""
    render.coalesce_streams = joined
    return {"parallel_read_safe": True, "parallel_write_safe": True}
