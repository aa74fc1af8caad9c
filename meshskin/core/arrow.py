"""Arrow columns of NumPy arrays.

`pyarrow.array`, `pyarrow.table`, `pyarrow.dataset` and `to_numpy` import pandas if it is installed,
which takes half a second; a cast imports `pyarrow.compute`. To avoid both, the columns that every
run uses are made from the memory of NumPy arrays, and read as such.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pyarrow as pa


def column(values: np.ndarray, type: pa.DataType | None = None) -> pa.Array:
    """The Arrow column of numbers or bool `values` (n,); type: another one to cast it to.

    Raises pyarrow.ArrowInvalid for integers that do not fit the type.
    """
    values = np.ascontiguousarray(values)
    if type is not None and pa.types.is_integer(type) and values.dtype.kind == "i":
        cast = values.astype(type.to_pandas_dtype())
        values = cast if np.array_equal(cast, values) else values
    if values.dtype == bool:
        own, memory = pa.bool_(), np.packbits(values, bitorder="little")
    else:
        own, memory = pa.from_numpy_dtype(values.dtype), values
    found = pa.Array.from_buffers(own, len(values), [None, pa.py_buffer(memory)])
    return found if type is None or type == own else found.cast(type)


def texts(values: Sequence[str]) -> pa.Array:
    """The Arrow column of strings."""
    coded = [value.encode() for value in values]
    ends = np.cumsum([0, *map(len, coded)]).astype(np.int32)
    buffers = [None, pa.py_buffer(ends), pa.py_buffer(b"".join(coded))]
    return pa.Array.from_buffers(pa.string(), len(coded), buffers)


def table(columns: Mapping[str, np.ndarray | pa.Array]) -> pa.Table:
    """The Arrow table of columns by name."""
    arrays = [c if isinstance(c, pa.Array) else column(c) for c in columns.values()]
    return pa.Table.from_arrays(arrays, names=list(columns))


def values(column: pa.ChunkedArray) -> np.ndarray:
    """The values (n,) of a column, without a copy where it is one chunk of numbers."""
    numbers = pa.types.is_integer(column.type) or pa.types.is_floating(column.type)
    if not numbers or column.null_count or not column.num_chunks:
        return np.asarray(column.to_numpy())
    parts = [np.from_dlpack(chunk) for chunk in column.chunks]
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def words(column: pa.ChunkedArray) -> np.ndarray:
    """The texts (n,) str of a column of texts, or of texts by dictionary."""
    if not pa.types.is_dictionary(column.type):
        return np.array(column.to_pylist(), dtype=str)
    found = [np.zeros(0, dtype=str)]
    for chunk in column.chunks:
        known = np.array(chunk.dictionary.to_pylist(), dtype=str)
        found.append(known[np.from_dlpack(chunk.indices)])
    return np.concatenate(found)
