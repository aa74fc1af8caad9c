"""A jump of the contacts: a place in the recording from which on all are displaced."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

import meshskin as ms
from meshskin.estimation.joint.departures import normal_score
from meshskin.estimation.joint.jump import Jump, _usual_score, displacements, largest_jump
from meshskin.geometry.region import Cap


def fitted(count, begin):
    """Readings, one for each of `count` contacts, which those from `begin` on displace by 1 mm
    along x, under a standard deviation of 10 um, and the others by none."""
    return displaced(np.where(np.arange(count) >= begin, 100.0, 0.0))


def displaced(residual):
    """Readings with residuals, one for each contact, of which 100 are 1 mm along x."""
    count = len(residual)
    return SimpleNamespace(
        data=SimpleNamespace(points=np.zeros((count, 3)), reach=lambda: np.ones(count)),
        rate=-residual,
        curvature=np.ones(count),
        readings=SimpleNamespace(contact=np.arange(count)),
        moved=lambda directions: 1e5 * directions[:, 0],
        unexplained=lambda columns: (columns, columns),
        shared=lambda columns: (columns.T @ residual, columns.T @ columns),
    )


def test_a_displacement_of_part_of_the_contacts_is_found_where_it_begins():
    found = largest_jump(fitted(160, 80))
    assert found.part == 0.5
    np.testing.assert_allclose(found.shown, [1e-3, *np.zeros(5)], atol=1e-12)


def test_a_displacement_of_all_contacts_is_no_jump():
    """Of fewer contacts than places the first place was the first contact."""
    assert largest_jump(fitted(1, 0)).score == 0.0
    assert largest_jump(fitted(8, 0)).part > 0


def test_the_score_of_several_directions_is_that_of_one_as_improbable():
    """Beside the normal quantile of the chi-square distribution's tail."""
    assert normal_score(9.0, 1) == 3.0
    for square, count, off in ((4.0, 3, 0.01), (10.0, 3, 0.01), (20.0, 2, 0.04), (36.0, 3, 0.05)):
        exact = stats.norm.isf(stats.chi2.sf(square, count))
        assert abs(normal_score(square, count) - exact) < off * exact


def test_a_jump_between_two_places_is_found_where_it_begins():
    """15 places are 10 of 160 contacts apart; then four between the best one and its neighbours."""
    for begin in (85, 87, 93):
        assert largest_jump(fitted(160, begin)).part * 160 == pytest.approx(begin, abs=2)


def test_a_displacement_that_grows_is_a_drift():
    found = largest_jump(displaced(100.0 * np.arange(160) / 160))
    assert np.isnan(found.part)
    np.testing.assert_allclose(found.motion, [1e-3, *np.zeros(5)], atol=1e-12)
    assert "a drift of the contacts by 1 mm" in next(iter(found.departure))
    assert not np.isnan(largest_jump(displaced(100.0 * np.arange(160) / 160), drift=False).part)


def test_a_body_that_is_turned_is_a_jump():
    """By 0.01 rad about an axis through (0, 0.05, 0) m, from half of the contacts on."""
    rng, late, axis = np.random.default_rng(0), np.arange(160) >= 80, np.array([0.0, 0.0, 0.01])
    points = rng.uniform(-0.1, 0.1, (160, 3))
    along = rng.normal(size=(160, 3))
    turned = np.cross(axis, points - [0.0, 0.05, 0.0])
    residual = 1e5 * late * np.einsum("mi,mi->m", along, turned)
    made = displaced(residual)
    made.data.points = points
    made.moved = lambda directions: 1e5 * np.einsum("mi,miq->mq", along, directions)
    found = largest_jump(made)
    assert found.part == 0.5
    np.testing.assert_allclose(displacements(found.shown, points), turned, atol=1e-9)


def test_scores_at_other_places_tell_what_is_usual():
    """A jump that only the contacts next to it show has one group of them to tell its deviation."""
    found = [Jump(score=k * 1.0, part=0.05 * k) for k in range(1, 19)]
    jump = Jump(score=20.0, part=0.51)
    usual = np.sqrt(np.mean([k**2 for k in range(1, 19) if not 9 <= k <= 12]))
    assert _usual_score(jump, [*found, jump]) == pytest.approx(usual)
    assert _usual_score(jump, [Jump(score=0.1, part=0.05 * k) for k in range(19)]) == 1.0
    assert _usual_score(Jump(score=20.0, part=np.nan), found) == np.inf
    assert _usual_score(jump, found[8:14]) == np.inf


def lanes(scene, seed):
    """A log in back-and-forth lanes 2.5 mm apart, and the lanes' direction."""
    rng, skin = np.random.default_rng(seed), scene.skin
    near = skin.positions[rng.integers(len(skin), size=600)]
    points = scene.body.closest(near + rng.uniform(-5e-3, 5e-3, (600, 3))).point
    middle = skin.positions.mean(axis=0)
    axes = np.linalg.svd(skin.positions - middle)[2]
    along, across = ((points - middle) @ axes[:2].T).T
    lane = np.floor(across / 2.5e-3).astype(int)
    order = np.lexsort((along * np.where(lane % 2, 1, -1), lane))
    made = ms.press(scene, points[order], force=rng.uniform(2.5, 3.5, 600), seed=seed)
    return replace(made, metadata={}), axes[0]


def on_a_capsule():
    """A scene of 60 taxels on a capsule."""
    base, body = ms.Scene.load("sphere_noisy"), ms.Body.capsule(radius=0.04, length=0.15)
    region = Cap(direction=(1.0, 0.3, 0.2))
    skin = ms.Skin.cover(body, spacing=6e-3, count=60, seed=2, region=region, disc_radius=2e-3)
    return base.with_(
        body=body, skin=skin, contact="elliptic", material=ms.Material(young=0.4e6),
        indenter=ms.Indenter.sphere(0.008),
    )  # fmt: skip


@pytest.mark.deep
def test_contacts_that_drift_by_1_mm_on_the_surface():
    """Each taxel is touched within a short time and moves with its contacts, which lie on the
    surface: neither residuals nor distances show it, the response misfits by 1 %."""
    scene = on_a_capsule()
    log, along = lanes(scene, 1)
    moved = log.points + 1e-3 * np.arange(600)[:, None] / 600 * along
    log = log.with_columns(points=scene.body.closest(moved).point)
    found = ms.calibrate(log, scene.belief(noise_sigma=None))
    assert found.verdict is not None
    assert found.verdict.level == "DOUBT"
    assert any("a drift of the contacts by " in words for words in found.verdict.reasons)
    error = np.linalg.norm(found.positions - scene.skin.positions, axis=1)
    assert np.isfinite(error).sum() == 60
    stated = np.mean(found.position_sigma**2) / np.mean(error**2)
    assert 0.8 < stated**0.5 < 1.6


@pytest.mark.deep
def test_contacts_that_are_displaced_for_some_time_only():
    """By 2 mm along the surface from 33 % to 63 %, and back: taxels that were touched in both parts
    fit one, and taxels that were touched then have no outlying reading and are 2 mm off."""
    scene = on_a_capsule()
    (log, along), k = lanes(scene, 2), np.arange(600)
    moved = log.points + np.outer((k >= 200) & (k < 380), 2e-3 * along)
    log = log.with_columns(points=scene.body.closest(moved).point)
    found = ms.calibrate(log, scene.belief(contact="elliptic", noise_sigma=None))
    assert found.verdict is not None
    assert found.verdict.level == "DOUBT"
    (words,) = [words for words in found.verdict.reasons if "a second place of" in words]
    assert "2 mm away" in words
    error = np.linalg.norm(found.positions - scene.skin.positions, axis=1)
    good = np.isfinite(error)
    assert good.sum() > 50
    assert not np.any(good & (error > 0.3e-3) & (error > 5 * found.position_sigma))
    stated = np.mean(found.position_sigma[good] ** 2) / np.mean(error[good] ** 2)
    assert 1.0 < stated**0.5 < 2.5


@pytest.mark.deep
@pytest.mark.parametrize("contact", ["auto", "elliptic"])
def test_a_jump_that_outlying_readings_hide_is_named_and_counted(contact):
    """Contacts of the later half 1 mm along a capsule: the few taxels that are touched before and
    after it fit one half, and the readings of the other half are left out as outlying."""
    scene = on_a_capsule()
    skin = scene.skin
    log, along = lanes(scene, 1)
    log = log.with_columns(points=log.points + np.outer(np.arange(600) >= 300, 1e-3 * along))
    belief = scene.belief(contact=contact, noise_sigma=None)
    found = ms.calibrate(log, belief)
    assert found.verdict is not None
    assert found.verdict.level == "DOUBT"
    words = "".join(found.verdict.reasons).split("a jump of the contacts at ")[1]
    assert abs(int(words.split("%")[0]) - 50) <= 3
    error = np.linalg.norm(found.positions - skin.positions, axis=1)
    good = np.isfinite(error)
    stated = np.mean(found.position_sigma[good] ** 2) / np.mean(error[good] ** 2)
    assert good.sum() > 55
    assert 1.0 < stated**0.5 < 2.0


@pytest.mark.deep
@pytest.mark.parametrize("readings", ["pressure", "raw"])
def test_a_body_that_was_turned_by_2_degrees_is_named_and_counted(readings):
    """Halfway through a log in lanes, its contacts projected on the believed surface: few taxels
    are touched before and after it, 0.2 mm off, and lose no reading as outlying."""
    scene = on_a_capsule()
    log, along = lanes(scene, 3)
    middle = log.points.mean(axis=0)
    turn = Rotation.from_rotvec(np.radians(2) * np.cross(log.normals.mean(axis=0), along))
    moved = np.where(np.arange(600)[:, None] >= 300, turn.apply(log.points - middle) + middle,
                     log.points)  # fmt: skip
    hit = scene.body.closest(moved)
    turned = log.with_columns(points=hit.point, normals=hit.normal)
    belief = scene.belief(noise_sigma=None, readings=readings)
    for each, level, most in ((log, "PASS", 1.25), (turned, "DOUBT", 2.0)):
        found = ms.calibrate(each, belief)
        assert found.verdict is not None
        assert found.verdict.level == level
        error = np.linalg.norm(found.positions - scene.skin.positions, axis=1)
        stated = np.mean(found.position_sigma**2) / np.mean(error**2)
        assert 0.8 < stated**0.5 < most
    assert any("a jump of the contacts at" in words for words in found.verdict.reasons)


@pytest.mark.parametrize(
    ("score", "size", "turned"), [(2.0, 1e-3, False), (9.0, 1e-3, True), (9.0, 1e-4, False)]
)
def test_the_larger_of_a_jump_that_is_shown_and_another_displacement_counts(score, size, turned):
    """A jump below its limit, however large, does not stand in for the displacement."""
    motion, other = np.array([size, 0, 0, 0, 0, 0.01]), np.array([0, 2e-4, 0])
    found = Jump(score, 0.5, motion, size).or_displacement(other)
    np.testing.assert_array_equal(found, motion if turned else np.append(other, np.zeros(3)))
