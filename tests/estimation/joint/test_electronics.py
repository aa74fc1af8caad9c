"""Hysteresis, creep and crosstalk against loops over every reading, and finite differences."""

from types import SimpleNamespace

import numpy as np
import pytest

from meshskin.estimation.data.global_parameters import declared_parameters
from meshskin.estimation.joint.electronics import Electronics
from meshskin.estimation.joint.known_past import KnownPast
from meshskin.estimation.joint.leaks import Leaks
from meshskin.estimation.joint.readings import Readings

PEAK, SIGMA = 2e5, 2e3


def electronics(contact, taxel, points, time=None, names=("hysteresis", "crosstalk")):
    """Of readings in any order within a taxel; every contact takes 10 ms."""
    order = np.argsort(taxel, kind="stable")
    contact, taxel = np.asarray(contact)[order], np.asarray(taxel)[order]
    k, n = len(contact), len(points)
    starts = np.searchsorted(taxel, np.arange(n + 1))
    zero = np.zeros(k, dtype=int)
    readings = Readings(contact, taxel, np.zeros(k), zero, zero, np.ones(k), np.ones(k), starts)
    data = SimpleNamespace(
        time=0.01 * np.arange(contact.max() + 1) if time is None else time,
        parameters=declared_parameters(names, {}, 3.0, PEAK),
        nominal_peak=PEAK,
        sigma=SIGMA,
        leaks=None,
    )
    return Electronics(data, readings, points)


def every(rng, contacts=60, taxels=7):
    """All readings of some taxels in all contacts, shuffled, and their pressures (m, n)."""
    pressure = np.abs(rng.normal(30.0, 60.0, (contacts, taxels)))
    row, column = rng.permutation(np.indices(pressure.shape).reshape(2, -1), axis=1)
    points = np.column_stack([5e-3 * np.arange(taxels), np.zeros((taxels, 2))])
    return electronics(row, column, points), pressure


def test_the_play_operator_against_a_loop():
    made, pressure = every(np.random.default_rng(0))
    at = made.readings.contact, made.readings.taxel
    width = np.linspace(5.0, 40.0, pressure.shape[1])
    lagging, source, side = made.play(pressure[at], width[at[1]])
    state, expected = np.zeros(pressure.shape[1]), np.zeros_like(pressure)
    for k, now in enumerate(pressure):
        state = np.maximum(np.minimum(state, now + width), now - width)
        expected[k] = state
    np.testing.assert_array_equal(lagging, expected[at])
    moved = side != 0
    np.testing.assert_allclose(
        lagging[moved], (pressure[at][source] + side * width[at[1]])[moved], atol=1e-12
    )


def test_creep_against_the_differential_equation():
    """Of pressures that are held but for 0.2 s, with pauses in which a taxel is not read."""
    rng = np.random.default_rng(1)
    interval = rng.uniform(0.3, 1.2, 40)
    time, tau, lift, step = np.cumsum(interval), 0.7, 0.2, 5e-3
    pressure = rng.uniform(0.0, 100.0, (40, 3)) * (rng.random((40, 3)) < 0.6)
    row, column = np.nonzero(pressure)
    made = electronics(row, column, np.zeros((3, 3)), time, names=("creep",))
    at = made.readings.contact, made.readings.taxel
    state, expected, before = np.zeros(3), np.zeros_like(pressure), time[0]
    for k, now in enumerate(pressure):
        frame = np.median(np.diff(time)) if k == 0 else time[k] - before
        for held, target in ((lift, 0.0), (frame - lift, now)):
            steps = round(held / step)
            for _ in range(steps):
                half = held / steps / (2 * tau)  # the implicit midpoint rule
                state = (state * (1 - half) + 2 * half * target) / (1 + half)
        expected[k], before = state, time[k]
    found = made.creep.follow(pressure[at], np.log(tau), lift / tau)
    np.testing.assert_allclose(found, expected[at], atol=1e-3)


@pytest.mark.parametrize("released", ["a contact apart", "a pause"])
def test_a_taxel_is_released_between_its_contacts(released):
    """It is pressed with 100, and with 10 after a release: the operator has gone back to 20."""
    contact, time = [0, 2], None
    if released == "a pause":
        contact, time = [0, 1], np.array([0.0, 5.0, 5.01, 5.02])
    made = electronics(contact, [0, 0], np.zeros((1, 3)), time)
    lagging, source, side = made.play(np.array([100.0, 10.0]), np.full(2, 20.0))
    np.testing.assert_array_equal(lagging, [80.0, 20.0])
    assert (source[1], side[1]) == (-1, 1.0)


def test_neighbours_are_those_of_the_lattice_in_the_same_contact():
    x, y = np.meshgrid(np.arange(3), np.arange(3), indexing="ij")
    points = 5e-3 * np.column_stack([x.ravel(), y.ravel(), np.zeros(9)])
    contact = np.repeat([0, 1], [9, 4])
    taxel = np.concatenate([np.arange(9), [4, 1, 3, 8]])
    made = electronics(contact, taxel, points)
    sums = made.neighbours @ np.ones(len(contact))
    first = made.readings.contact == 0
    np.testing.assert_array_equal(sums[first], [2, 3, 2, 3, 4, 3, 2, 3, 2])  # of a square lattice
    second = dict(zip(made.readings.taxel[~first].tolist(), sums[~first], strict=True))
    assert second == {4: 2.0, 1: 1.0, 3: 1.0, 8: 0.0}


def test_neighbours_that_crosstalk_are_weighted():
    made = electronics(np.zeros(3, dtype=int), np.arange(3), 5e-3 * np.eye(3)[[0, 0, 0]].cumsum(0))
    made.data.leaks = Leaks(
        np.array([1, 3]), np.array([0.9, 0.9]), np.zeros(2)
    )  # of the first two, both ways
    expected = [[0.0, 0.9, 0.0], [0.9, 0.0, 0.0], [0.0, 0.0, 0.0]]
    np.testing.assert_array_equal(made.neighbours.toarray(), expected)
    made.data.leaks = None
    del made.neighbours
    assert made.neighbours.toarray().sum() == 4


def test_derivatives():
    """Of pressures that depend on one unknown of each taxel, with gains, and on one contact error
    each, which readings that rest on an earlier contact owe to that one, too."""
    rng = np.random.default_rng(3)
    made, pressure = every(rng)
    at = made.readings.contact, made.readings.taxel
    slope, by_contact = rng.normal(size=(2, *pressure.shape))
    s = np.array([0.4, 0.3, 0.0])  # share, ln width, crosstalk
    first, amplified = 2, 0.8

    def apply(x, gain, s, error=0.0):
        """x (n,): of each taxel; gain (n,): its logarithm; error (m, 1): of each contact."""
        scale = np.exp(amplified * gain)[at[1]]
        mu = scale * (pressure + slope * x + by_contact * error)[at]
        jacobian = np.zeros((first + len(s) + 6, len(mu)))
        jacobian[0], jacobian[1] = scale * slope[at], amplified * mu
        jacobian[-6] = scale * by_contact[at]
        return made.apply(mu, jacobian, s, scale, (1, amplified), first), jacobian

    x, gain = np.zeros(pressure.shape[1]), 0.1 * rng.normal(size=pressure.shape[1])
    for crosstalk in (0.0, 0.1):
        s = np.array([0.4, 0.3, crosstalk])
        jacobian = apply(x, gain, s)[1]

        def difference(*steps, s=s):
            up, down = (
                apply(x + sign * steps[0], gain + sign * steps[1], s + sign * steps[2])[0]
                for sign in (1, -1)
            )
            return (up - down) / 2e-6

        for k in range(3):
            expected = difference(0.0, 0.0, 1e-6 * np.eye(3)[k])
            np.testing.assert_allclose(jacobian[first + k], expected, atol=1e-5)
        np.testing.assert_allclose(jacobian[1], difference(0.0, 1e-6, 0.0), atol=1e-5)
        if crosstalk == 0.0:  # else a neighbour's unknowns have a part that is left out
            np.testing.assert_allclose(jacobian[0], difference(1e-6, 0.0, 0.0), atol=1e-5)
            error = rng.normal(size=(len(pressure), 1))
            up, down = (apply(x, gain, s, sign * 1e-6 * error)[0] for sign in (1, -1))
            own, earlier = jacobian[first + 3], jacobian[first + 6]
            e = error[:, 0]
            expected = own * e[at[0]] + earlier * e[at[0][made.source]]
            np.testing.assert_allclose((up - down) / 2e-6, expected, atol=1e-5)
            assert 0.1 < np.mean(made.source != np.arange(len(own))) < 0.9


def test_derivatives_of_creep():
    """In the share, the times, and an unknown of each taxel; those in a contact's error but for
    what earlier contacts leave."""
    rng = np.random.default_rng(4)
    pressure = rng.uniform(10.0, 100.0, (30, 4))
    row, column = np.indices(pressure.shape).reshape(2, -1)
    time = np.cumsum(rng.uniform(0.2, 2.0, 30))
    made = electronics(row, column, np.zeros((4, 3)), time, names=("creep",))
    at = made.readings.contact, made.readings.taxel
    slope, s, one = rng.normal(size=pressure.shape), np.array([0.3, -0.4, 0.2]), np.ones(120)

    def apply(x, s):
        jacobian = np.zeros((8, 120))
        jacobian[0] = jacobian[5] = slope[at]
        return made.apply((pressure + slope * x)[at], jacobian, s, one, (1, 1.0), 2), jacobian

    jacobian = apply(0.0, s)[1]
    for k, (dx, *ds) in enumerate(np.eye(4)):
        up, down = (apply(e * dx, s + e * np.array(ds))[0] for e in (1e-6, -1e-6))
        expected = (up - down) / 2e-6
        np.testing.assert_allclose(jacobian[0 if k == 0 else k + 1], expected, atol=1e-5)
    first = at[0] == 0
    np.testing.assert_allclose(jacobian[5, first], jacobian[0, first])


def test_a_known_past_gives_the_same_readings():
    """The state before each contact, from the readings of the others, also after releases."""
    rng = np.random.default_rng(5)
    made, pressure = every(rng)
    keep = rng.random(pressure.shape) < 0.7
    row, column = np.nonzero(keep)
    made = electronics(row, column, made.points, names=("hysteresis", "creep"))
    made.data.points = np.zeros((*pressure.shape[:1], 3))
    at, m = (made.readings.contact, made.readings.taxel), len(pressure)
    s = np.array([0.4, 0.3, 0.2, -3.0, 0.1])  # hysteresis, creep
    scale = np.linspace(0.8, 1.2, pressure.shape[1])[at[1]]
    jacobian = np.zeros((10, len(scale)))
    jacobian[0] = 1.0
    read = made.apply(pressure[at], jacobian, s, scale, (1, 1.0), 2)
    key = at[1] * m + at[0]
    order = np.argsort(key)
    past = KnownPast(made.data, key[order], made.lagging[order], made.following[order])
    some = rng.permutation(len(scale))[:100]
    history, slopes = past.before(at[0][some], at[1][some]), np.ones((11, 100))
    again = history.apply(pressure[at][some], slopes, s, scale[some], (1, 1.0), 2)
    np.testing.assert_allclose(again, read[some], atol=1e-9)
    moved = made.source[some] == some
    kept = 1 - 0.2 * np.exp(0.1 - 0.01 / np.exp(-3.0))  # of a frame of 10 ms
    assert set(np.round(slopes[0], 9)) == set(np.round([0.6 * kept, kept], 9))
    np.testing.assert_allclose(slopes[0][~moved], 0.6 * kept)
