"""Files of a calibration: PATH.parquet, which is read back, and PATH.csv, a table for people."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ..core import arrow
from ..core.arguments import check_path
from ..core.atomic_io import atomic, write_text
from ..core.errors import CalibrationError
from .result import LearnedResponse
from .uncertainty.goodness_of_fit import GoodnessOfFit
from .uncertainty.verdict import Verdict

if TYPE_CHECKING:
    from .calibration import Calibration

_KEY = b"meshskin-calibration"
_SAME = ("ids", "poses", "covariances", "observed", "touched", "readings", "chi2")
_COLUMNS = {name: name for name in _SAME} | {"reasons": "why"}
"""Columns of a file by field."""
_OPTIONAL = {"faults": "faults", "contact_centroids": "middles", "rivals": "rivals"}
"""Columns by field that a calibration may be without."""
_NUISANCE = "taxel_"
"""Prefix of the columns of nuisance parameters."""
_HEADER = (
    *("method", "anchor", "factors", "modulus", "modulus_sigma", "unknowns", "undetermined"),
    *("seconds", "provenance", "disc_radius", "frame"),
)


def write(found: Calibration, path: str | Path) -> None:
    """Write path.parquet and path.csv. Raises OutputError."""
    path = Path(path)
    columns = {column: _column(getattr(found, name)) for name, column in _COLUMNS.items()}
    steps = 0 if found.iterates is None else len(found.iterates)
    if found.iterates is not None:
        columns["iterates"] = _column(np.swapaxes(found.iterates, 0, 1))
    for name, column in _OPTIONAL.items():
        values = getattr(found, name)
        if values is not None and not (name == "rivals" and np.isnan(values).all()):
            columns[column] = _column(values)
    columns |= {_NUISANCE + name: _column(values) for name, values in found.taxel_unknowns.items()}
    header = {name: getattr(found, name) for name in _HEADER} | {"steps": steps}
    header["fit"] = None if found.fit is None else asdict(found.fit)
    header["verdict"] = None if found.verdict is None else asdict(found.verdict)
    header["response"] = None if found.response is None else found.response.values()
    table = arrow.table(columns).replace_schema_metadata({_KEY: json.dumps(header).encode()})
    with atomic(_part(path, "parquet")) as temporary:
        pq.write_table(table, temporary)
    write_text(_part(path, "csv"), csv(found))


def read(path: str | Path, kind: Callable[..., Calibration]) -> Calibration:
    """The calibration, made by `kind` of its fields, that `write` wrote.

    Raises CalibrationError for other files, and for those of versions with other fields.
    """
    path = check_path("a calibration file", path, error=CalibrationError)
    file = _part(path, "parquet")
    if not file.exists():
        raise CalibrationError(f"no calibration at {path}", remedy="check the path")
    try:
        table = pq.ParquetFile(file).read()
    except (pa.ArrowInvalid, OSError) as error:
        raise CalibrationError(
            f"{file} cannot be read", value=str(error).splitlines()[0], remedy="calibrate again"
        ) from error
    metadata = table.schema.metadata or {}
    missing = set(_COLUMNS.values()) - set(table.column_names)
    if _KEY not in metadata or missing:
        raise CalibrationError(f"{file} holds no calibration", remedy="check the path")
    try:
        return kind(**_values(table, json.loads(metadata[_KEY])))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CalibrationError(
            f"{file} is a calibration of another version of meshskin, or damaged",
            value=f"{type(error).__name__}: {error}",
            remedy="calibrate again",
        ) from error


def _values(table: pa.Table, header: dict[str, Any]) -> dict[str, Any]:
    """The fields of a calibration in the columns and the header of a file."""
    n, steps = table.num_rows, header.pop("steps")
    shapes = {"poses": (n, 4, 4), "covariances": (n, 6, 6), "observed": (n, 6)}
    values: dict[str, Any] = {
        name: _array(table, column).reshape(shapes.get(name, (n,)))
        for name, column in _COLUMNS.items()
    }
    if steps:
        values["iterates"] = np.swapaxes(_array(table, "iterates").reshape(n, steps, 3), 0, 1)
    for name, column in _OPTIONAL.items():
        if column in table.column_names:
            values[name] = _array(table, column).reshape(n if name == "faults" else (n, 3))
    values["taxel_unknowns"] = {
        name.removeprefix(_NUISANCE): _array(table, name).reshape(n, 2)
        for name in table.column_names
        if name.startswith(_NUISANCE)
    }
    if (fit := header.get("fit")) is not None:
        header["fit"] = GoodnessOfFit(**fit)
    if (verdict := header.get("verdict")) is not None:
        header["verdict"] = Verdict(
            verdict["level"], tuple(verdict["reasons"]), tuple(verdict.get("untested", ()))
        )
    if (response := header.get("response")) is not None:
        header["response"] = LearnedResponse.from_values(response)
    header["unknowns"] = {k: tuple(v) for k, v in header.get("unknowns", {}).items()}
    for name in ("factors", "undetermined"):
        header[name] = tuple(header.get(name, ()))
    return {**values, **header}


def csv(found: Calibration) -> str:
    """A table in CSV: one row a taxel, lengths in mm, empty where not determined."""
    rows = ["taxel,x_mm,y_mm,z_mm,nx,ny,nz,sigma_mm,readings,note"]
    numbers = np.column_stack(
        [1e3 * found.positions, found.poses[:, :3, 2], 1e3 * found.position_sigma]
    )
    faults = np.full(len(found.ids), "") if found.faults is None else found.faults
    for k, values in enumerate(numbers):
        text = [f"{x:.6f}" if np.isfinite(x) else "" for x in values]
        note = "; ".join(filter(None, [found.reasons[k], faults[k].replace(",", ";")]))
        rows.append(",".join([str(found.ids[k]), *text, str(found.readings[k]), note]))
    return "\n".join(rows) + "\n"


def _part(path: Path, suffix: str) -> Path:
    return path.parent / f"{path.name.removesuffix('.parquet')}.{suffix}"


def _column(values: np.ndarray) -> pa.Array:
    """An Arrow column of the rows of `values` (n, ...), each row flat."""
    values = np.asarray(values)
    if values.ndim == 1:
        return arrow.texts(values.tolist()) if values.dtype.kind in "OU" else arrow.column(values)
    flat = np.ascontiguousarray(values).reshape(len(values), -1)
    return pa.FixedSizeListArray.from_arrays(arrow.column(flat.ravel()), flat.shape[1])


def _array(table: pa.Table, name: str) -> np.ndarray:
    column = table.column(name).combine_chunks()
    if isinstance(column, pa.ChunkedArray):
        column = column.chunk(0)
    if isinstance(column, pa.FixedSizeListArray):
        column = column.flatten()
    if pa.types.is_string(column.type):
        return np.array(column.to_pylist(), dtype=object)
    return np.array(column.to_numpy(zero_copy_only=False))
