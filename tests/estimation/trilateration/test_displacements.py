"""Displacements: their values, their covariance, and the graph that they make."""

import numpy as np
import pytest

from meshskin.core import se3
from meshskin.core.errors import CalibrationError
from meshskin.estimation import chart
from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.data.gather import gather
from meshskin.estimation.trilateration import trilaterate
from meshskin.estimation.trilateration.displacements import (
    SharedContacts,
    error_covariance,
    expected_readings,
)
from meshskin.estimation.uncertainty.metrics import nees, position_errors
from meshskin.geometry.primitives import Ellipsoid
from meshskin.recording.recording import Recording
from meshskin.simulation.contact_samplers import concatenate


def measured_with_errors(data, draws):
    """The pose graph of the displacements, and random errors (m, 6, draws) of its edges."""
    fit = trilaterate.least_squares(data)
    measured = SharedContacts(data, fit).displacements(draws=draws)
    return measured.graph(fit, data.ids), measured.errors


def displacement_graph(data, isotropic=False, trilateration=trilaterate.solve):
    """The pose graph of the displacements from the least-squares trilateration."""
    fit = trilaterate.least_squares(data)
    return SharedContacts(data, fit).displacements(trilateration).graph(fit, data.ids, isotropic)


def residuals(graph, poses):
    """e (m, 6) of the true poses against the measurements."""
    i, j = graph.edges.T
    true = se3.inverse(poses[i]) @ poses[j]
    turned = np.swapaxes(graph.measurements[:, :3, :3], 1, 2) @ true[:, :3, :3]
    shift = true[:, :3, 3] - graph.measurements[:, :3, 3]
    return np.concatenate([shift, se3.log_so3(turned)], axis=1)


def true_poses(world, graph):
    """True positions, with the graph's own headings."""
    normal = world.body.closest(world.truth).normal
    return se3.transform(chart.align_normals(graph.poses[:, :3, :3], normal), world.truth)


def test_ideal_data_give_the_true_displacements(world):
    graph = displacement_graph(gather(world.record(), world.belief()))
    assert len(graph.edges) > 2 * len(world.truth)
    assert np.array_equal(graph.ids, world.ids)
    assert len(np.unique(graph.components)) == 1
    assert np.abs(residuals(graph, true_poses(world, graph))).max() < 1e-6
    apart = np.linalg.norm(world.truth[graph.edges[:, 0]] - world.truth[graph.edges[:, 1]], axis=1)
    assert apart.max() < 2 * (world.a.max() + 2e-3)


def test_information_fits_the_errors(world):
    ratio = []
    for seed in range(4):
        data = gather(world.record(0.01, 0.05, seed), world.belief(0.01, 0.05))
        graph = displacement_graph(data)
        e = residuals(graph, true_poses(world, graph))
        ratio.append(np.einsum("mi,mij,mj->m", e, graph.information, e).mean())
    # Four directions carry noise, the floors add some variance of their own.
    assert 1.2 < np.mean(ratio) < 4.5


def test_isotropic_information_is_equal_for_all_edges(world):
    data = gather(world.record(0.01, 0.05), world.belief(0.01, 0.05))
    graph = displacement_graph(data, isotropic=True)
    full = displacement_graph(data)
    assert np.array_equal(graph.edges, full.edges)
    assert np.ptp(graph.information, axis=0).max() == 0
    diagonal = np.diag(graph.information[0])
    assert np.allclose(graph.information[0], np.diag(diagonal))
    assert np.ptp(diagonal[:3]) == np.ptp(diagonal[3:]) == 0
    assert diagonal[0] == pytest.approx(np.median(full.information[:, 0, 0]), rel=0.9)


def test_covariance_against_moved_taxels():
    body = Ellipsoid((0.1, 0.08, 0.12))
    points = np.array([[0.02, 0.03, 0.1], [0.024, 0.033, 0.1]])
    charts = chart.charts_at(body, points)
    rng = np.random.default_rng(5)
    root = np.array([[[3e-5, 0], [1e-5, 2e-5]], [[1e-5, 0], [-2e-5, 4e-5]]])
    cov = root @ np.swapaxes(root, 1, 2)
    n = 4000
    y = np.einsum("tij,ntj->nti", root, rng.normal(size=(n, 2, 2)))
    frames = np.concatenate([charts.tangents, charts.normals[:, :, None]], axis=2)
    poses = []
    for t in range(2):
        at = charts[np.full(n, t)].at(y[:, t])
        hit = body.closest(at)
        poses.append(se3.transform(chart.align_normals(frames[t], hit.normal), hit.point))
    true = se3.inverse(se3.transform(frames[:1], charts.points[:1])) @ se3.transform(
        frames[1:], charts.points[1:]
    )
    moved = se3.inverse(poses[0]) @ poses[1]
    turned = np.swapaxes(true[:, :3, :3], 1, 2) @ moved[:, :3, :3]
    e = np.concatenate([moved[:, :3, 3] - true[:, :3, 3], se3.log_so3(turned)], axis=1)
    told = error_covariance(true, charts.shape[:1], charts.shape[1:], cov[:1], cov[1:])[0]
    level = (np.trace(cov[0]) + np.trace(cov[1])) / 2
    floors = level * np.repeat([0.01, 9.0], 3)
    sampled = np.cov(e.T)
    size = np.sqrt(np.outer(np.diag(told), np.diag(told)))
    assert (np.abs(sampled - (told - np.diag(floors))) < 0.1 * size).all()


def test_no_neighbours_is_refused(world):
    lonely = type(world)(spacing=15e-3, extent=20e-3)
    data = gather(lonely.record(), lonely.belief())
    assert trilaterate.least_squares(data).found.all()
    with pytest.raises(CalibrationError, match=r"no two taxels.*denser skin"):
        displacement_graph(data)


@pytest.mark.parametrize("trilateration", [trilaterate.solve, trilaterate.intersect])
def test_repeated_contacts_do_not_count_as_distinct_circles(world, trilateration):
    """Of few contacts, each recorded four times, three steep circles may all be the same."""
    whole = world.record()
    keep = np.arange(len(whole.time)) % 12 == 0
    few = Recording(
        whole.contacts.filter(keep), whole.readings.filter(keep[whole.reading_contact]),
        whole.metadata,
    )  # fmt: skip
    often = concatenate(concatenate(few, few), concatenate(few, few))
    graph = displacement_graph(gather(often, world.belief()), trilateration=trilateration)
    assert len(graph.edges) > 20
    assert np.abs(residuals(graph, true_poses(world, graph))[:, :3]).max() < 1e-5


def test_displacements_with_an_undetermined_direction_are_left_out(world):
    """Circles whose centres are the same, or lie behind each other, inform of one direction."""

    def one_way(found, charts):
        y, information, chi2 = trilaterate.solve(found, charts)
        information[:, 1, :] = information[:, :, 1] = 0.0
        return y, information, chi2

    data = gather(world.record(), world.belief())
    with pytest.raises(CalibrationError, match="no displacement can be trilaterated"):
        displacement_graph(data, trilateration=one_way)


@pytest.mark.deep
def test_noise_above_a_low_threshold_makes_no_pairs(world):
    """Half of all readings are noise above a threshold of zero: everyone answers everywhere."""
    recording, belief = world.record(0.02), world.belief(0.02)
    data = gather(recording, belief)
    n = len(data.ids)
    assert len(data.pressure) > 0.4 * n * len(data.points)
    graph = displacement_graph(data)
    apart = np.linalg.norm(world.truth[graph.edges[:, 0]] - world.truth[graph.edges[:, 1]], axis=1)
    assert apart.max() < 3 * (world.a.max() + belief.disc_radius)  # 1.5 of them about each
    found = calibrate(recording, belief, method="posegraph")
    assert np.isfinite(found.positions).all()
    # what noise is left about a taxel draws it outwards, and the graph adds that up
    assert position_errors(found, world.skin, gauge=True).mean() < 1e-3


@pytest.mark.deep
@pytest.mark.parametrize(("noise", "threshold"), [(0.02, 0.0), (0.05, 0.1)])
def test_readings_near_the_noise_do_not_bias_displacements(world, noise, threshold):
    """Of readings that noise has raised over a limit all seem nearer than they are."""
    longer = []
    for seed in range(4):
        data = gather(world.record(noise, threshold, seed), world.belief(noise, threshold))
        graph = displacement_graph(data)
        i, j = graph.edges.T
        apart = np.linalg.norm(world.truth[i] - world.truth[j], axis=1)
        found = np.linalg.norm(graph.measurements[:, :3, 3], axis=1)
        spread = np.sqrt(np.trace(np.linalg.inv(graph.information)[:, :3, :3], axis1=1, axis2=2))
        longer.append(np.average(found / apart - 1, weights=spread**-2))
    assert abs(np.mean(longer)) < 2e-3


def test_only_readings_with_a_clear_expected_pressure_are_used(world):
    data = gather(world.record(0.02, 0.0), world.belief(0.02))
    fit = trilaterate.least_squares(data)
    kept = expected_readings(data, fit)
    expected = (world.pressures()[kept.contact, kept.taxel]) / data.sigma
    assert expected.min() > 1.0  # LEAST, at the estimated places
    assert kept.pressure.min() < 2 * data.sigma < np.median(kept.pressure)
    lost = np.setdiff1d(data.contact * 1000 + data.taxel, kept.contact * 1000 + kept.taxel)
    assert world.pressures()[lost // 1000, lost % 1000].max() < 3.0 * data.sigma


@pytest.fixture(scope="module")
def drawn(world):
    """Readings, their graph and 60 random errors of its edges."""
    data = gather(world.record(0.01, 0.05), world.belief(0.01, 0.05))
    return data, *measured_with_errors(data, draws=60)


def test_random_errors_agree_with_the_information(drawn):
    data, graph, errors = drawn
    again, none = measured_with_errors(data, draws=0)
    assert np.array_equal(graph.measurements, again.measurements)
    assert none.shape == (len(graph.edges), 6, 0)
    spread = np.linalg.inv(graph.information)
    size = np.mean(errors[:, :2] ** 2, axis=(1, 2))
    told = np.trace(spread[:, :2, :2], axis1=1, axis2=2) / 2
    assert np.median(size / told) == pytest.approx(1.0, abs=0.1)


def test_errors_of_edges_that_share_readings_are_correlated(drawn):
    """Of a taxel's displacements to others, the errors agree: in information they would not."""
    _, graph, errors = drawn
    i = graph.edges[:, 0]
    a, b = np.nonzero(np.triu(i[:, None] == i, 1))
    alike = [np.corrcoef(errors[k, 0], errors[m, 0])[0, 1] for k, m in zip(a, b, strict=True)]
    assert np.mean(alike) > 0.1


@pytest.mark.deep
@pytest.mark.parametrize(
    ("noise", "threshold", "method"),
    [
        (0.02, 0.0, "posegraph"),
        (0.01, 0.05, "posegraph_isotropic"),
        (0.02, 0.0, "posegraph_isotropic"),
        (0.01, 0.05, "posegraph"),
    ],
)
def test_nees_of_the_pose_graph(world, noise, threshold, method):
    square = []
    for seed in range(6):
        recording, belief = world.record(noise, threshold, seed), world.belief(noise, threshold)
        square.append(nees(calibrate(recording, belief, method=method), world.skin))
    assert 1.3 < np.mean(square) < 2.9  # 2 where the covariance holds
