"""Places of taxels by the readings that were left out as outlying."""

import numpy as np
import pytest

import meshskin as ms
from meshskin.geometry.region import Cap

from ...real_data import DATA, needs_ur3e

CONTACTS = 900


@needs_ur3e
@pytest.mark.parametrize("seed", [5, pytest.param(3, marks=pytest.mark.slow)])
def test_the_few_outlying_readings_beside_fillets_are_no_second_places(seed):
    """A learned response knows patches there less: a few in a hundred readings are outlying, and
    fit half a millimetre off."""
    body = ms.Body.load(DATA / "ur3e_meshes" / "forearm.stl", units="m")
    skin = ms.Skin.cover(body, spacing=5.5e-3, count=50, seed=seed, region=Cap((1.0, 0.0, 0.0)))
    scene = ms.Scene.load("sphere_noisy").with_(
        body=body, skin=skin, material=ms.Material(young=150e3),
        indenter=ms.Indenter.sphere(12e-3), contact="elliptic",
    )  # fmt: skip
    rng = np.random.default_rng(seed)
    near = skin.positions[rng.integers(len(skin), size=CONTACTS)]
    points = body.closest(near + rng.uniform(-5e-3, 5e-3, (CONTACTS, 3))).point
    made = ms.press(scene, points, force=2 * rng.uniform(0.9, 1.1, CONTACTS), seed=seed)
    log = ms.Recording(made.contacts, made.readings, {})
    belief = scene.belief(noise_sigma=None, contact="auto", readings="raw")
    found = ms.calibrate(log, belief)
    assert found.verdict.level == "PASS", found.verdict
    error = np.linalg.norm(found.positions - skin.positions, axis=1)
    assert np.nanmean(error**2) ** 0.5 < 0.03e-3
    assert np.nanmean(found.position_sigma**2) ** 0.5 < 0.1e-3
