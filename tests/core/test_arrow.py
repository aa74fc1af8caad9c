"""Arrow columns made of NumPy arrays equal those that pyarrow makes."""

import numpy as np
import pyarrow as pa
import pytest

from meshskin.core import arrow

COLUMNS = {
    "floats": np.array([0.5, np.nan, -1.0]),
    "integers": np.arange(5, dtype=np.int8),
    "bool": np.array([True, False, True, True, False, False, True, True, True]),
    "a slice": np.arange(12.0)[::3],
    "empty": np.zeros(0),
    "a column of a matrix": np.arange(6.0).reshape(3, 2)[:, 1],
}


@pytest.mark.parametrize("name", COLUMNS)
def test_columns_are_those_of_pyarrow(name):
    values = COLUMNS[name]
    found = arrow.column(values)
    found.validate(full=True)
    assert found.type == pa.array(values).type
    np.testing.assert_array_equal(found.to_numpy(zero_copy_only=False), values)
    np.testing.assert_array_equal(arrow.values(pa.chunked_array([found])), values)
    np.testing.assert_array_equal(
        arrow.values(pa.chunked_array([found, found])), np.concatenate([values, values])
    )


def test_a_column_of_another_type():
    assert arrow.column(np.arange(3), pa.int32()).equals(pa.array([0, 1, 2], pa.int32()))
    with pytest.raises(pa.ArrowInvalid, match="2147483648"):
        arrow.column(np.array([2**31]), pa.int32())


@pytest.mark.parametrize("words", [[], ["a"], ["größer", "", "x"]])
def test_texts(words):
    found = arrow.texts(words)
    found.validate(full=True)
    assert found.equals(pa.array(words, pa.string()))


def test_a_table_and_its_texts():
    phase = pa.DictionaryArray.from_arrays(pa.array([0, 1, 0], pa.int8()), ["slide", "lift"])
    table = arrow.table({"x": np.arange(3.0), "phase": phase})
    assert table.equals(pa.table({"x": [0.0, 1.0, 2.0], "phase": phase}))
    both = pa.concat_tables([table, table]).column("phase")
    assert arrow.words(both).tolist() == ["slide", "lift", "slide"] * 2
    assert arrow.words(table.slice(1).column("phase")).tolist() == ["lift", "slide"]
    assert not len(arrow.words(table.slice(3).column("phase")))
    texts = pa.chunked_array([["slide", None], ["lift"]])
    assert (arrow.words(texts) == "slide").tolist() == [True, False, False]
