"""Effects of the transducers: closed forms, limits, signs, independence of the batches."""

from dataclasses import replace

import numpy as np
import pytest

from meshskin.core.errors import ConfigError
from meshskin.effects.broken_taxels import BrokenTaxels
from meshskin.effects.capacitive import Capacitive
from meshskin.effects.crosstalk import Crosstalk
from meshskin.effects.gain_offset import GainOffset
from meshskin.effects.hysteresis import Hysteresis
from meshskin.effects.quantisation import Quantisation
from meshskin.effects.sensing_range import SensingRange
from meshskin.effects.temperature_drift import TemperatureDrift


@pytest.fixture
def pressures(context):
    """Random pressures (30, 80) between 0 and p_0."""
    return context.peak_pressure * np.random.default_rng(1).random((30, 80))


def test_capacitor_follows_the_plate_formula_and_saturates(context, glide):
    effect = Capacitive(largest_strain=0.6, half_relative=3.0)
    p0 = context.peak_pressure
    p = p0 * np.array([[1e-6, 0.3, 1.0, 1e6]])
    got = effect.build(context)(p, glide([0.0]))
    strain = 0.6 * p / (p + 3.0 * p0)
    np.testing.assert_allclose(got, (1 / (1 - strain) - 1) * 3.0 * p0 / 0.6, rtol=1e-9)
    assert got[0, 0] == pytest.approx(p[0, 0], rel=1e-6)
    assert np.all(got < p)
    assert got[0, -1] == pytest.approx(3.0 * p0 / 0.4, rel=1e-4)
    linear = Capacitive(largest_strain=1.0).build(context)(p, glide([0.0]))
    np.testing.assert_array_equal(linear, p)


def test_gains_and_offsets_differ_between_taxels(context, glide, pressures):
    frames = glide(np.zeros(30))
    act = GainOffset(gain_spread=0.1, offset_relative=0.02).build(context)
    low, high = act(0.0 * pressures, frames), act(pressures, frames)
    assert np.all(low == low[0])
    gain = (high - low) / pressures
    np.testing.assert_allclose(gain, np.broadcast_to(gain[0], gain.shape), rtol=1e-9)
    spread = 4 / np.sqrt(2 * 80)
    assert np.log(gain[0]).std() == pytest.approx(0.1, rel=spread)
    assert low[0].std() == pytest.approx(0.02 * context.peak_pressure, rel=spread)
    same = GainOffset(gain_spread=0.0, offset_relative=0.0).build(context)(pressures, frames)
    np.testing.assert_array_equal(same, pressures)


def test_drift_starts_at_zero_and_ends_at_the_warm_skin(context, glide, pressures):
    effect = TemperatureDrift(gain_drift=0.1, offset_relative=0.05, time_constant=20.0)
    act, frames = effect.build(context), glide(np.zeros(30))
    at = replace(frames, time=np.linspace(0.0, 20.0 * np.log(2) * 29 / 10, 30))
    got = act(pressures, at)
    np.testing.assert_array_equal(got[0], pressures[0])
    half = 1.05 * pressures[10] + 0.025 * context.peak_pressure
    np.testing.assert_allclose(got[10], half, rtol=1e-12)
    late = act(pressures, replace(frames, time=1e6 + frames.time))
    np.testing.assert_allclose(late, 1.1 * pressures + 0.05 * context.peak_pressure)
    assert np.all(late > pressures)


def cycle(top, count=2001):
    """0 to `top` and back (2 count - 1, 80), the same for each taxel."""
    path = np.concatenate([np.linspace(0, top, count), np.linspace(top, 0, count)[1:]])
    return np.tile(path[:, None], (1, 80))


def test_area_of_a_hysteresis_cycle(context, glide):
    effect = Hysteresis(share=0.4, width_relative=0.2, plays=3)
    p0, act = context.peak_pressure, effect.build(context)
    act(cycle(p0), glide(np.zeros(4001)))
    p = cycle(p0)
    y = act(p, glide(np.zeros(4001)))
    area = -np.trapezoid(y[:, 7], p[:, 7])
    widths = 0.2 * p0 * np.array([1, 2, 3]) / 3
    assert area == pytest.approx(np.sum(0.4 / 3 * 2 * widths * (p0 - 2 * widths)), rel=1e-4)
    up, down = y[1000, 0], y[3000, 0]
    assert up < p[1000, 0] < down
    assert np.abs(y - p).max() <= 0.4 * effect.mean_width * p0 * (1 + 1e-12)


def test_hysteresis_has_return_point_memory_and_is_rate_independent(context, glide):
    """Madelung's rules: a closed inner loop leaves no trace."""
    p0 = context.peak_pressure

    def ends(*tops):
        path = [np.zeros(1)]
        for top in tops:
            path.append(np.linspace(path[-1][-1], top * p0, 50)[1:])
        p = np.tile(np.concatenate(path)[:, None], (1, 80))
        return Hysteresis().build(context)(p, glide(np.zeros(len(p))))[-1, 0]

    assert ends(0.8, 0.3, 0.6, 0.3, 0.9) == pytest.approx(ends(0.8, 0.9), rel=1e-12)
    assert ends(0.8, 0.3) > ends(0.3)
    act = Hysteresis().build(context)
    jump = act(p0 * np.array([[0.8], [0.3]]) * np.ones(80), glide(np.zeros(2)))
    assert jump[-1, 0] == pytest.approx(ends(0.8, 0.3), rel=1e-12)


def test_hysteresis_forgets_a_touch_that_was_lifted_off(context, glide):
    """Frames without contact are not among those that an effect sees."""
    p0, frames = context.peak_pressure, glide(np.zeros(20), period=context.period)
    p = p0 * np.tile(np.r_[np.linspace(0.1, 1.0, 10), np.linspace(0.05, 0.5, 10)][:, None], 80)
    away = 2.0 * (np.arange(20) >= 10)
    apart = Hysteresis().build(context)(p, replace(frames, time=frames.time + away))
    lifted = np.insert(p, 10, 0.0, axis=0)
    seen = Hysteresis().build(context)(lifted, glide(np.zeros(21), period=context.period))
    np.testing.assert_allclose(apart, np.delete(seen, 10, axis=0), rtol=1e-12)
    assert np.abs(apart - Hysteresis().build(context)(p, frames)).max() > 0.01 * p0


def test_hysteresis_does_not_depend_on_the_batches(context, glide, pressures, split):
    frames = glide(np.zeros(30))
    whole = Hysteresis().build(context)(pressures, frames)
    parts = split(Hysteresis().build(context), frames, pressures)
    np.testing.assert_array_equal(whole, np.vstack(parts))


def test_crosstalk_preserves_sums_and_uniform_pressure(context, glide, pressures):
    frames = glide(np.zeros(30))
    act = Crosstalk(coupling=0.1).build(context)
    np.testing.assert_allclose(act(pressures, frames).sum(axis=1), pressures.sum(axis=1))
    np.testing.assert_allclose(act(np.full((30, 80), 5.0), frames), 5.0)
    one = np.zeros((1, 80))
    one[0, 3] = 1.0
    got = act(one, frames)[0]
    gainers = np.flatnonzero(got * (np.arange(80) != 3))
    distance = np.linalg.norm(context.skin.positions - context.skin.positions[3], axis=1)
    assert set(gainers) == set(np.argsort(distance)[1 : 1 + len(gainers)])
    assert 3 <= len(gainers) <= 7
    assert 0.9 <= got[3] < 1.0
    assert np.all(got[gainers] > 0)


def test_crosstalk_stays_within_modules(context):
    mixing = Crosstalk(module_size=10).mixing(context).toarray()
    module = np.asarray(context.skin.ids) // 10
    assert np.all(mixing[module[:, None] != module] == 0)
    assert np.count_nonzero(mixing) > 80
    np.testing.assert_array_equal(mixing, mixing.T)


def test_sensing_range_clips_both_ends(context, glide):
    p0 = context.peak_pressure
    act = SensingRange(threshold_relative=0.1, saturation_relative=0.7).build(context)
    got = act(p0 * np.array([[0.05, 0.1, 0.4, 0.7, 0.9]]), glide([0.0])) / p0
    np.testing.assert_allclose(got, [[0.0, 0.1, 0.4, 0.7, 0.7]])
    with pytest.raises(ConfigError, match="must exceed threshold_relative"):
        SensingRange(threshold_relative=0.5, saturation_relative=0.4)


@pytest.mark.parametrize("bits", [8, 16])
def test_quantisation_rounds_to_its_levels(bits, context, glide, pressures):
    effect, frames = Quantisation(bits=bits), glide(np.zeros(30))
    act, step = effect.build(context), effect.step(context)
    got = act(pressures, frames)
    assert step == pytest.approx(1.5 * context.peak_pressure / (2**bits - 1))
    error = got - pressures
    assert np.abs(error).max() <= step / 2 * (1 + 1e-9)
    assert error.std() == pytest.approx(step / np.sqrt(12), rel=0.05)
    np.testing.assert_array_equal(act(got, frames), got)
    ends = act(np.array([[-1.0, 1e9]]), frames)
    np.testing.assert_allclose(ends, [[0.0, 1.5 * context.peak_pressure]])


def test_broken_taxels_are_dead_or_stuck_and_others_unchanged(context, glide, pressures):
    effect = BrokenTaxels(dead=0.1, stuck=0.05, level_relative=0.3)
    dead, stuck = effect.chosen(context)
    assert (len(dead), len(stuck)) == (8, 4)
    got = effect.build(context)(pressures, glide(np.zeros(30)))
    assert np.all(got[:, dead] == 0.0)
    assert np.all(got[:, stuck] == 0.3 * context.peak_pressure)
    whole = np.setdiff1d(np.arange(80), [*dead, *stuck])
    np.testing.assert_array_equal(got[:, whole], pressures[:, whole])
    other = effect.chosen(replace(context, seed=4))
    assert set(other[0]) != set(dead)
    assert BrokenTaxels(dead=0.0, stuck=0.0).bound(context) == 0.0
    with pytest.raises(ConfigError, match="limit: at most 1"):
        BrokenTaxels(dead=0.7, stuck=0.7)
