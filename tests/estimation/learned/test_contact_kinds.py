"""Contacts of two kinds, in any order, one of them displaced."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import meshskin as ms
from meshskin.estimation.learned import contact_kinds
from meshskin.geometry.region import Cap


def scattered(seed):
    """A scene with 40 taxels on a capsule, and a log of 500 contacts in random order."""
    base, body = ms.Scene.load("sphere_noisy"), ms.Body.capsule(radius=0.04, length=0.15)
    region = Cap(direction=(1.0, 0.3, 0.2))
    skin = ms.Skin.cover(body, spacing=6e-3, count=40, seed=2, region=region, disc_radius=2e-3)
    scene = base.with_(
        body=body, skin=skin, contact="elliptic", material=ms.Material(young=0.4e6),
        indenter=ms.Indenter.sphere(0.008),
    )  # fmt: skip
    rng = np.random.default_rng(seed)
    near = skin.positions[rng.integers(len(skin), size=500)]
    points = body.closest(near + rng.uniform(-5e-3, 5e-3, (500, 3))).point
    return scene, ms.press(scene, points, force=rng.uniform(2.5, 3.5, 500), seed=seed)


def test_directions_that_no_reading_shows_have_no_kinds(monkeypatch):
    """Each contact is known along one direction of its plane; in the other it has an error that
    rounding gave it, and no information."""
    rng, count = np.random.default_rng(0), 200
    known = np.linalg.qr(rng.normal(size=(count, 2, 2)))[0]
    whole = np.zeros((count, 3, 3))
    whole[:, :2, :2] = known @ np.diag([1e9, -1e-3]) @ np.swapaxes(known, 1, 2) + 1e6 * np.eye(2)
    whole[:, 2, 2] = 1.0
    errors = rng.normal(scale=1e-4, size=(count, 2))
    tangents = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0][:, :2, :]
    monkeypatch.setattr(contact_kinds, "tangents", lambda effects: tangents)
    shown = contact_kinds._Displacements(
        SimpleNamespace(
            probes=SimpleNamespace(touched=np.ones(count)),
            system=lambda: SimpleNamespace(contacts=whole),
            prior=(None, np.array([1e6, 1e6, 1.0])),
            unknowns=SimpleNamespace(errors=errors),
        )
    )
    along = np.einsum("mi,mi->m", shown.linear, known[:, :, 1])
    np.testing.assert_allclose(along, 0, atol=1e-6)
    across = np.einsum("mi,mi->m", errors, known[:, :, 0])
    np.testing.assert_allclose(
        np.einsum("mi,mi->m", shown.linear, known[:, :, 0]), (1e9 + 1e6) * across, rtol=1e-6
    )


def displaced(log, by):
    """The log with its contacts displaced by (m, 3), m."""
    return replace(log.with_columns(points=log.points + by), metadata={})


@pytest.mark.deep
@pytest.mark.parametrize(
    ("share", "size"),
    [(0.25, 1e-3), *(pytest.param(0.5, size, marks=pytest.mark.slow) for size in (1e-3, 2e-3))],
)
def test_contacts_that_are_displaced_alike_are_named_and_counted(share, size):
    """Displacements of 2 mm, two thirds of a contact radius, are found 1.4 to 1.6 mm large."""
    scene, log = scattered(0)
    moved = np.random.default_rng(1).random(len(log.points)) < share
    wrong = displaced(log, np.outer(moved, [0.0, 0.0, size]))
    found = ms.calibrate(wrong, scene.belief(contact="auto", noise_sigma=None))
    assert found.verdict is not None
    assert found.verdict.level == "DOUBT"
    (words,) = [words for words in found.verdict.reasons if "displaced against" in words]
    said = float(words.split("%")[0].split()[-1]) / 100
    assert said == pytest.approx(min(share, 1 - share), abs=0.05)
    error = np.linalg.norm(found.positions - scene.skin.positions, axis=1)
    least = 0.7 if size < 2e-3 else 0.5
    assert least < np.sqrt(np.mean(found.position_sigma**2) / np.mean(error**2)) < 2.0


@pytest.mark.parametrize(
    "kind", ["laplace", *(pytest.param(k, marks=pytest.mark.slow) for k in ("normal", "uniform"))]
)
def test_scatter_is_of_one_kind(kind):
    """Of 0.3 mm along one direction, whatever its distribution."""
    scene, log = scattered(0)
    rng = np.random.default_rng(2)
    size = (
        0.3e-3
        * {
            "normal": rng.normal(size=500),
            "uniform": 3**0.5 * rng.uniform(-1, 1, 500),
            "laplace": rng.laplace(size=500) / 2**0.5,
        }[kind]
    )
    wrong = displaced(log, np.outer(size, [0.0, 0.0, 1.0]))
    found = ms.calibrate(wrong, scene.belief(contact="auto", noise_sigma=None))
    assert found.verdict is not None
    assert not any("displaced against" in words for words in found.verdict.reasons)


@pytest.mark.deep
@pytest.mark.parametrize("seed", [1, 3])
def test_a_jump_that_errors_of_contacts_stand_in_for(seed):
    """Pressed in lanes, most taxels are touched on one side of it only."""
    scene, log = scattered(seed)
    lane = np.floor(log.points[:, 1] / 2e-3)
    order = np.lexsort((log.points[:, 2] * np.where(lane % 2, 1, -1), lane))
    log = ms.press(scene, log.points[order], force=log.force[order], seed=seed)
    late = np.arange(len(log.points)) >= len(log.points) // 2
    wrong = displaced(log, np.outer(late, [0.0, 0.0, 2e-3]))
    found = ms.calibrate(wrong, scene.belief(contact="learned", noise_sigma=None))
    assert found.verdict is not None
    assert any("a jump of the contacts at" in words for words in found.verdict.reasons)
    error = np.linalg.norm(found.positions - scene.skin.positions, axis=1)
    ratio = np.nanmean(found.position_sigma[np.isfinite(error)] ** 2) / np.nanmean(error**2)
    assert 1.0 < np.sqrt(ratio) < 2.0
