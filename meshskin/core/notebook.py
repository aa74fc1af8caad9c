"""What a notebook shows of an object: a card with its numbers and a small picture, and its table.

A card never raises: it states what cannot be shown, and why. matplotlib and pandas are imported
when a picture or a table is asked for.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING, Any

from .errors import ConfigError

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    from matplotlib.figure import Figure

AXES = ("x", "y", "z", "nx", "ny", "nz")
"""Columns of points and normals in a table."""
REASON_LENGTH = 200
"""Largest number of characters of the reason why something is not shown: two lines of a card."""
STYLE = {
    "card": "display:flex;flex-wrap:wrap;gap:14px;align-items:center;margin:4px 0;max-width:820px;",
    "facts": "flex:1 1 300px;min-width:0;",
    "title": "font-weight:600;margin-bottom:4px;",
    "table": "border-collapse:collapse;margin:0;",
    "name": "text-align:left;vertical-align:top;padding:1px 12px 1px 0;opacity:.7;"
    "font-weight:400;white-space:nowrap;",
    "value": "text-align:left;padding:1px 0;overflow-wrap:anywhere;",
    "picture": "background:white;border-radius:4px;flex:none;",
}
"""Styles of a card's elements; colours of text are those of the page, light or dark."""


class Card:
    """Base of objects that a notebook shows as a card; a class gives `facts` and perhaps `plot`."""

    def facts(self) -> Mapping[str, str]:
        """What the card says: short texts by name."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        return card(self)


class Tabular:
    """Base of objects that are a table, too; a class gives `to_arrow`."""

    def to_arrow(self) -> pa.Table:
        """The table (pyarrow)."""
        raise NotImplementedError

    def to_pandas(self) -> pd.DataFrame:
        """The table of `to_arrow` as a pandas DataFrame. Raises ConfigError without pandas."""
        return data_frame(self.to_arrow())


def data_frame(table: pa.Table) -> pd.DataFrame:
    """An Arrow table as a pandas DataFrame. Raises ConfigError without pandas."""
    try:
        import pandas  # noqa: F401
    except ImportError as error:
        raise ConfigError(
            "to_pandas needs pandas", remedy="pip install pandas; to_arrow() needs none"
        ) from error
    return table.to_pandas()


def card(shown: Card) -> str:
    """The card of an object in HTML."""
    title, facts, picture = type(shown).__name__, {}, ""
    try:
        facts = dict(shown.facts())
    except Exception as error:  # a notebook must show bad states, too
        facts["not shown"] = _reason(error)
    if hasattr(shown, "plot"):
        try:
            picture = _image(shown)
        except Exception as error:
            facts["no picture"] = _reason(error)
    rows = "".join(
        f'<tr style="background:none"><th style="{STYLE["name"]}">{escape(str(name))}</th>'
        f'<td style="{STYLE["value"]}">{escape(str(value))}</td></tr>'
        for name, value in facts.items()
    )
    return (
        f'<div class="meshskin-card" style="{STYLE["card"]}">{picture}'
        f'<div style="{STYLE["facts"]}">'
        f'<div style="{STYLE["title"]}">{escape(title)}</div>'
        f'<table style="{STYLE["table"]}"><tbody>{rows}</tbody></table></div></div>'
    )


def _image(shown: Any) -> str:
    """The small picture of an object as an image element; "" where there is nothing to draw."""
    from . import drawing

    figure: Figure = shown.plot(ax=drawing.small_axes())
    width, height = (int(x) for x in figure.get_size_inches() * drawing.SMALL_POINTS)
    data = base64.b64encode(drawing.png(figure)).decode("ascii")
    return (
        f'<img alt="{escape(type(shown).__name__)}" width="{width}" height="{height}" '
        f'style="{STYLE["picture"]}" src="data:image/png;base64,{data}">'
    )


def _reason(error: Exception) -> str:
    """An exception in one short line."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= REASON_LENGTH else f"{text[: REASON_LENGTH - 3]}..."
