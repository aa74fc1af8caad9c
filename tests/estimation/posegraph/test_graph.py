"""Validation of pose graphs, and g2o files."""

import numpy as np
import pytest

from meshskin.core.errors import GraphError, OutputError
from meshskin.estimation.posegraph import PoseGraph


def parts(skin_graph, count=4):
    graph, _ = skin_graph(count)
    return [np.array(a) for a in (graph.poses, graph.edges, graph.measurements, graph.information)]


def broken(skin_graph, part, change):
    arrays = parts(skin_graph)
    arrays[part] = change(arrays[part])
    return arrays


def put(index, value):
    def change(array):
        array[index] = value
        return array

    return change


@pytest.mark.parametrize(
    ("part", "change", "message"),
    [
        (0, lambda a: a[:, :3], "poses have the wrong shape"),
        (0, lambda a: a[:0], "poses have the wrong shape"),
        (0, put((1, 0, 3), np.nan), "poses must be finite, got row 1"),
        (0, put((2, 0, 0), 5.0), "must be rigid transforms, got row 2"),
        (0, lambda a: a * np.array([-1, -1, -1, 1]), "must be rigid transforms"),
        (1, lambda a: a[:, :1], "edges have the wrong shape"),
        (1, lambda a: a.astype(float), "must be integers"),
        (1, put((0, 1), 99), "does not exist"),
        (1, put((0, 1), -1), "does not exist"),
        (1, put(0, (2, 2)), "must join two different poses"),
        (2, lambda a: a[:-1], "measurements have the wrong shape"),
        (2, put((0, 1, 3), np.inf), "measurements must be finite"),
        (3, lambda a: a[:-1], "information has the wrong shape"),
        (3, put((0, 1, 1), np.nan), "information must be finite"),
        (3, put((1, 0, 0), -1e3), "must be symmetric positive semidefinite"),
        (3, put((1, 0, 1), 1e5), "must be symmetric positive semidefinite"),
    ],
)
def test_refused(skin_graph, part, change, message):
    with pytest.raises(GraphError, match=message):
        PoseGraph(*broken(skin_graph, part, change))


def test_arrays_are_copied_and_locked(skin_graph):
    arrays = parts(skin_graph)
    graph = PoseGraph(*arrays)
    arrays[0][:] = 0
    assert graph.poses[0, 3, 3] == 1
    with pytest.raises(ValueError, match="read-only"):
        graph.poses[0, 0, 3] = 1.0


def test_file_round_trip(skin_graph, tmp_path):
    graph, _ = skin_graph(12)
    gaps = PoseGraph(
        graph.poses, graph.edges, graph.measurements, graph.information, 10 * np.arange(12) + 3
    )
    gaps.save(tmp_path / "graph.g2o")
    loaded = PoseGraph.load(tmp_path / "graph.g2o")
    assert np.array_equal(loaded.ids, gaps.ids)
    assert np.array_equal(loaded.edges, gaps.edges)
    assert np.array_equal(loaded.information, gaps.information)
    assert np.allclose(loaded.poses, gaps.poses, atol=1e-15)
    assert np.allclose(loaded.measurements, gaps.measurements, atol=1e-15)


VERTEX = "VERTEX_SE3:QUAT {} 0 0 0 0 0 0 1\n"
INFORMATION = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
"""The upper triangle of the identity (6, 6), row by row."""
EDGE = "EDGE_SE3:QUAT {} {} 1 0 0 0 0 0 1 " + INFORMATION + "\n"
GOOD = VERTEX.format(7) + VERTEX.format(3) + EDGE.format(7, 3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no VERTEX_SE3:QUAT"),
        (GOOD + "EDGE_SE2 0 1 2\n", "line 4: unknown tag, got EDGE_SE2"),
        (GOOD + "VERTEX_SE3:QUAT 4 0 0 0\n", "line 4: wrong number of fields, got 4, limit: 8"),
        (GOOD.replace(" 1 0 0 0 0 0 1 ", " 1 0 0 0 x 0 1 ", 1), "line 3: not a number"),
        (GOOD.replace("QUAT 3 0", "QUAT 3 nan"), "line 2: not finite"),
        (GOOD.replace("QUAT 3 0", "QUAT 3.5 0"), "line 2: an id must be an integer"),
        (GOOD.replace("0 0 0 1\n", "0 0 0 2\n", 1), "line 1: a quaternion must have norm 1, got 2"),
        (GOOD + "\n# fine\n" + VERTEX.format(7), "line 6: vertex defined twice"),
        (GOOD + EDGE.format(3, 8), r"line 4: .* two vertices of the file, got \(3, 8\)"),
        (GOOD + EDGE.format(3, 3), "line 4: .* two vertices of the file"),
    ],
)
def test_a_bad_line_is_named_in_the_error(tmp_path, text, message):
    path = tmp_path / "graph.g2o"
    path.write_text(text)
    with pytest.raises(GraphError, match=message):
        PoseGraph.load(path)


def test_ids_with_gaps_in_any_order(tmp_path):
    path = tmp_path / "graph.g2o"
    path.write_text("# a comment\n\n" + GOOD + "FIX 7\n")
    graph = PoseGraph.load(path)
    assert graph.ids.tolist() == [3, 7]
    assert graph.edges.tolist() == [[1, 0]]


def test_missing_file_is_a_graph_error(tmp_path):
    with pytest.raises(GraphError, match="cannot read"):
        PoseGraph.load(tmp_path / "nothing.g2o")


def test_a_file_that_cannot_be_written_leaves_the_old_one(skin_graph, tmp_path, monkeypatch):
    graph, _ = skin_graph(4)
    path = tmp_path / "graph.g2o"
    graph.save(path)
    before = path.read_text()

    def full_disk(self, text, **options):
        self.write_bytes(text[:100].encode())
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_text", full_disk)
    with pytest.raises(OutputError, match="No space left"):
        skin_graph(8)[0].save(path)
    assert path.read_text() == before
    assert list(tmp_path.iterdir()) == [path]
