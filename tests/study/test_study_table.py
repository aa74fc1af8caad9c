"""The table of a study as a notebook shows it."""

import pickle

import pyarrow as pa
import pytest

from meshskin.core.errors import StudyError
from meshskin.core.palette import METHOD_COLOURS
from meshskin.study.sweep.study_table import StudyTable

COLUMNS = {
    "a.x": [1, 1, 2, 2],
    "kind": ["p", "q", "p", "q"],
    "method": ["joint"] * 4,
    "seed": [0] * 4,
    "key": list("abcd"),
    "status": ["done", "done", "done", "failed"],
    "error": [None, None, None, "broken"],
    "words": list("efgh"),
    "rms": [1.0, 2.0, 3.0, None],
}


@pytest.fixture
def results():
    return StudyTable(pa.table(COLUMNS), ("a.x", "kind"), "mine")


def test_the_card_counts_cases_and_names_parameters_and_results(results):
    facts = results.facts()
    assert facts["cases"] == "3 done, 1 failed"
    assert facts["a.x"] == "1, 2"
    assert facts["results"] == "rms"
    assert "data:image/png" in results._repr_html_()
    assert results.to_pandas().shape == (4, 9)


def test_tables_compare_by_content(results):
    assert pickle.loads(pickle.dumps(results)) == results
    assert StudyTable(results.table.slice(1), results.parameters, "mine") != results


def test_a_figure_has_a_line_for_each_value_of_the_second_parameter(results):
    (axes,) = results.plot().axes
    lines = {line.get_label(): line.get_xydata().tolist() for line in axes.lines}
    assert lines == {"kind = p": [[1, 1], [2, 3]], "kind = q": [[1, 2]]}
    (axes,) = results.plot(x="kind", by="seed").axes
    assert [line.get_ydata().tolist() for line in axes.lines] == [[2.0, 2.0]]
    with pytest.raises(StudyError, match="no such column"):
        results.plot(y="mean")


def test_a_figure_names_quantities_shows_single_cases_and_has_the_colours_of_methods():
    columns = {"skin.spacing_mm": [4, 4, 8, 8], "seed": [0, 1] * 2, "rms": [1.0, 3.0, 2.0, 4.0]}
    columns |= {"status": ["done"] * 4, "method": ["centroid", "centroid", "joint", "joint"]}
    results = StudyTable(pa.table(columns), ("skin.spacing_mm",))
    (axes,) = results.plot(y="rms", by="method").axes
    assert axes.get_xlabel() == "skin, spacing (mm)"
    colours = {line.get_label(): line.get_color() for line in axes.lines}
    assert colours["method = centroid"] == METHOD_COLOURS["centroid"]
    dots = [artist.get_offsets().tolist() for artist in axes.collections]
    assert dots == [[[4, 1], [4, 3]], [[8, 2], [8, 4]]]


def test_a_study_without_results_says_so(results):
    empty = StudyTable(results.table.slice(3), ("a.x",))
    with pytest.raises(StudyError, match="no case has a result"):
        empty.plot()
    assert "no case has a result" in empty._repr_html_()
