"""Validation of pose graphs, and g2o files."""

import warnings

import numpy as np
import pytest
from scipy.optimize import least_squares

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
        (3, put((1, 0, 1), 1e5), "must be symmetric, got edge 1"),
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


def test_the_memory_order_of_the_arrays_does_not_matter(skin_graph):
    graph, _ = skin_graph(12)
    arrays = (graph.poses, graph.edges, graph.measurements, graph.information)
    columns = PoseGraph(*map(np.asfortranarray, arrays))
    rows = graph.solve(objective="chordal")
    assert columns.solve(objective="chordal").cost == rows.cost
    np.testing.assert_array_equal(columns.solve().poses, graph.solve().poses)


def with_information(graph, information):
    return PoseGraph(graph.poses, graph.edges, graph.measurements, information)


def with_coupling(graph, rows):
    """The graph with translation and rotation of `rows` correlated by more than 1."""
    information = np.array(graph.information)
    information[rows, 0, 3] = information[rows, 3, 0] = 2 * np.sqrt(
        information[rows, 0, 0] * information[rows, 3, 3]
    )
    return with_information(graph, information)


def test_the_chordal_objective_takes_indefinite_information(skin_graph):
    """It needs the traces of the inverses of the two blocks alone: no projection, no warning."""
    graph, _ = skin_graph(30)
    indefinite = with_coupling(graph, [0, 5, 7])
    assert np.linalg.eigvalsh(indefinite.information).min() < 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solution = indefinite.solve("chordal")
        assert solution.certificate.certified
        indefinite.solve("chordal", robust="huber")
    assert np.array_equal(solution.poses, graph.solve("chordal").poses)


def test_the_geodesic_objective_projects_indefinite_information(skin_graph):
    graph, _ = skin_graph(30)
    indefinite = with_coupling(graph, [0, 5, 7])
    message = f"information of 3 of {len(graph.edges)} displacements is not positive semidefinite"
    with pytest.warns(RuntimeWarning, match=message) as caught:
        solution = indefinite.solve()
    assert len(caught) == 1
    assert solution.is_optimal
    values, vectors = np.linalg.eigh(indefinite.information[5])
    nearest = vectors @ np.diag(np.maximum(values, 0.0)) @ vectors.T
    projected = indefinite.semidefinite_information
    assert np.allclose(projected[5], nearest, rtol=0, atol=1e-12 * values[-1])
    kept = np.delete(np.arange(len(graph.edges)), [0, 5, 7])
    assert np.array_equal(projected[kept], graph.information[kept])


def test_blocks_that_are_not_semidefinite_have_no_chordal_weight(skin_graph):
    graph, _ = skin_graph(30)
    information = np.array(graph.information)
    information[[1, 4], 2, 2] *= -1e-3
    with pytest.warns(RuntimeWarning, match=f"information of 2 of {len(graph.edges)} .* is zero"):
        tau, kappa = with_information(graph, information).chordal_weights
    assert np.flatnonzero(tau == 0.0).tolist() == [1, 4]
    assert (kappa > 0.0).all()


def test_an_indefinite_block_with_a_large_chordal_weight_is_named(skin_graph):
    graph, _ = skin_graph(30)
    information = np.array(graph.information)
    information[3, :3, :3] = np.diag([1.0, 1.0, -0.501]) * information[3, 0, 0]  # 1 + 1 - 2
    with pytest.warns(RuntimeWarning, match=f"information of 1 of {len(graph.edges)} .* too large"):
        tau, _ = with_information(graph, information).chordal_weights
    assert tau[3] > 100 * tau[4]


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
        (GOOD + "EDGE_SE2_XY 0 1 2\n", "line 4: unknown tag, got EDGE_SE2_XY"),
        (GOOD + "VERTEX_SE3:QUAT 4 0 0 0\n", "line 4: wrong number of fields, got 4, limit: 8"),
        (GOOD.replace(" 1 0 0 0 0 0 1 ", " 1 0 0 0 x 0 1 ", 1), "line 3: not a number"),
        (GOOD.replace("QUAT 3 0", "QUAT 3 nan"), "line 2: not finite"),
        (GOOD.replace("QUAT 3 0", "QUAT 3.5 0"), "line 2: an id must be an integer"),
        (GOOD + VERTEX.format(2**53 + 2), "line 4: the id is too large, got .*9007199254740994"),
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


def planar_graph(count=12, noise=0.02):
    """Vertices (n, 3), edges (m, 2), measurements (m, 3) and information (m, 3, 3) of a 2D ring."""
    rng = np.random.default_rng(0)
    yaw = 2 * np.pi * np.arange(count) / count
    vertices = np.stack([np.cos(yaw), np.sin(yaw), yaw + 0.5], axis=1)
    steps = [(k, (k + d) % count) for d in (1, 3) for k in range(count)]
    edges = np.array(steps)
    one, two = vertices[edges[:, 0]], vertices[edges[:, 1]]
    measured = relative(one, two) + noise * rng.normal(size=(len(edges), 3))
    roots = rng.normal(size=(len(edges), 3, 3)) + 2 * np.eye(3)
    return vertices, edges, measured, roots @ np.swapaxes(roots, 1, 2) / noise**2


def relative(one, two):
    """Displacements (m, 3): x, y in the frame of `one` (m, 3), and yaw."""
    x, y, yaw = (two - one).T
    c, s = np.cos(one[:, 2]), np.sin(one[:, 2])
    return np.stack([c * x + s * y, c * y - s * x, np.angle(np.exp(1j * yaw))], axis=1)


def planar_file(path, vertices, edges, measured, information):
    upper = np.triu_indices(3)
    lines = [f"VERTEX_SE2 {k} {x} {y} {yaw}" for k, (x, y, yaw) in enumerate(vertices)]
    for (i, j), row, matrix in zip(edges, measured, information, strict=True):
        numbers = " ".join(map(repr, [*row.tolist(), *matrix[upper].tolist()]))
        lines.append(f"EDGE_SE2 {i} {j} {numbers}")
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_planar_graph_is_solved_in_the_plane(tmp_path):
    """The minimum is that of the 2D cost, found here by SciPy."""
    vertices, edges, measured, information = planar_graph()
    path = planar_file(tmp_path / "plane.g2o", vertices, edges, measured, information)
    solution = PoseGraph.load(path).solve()
    assert solution.is_optimal
    assert not solution.undetermined
    assert np.abs(solution.poses[:, 2, 3]).max() < 1e-12
    assert np.abs(solution.poses[:, 2, :3] - [0, 0, 1]).max() < 1e-12
    root = np.swapaxes(np.linalg.cholesky(information), 1, 2)

    def residuals(x):
        at = np.concatenate([vertices[:1], x.reshape(-1, 3)])
        e = relative(at[edges[:, 0]], at[edges[:, 1]]) - measured
        e[:, 2] = np.angle(np.exp(1j * e[:, 2]))
        return np.einsum("eab,eb->ea", root, e).ravel()

    flat = least_squares(residuals, vertices[1:].ravel(), xtol=1e-14, ftol=1e-14, gtol=1e-12)
    assert np.isclose(solution.cost, flat.cost, rtol=1e-9)
    found = solution.poses[1:, :2, 3]
    assert np.allclose(found, flat.x.reshape(-1, 3)[:, :2], atol=5e-5 * 0.02)


def test_a_planar_graph_has_the_chordal_weights_of_2d(tmp_path):
    """tau = 2 / tr(inv(I_xy)), kappa = I_yaw, as in SE-Sync; and its minimum is certified."""
    vertices, edges, measured, information = planar_graph()
    graph = PoseGraph.load(planar_file(tmp_path / "a.g2o", vertices, edges, measured, information))
    tau, kappa = graph.chordal_weights
    inverse = np.linalg.inv(information[:, :2, :2])
    assert np.allclose(tau, 2 / np.trace(inverse, axis1=1, axis2=2), rtol=1e-12)
    assert np.allclose(kappa, information[:, 2, 2], rtol=1e-12)
    assert graph.solve("chordal").certificate.certified


def test_2d_and_3d_lines_in_one_file(tmp_path):
    path = tmp_path / "both.g2o"
    path.write_text(
        "VERTEX_SE2 7 1 2 0.5\n" + VERTEX.format(3) + "EDGE_SE2 3 7 1 2 0.5 4 0 0 9 0 16\n"
    )
    graph = PoseGraph.load(path)
    assert graph.ids.tolist() == [3, 7]
    assert np.allclose(graph.poses[1, :, 3], [1, 2, 0, 1])
    assert np.allclose(graph.poses[1], graph.measurements[0], atol=1e-15)
    z = 2 / (1 / 4 + 1 / 9)
    assert np.allclose(graph.information[0], np.diag([4, 9, z, 64, 64, 16]))


def test_zero_2d_information_stays_zero(tmp_path):
    path = tmp_path / "zero.g2o"
    path.write_text("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 0 0 0 0 0 0\n")
    assert not PoseGraph.load(path).information.any()
