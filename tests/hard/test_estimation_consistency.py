"""The covariances hold over many seeds: positions and shared unknowns, in four scenes."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from meshskin import se3
from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.metrics import cramer_rao, nees, nees_band, position_errors
from meshskin.recording import CONTACTS, READINGS, Recording

SPEC = importlib.util.spec_from_file_location(
    "small_world", Path(__file__).parents[1] / "estimation" / "conftest.py"
)
small = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(small)
SEEDS = 200


@pytest.fixture(scope="module")
def world():
    return small.World(extent=12e-3)


def band(count, confidence):
    """Where the mean of `count` squared normalised errors lies."""
    tail = (1 - confidence) / 2
    return chi2.ppf(tail, count) / count, chi2.ppf(1 - tail, count) / count


def record(world, gain, seed, points=None):
    import pyarrow as pa

    rng = np.random.default_rng(1000 + seed)
    p = gain * world.pressures()
    p += 0.01 * world.peak_reference * rng.normal(size=p.shape)
    contact, taxel = np.nonzero(p > 0.05 * world.peak_reference)
    time = 0.01 * np.arange(len(world.points))
    where = world.points if points is None else points
    columns = [time, *where.T, *world.normals.T, world.force]
    readings = [time[contact], world.ids[taxel].astype(np.int32), p[contact, taxel]]
    return Recording(pa.table(columns, schema=CONTACTS), pa.table(readings, schema=READINGS), {})


SCENES = {
    "ideal": {"unknown": ()},
    "modulus": {"unknown": ("modulus",), "young": 0.8 * small.YOUNG},
    "gains": {"unknown": ("modulus", "gain")},
    "indenter": {"unknown": ("modulus", "indenter_offset")},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_nees_in_its_band_and_error_at_the_bound(world, name):
    n, options = len(world.truth), dict(SCENES[name])
    offset = np.array([3e-4, -2e-4, 1e-4])
    turn = np.random.default_rng(3).uniform(-3, 3, len(world.points))
    headings = se3.exp_so3(turn[:, None] * [0, 0, 1.0])
    believed = None
    truth = {"modulus": np.log(small.YOUNG / options.get("young", small.YOUNG))}
    if name == "indenter":
        height = small.INDENTER - world.a**2 * (1 / small.RADIUS + 1 / small.INDENTER)
        centre = world.points + height[:, None] * world.normals
        shift = np.einsum("mji,j->mi", headings, offset)
        believed = world.body.closest(centre - shift).point
        truth |= dict(zip((f"indenter_offset {x}" for x in "xyz"), offset, strict=True))
        options["headings"] = headings
    belief = world.belief(0.01, 0.05, **options)
    normalised, squared, bounds, p = [], [], [], []
    shared = {label: [] for label in truth if belief.unknown}
    gains = []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        log_gain = 0.05 * rng.normal(size=n) if name == "gains" else np.zeros(n)
        recording = record(world, np.exp(log_gain), seed, believed)
        found = calibrate(recording, belief)
        normalised.append(nees(found, world.skin).mean())
        squared.append(np.mean(position_errors(found, world.skin) ** 2))
        bounds.append(cramer_rao(recording, belief, world.skin).rms ** 2)
        p.append(found.fit.p)
        for label, errors in shared.items():
            value, sigma = found.unknowns[label]
            errors.append((value - truth[label]) / sigma)
        if name == "gains":
            value, sigma = found.taxel_unknowns["gain"].T
            gains.append(np.mean(((value - log_gain) / sigma) ** 2))
    low, high = nees_band(SEEDS * n)
    assert low < np.mean(normalised) < high
    assert np.sqrt(np.mean(squared) / np.mean(bounds)) < 1.05
    assert np.mean(np.array(p) < 1e-3) <= 0.01
    for label, errors in shared.items():
        low, high = band(SEEDS, 0.99)
        assert low < np.mean(np.square(errors)) < high, label
    if gains:
        assert np.mean(gains) == pytest.approx(1.0, abs=0.1)
