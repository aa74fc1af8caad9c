"""Two skins that touch each other: derivatives, known truths, what is not determined, real ones."""

from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.errors import CalibrationError
from meshskin.core.se3 import exp_so3
from meshskin.estimation.self_touch.side import SideState, contacts, positions
from meshskin.robot.chain import Chain

ROWS = [(0, 0.1, -np.pi / 2, 0), (0.02, 0.1, np.pi / 2, 0.3), (0.015, 0.1, -np.pi / 2, 0)]
NOISE = 1e-3
TOUCHES = 400


def patch_of(rows: int, columns: int, bend: float) -> np.ndarray:
    """Taxels (n, 3), m, 8 mm apart, on a cylinder of curvature `bend`, 1/m."""
    x, y = 8e-3 * np.mgrid[:rows, :columns].reshape(2, -1).astype(float)
    x, y = x - x.mean(), y - y.mean()
    return np.column_stack([x, y, -0.5 * bend * y**2])


@pytest.fixture(scope="module")
def world():
    """Touches of a skin on the base by one on an arm of three joints, by positions alone.

    The arm is moved such that a random taxel of each skin meets: the base's skin has its contact
    where that of the arm is, scattered by NOISE.
    """
    rng = np.random.default_rng(0)
    chain = Chain.from_dh(ROWS)
    nominal = patch_of(6, 6, 10.0)
    true = SideState(
        (np.array([5e-3, -4e-3, 3e-3]), exp_so3(np.array([0.1, -0.05, 0.08]))),
        (np.zeros((1, 3)), np.eye(3)[None]),
        np.zeros(3),
        np.zeros_like(nominal),
    )
    angles = rng.uniform(-0.6, 0.6, (TOUCHES, 3))
    readings = np.zeros((TOUCHES, 36))
    centre = rng.integers(36, size=TOUCHES)
    off = np.linalg.norm(nominal[centre][:, None] - nominal, axis=2)
    readings[off < 9e-3] = 1.0
    arm = ms.TouchSide(chain=chain, angles=angles, positions=nominal, readings=readings)
    met = contacts(arm, true)[0] + rng.normal(0, NOISE, (TOUCHES, 3))
    base = ms.TouchSide(
        chain=None,
        angles=np.zeros((TOUCHES, 0)),
        positions=met,  # a taxel for each touch
        readings=np.eye(TOUCHES),
        mount_sigma=0.0,
        mount_turn_sigma=0.0,
    )
    return arm, base, true


def test_the_derivatives_are_those_of_differences(world):
    arm, _, true = world
    rng = np.random.default_rng(1)
    side = replace(arm.of(np.arange(5)), patch=np.arange(36) % 2, taxel_sigma=1e-3, joint_sigma=0.1)
    count = len(side.prior_sigmas)
    assert len(side.labels) == count == 6 + 12 + 3 + 108
    state = SideState.nominal(side).moved(rng.normal(0, 0.02, count))
    state = replace(state, mount=true.mount)
    _, slope = contacts(side, state)
    for k in range(count):
        step = 1e-6 * (np.arange(count) == k)
        ahead, behind = (contacts(side, state.moved(s * step))[0] for s in (1, -1))
        np.testing.assert_allclose(
            slope[:, :, k], (ahead - behind) / 2e-6, atol=1e-8, err_msg=side.labels[k]
        )


def test_the_contact_is_the_mean_of_active_taxels(world):
    arm, _, true = world
    pose = arm.chain.poses(arm.angles)
    mean = np.mean(positions(arm, true)[arm.readings[7] > 0], axis=0)
    expected = pose[7, :3, :3] @ mean + pose[7, :3, 3]
    np.testing.assert_allclose(contacts(arm, true)[0][7], expected, atol=1e-12)


def test_a_mount_is_found_within_its_stated_sigma(world):
    arm, base, true = world
    heard = []
    found = ms.self_touch(arm, base, progress=lambda *at: heard.append(at))
    assert heard[0] == ("self-touch", 0, 10)
    assert heard[-1][1] == heard[-1][2] > 2
    error = found.states[0].mount[0] - true.mount[0]
    assert np.all(np.abs(error) < 4 * found.sigmas[0][:3])
    assert found.sigmas[0][:3].max() < 0.5e-3
    assert found.scatter == pytest.approx(NOISE, rel=0.1)
    assert found.undetermined == ()
    assert found.contradicted == ()
    turn = found.states[0].mount[1] @ true.mount[1].T
    sigma = np.linalg.norm(found.sigmas[0][3:6])
    assert np.arccos((np.trace(turn) - 1) / 2) < 3 * sigma < 0.03
    assert "first skin, mount: 50 mm" in found.factors


def test_stated_sigmas_hold_over_many_recordings(world):
    """Normalized squares of the mount's error are chi-square with 3 degrees of freedom."""
    arm, base, true = world
    exact = contacts(arm, true)[0]
    square = []
    for seed in range(30):
        noise = np.random.default_rng(100 + seed).normal(0, NOISE, (60, 3))
        rows = np.arange(60)
        noisy = replace(base.of(rows), positions=np.concatenate([exact[:60] + noise, exact[60:]]))
        found = ms.self_touch(arm.of(rows), noisy)
        error = found.states[0].mount[0] - true.mount[0]
        square.append(np.sum((error / found.sigmas[0][:3]) ** 2))
    assert 2.0 < np.mean(square) < 4.5


def test_taxels_and_joints_are_found_where_they_are_touched(world):
    arm, base, true = world
    rng = np.random.default_rng(2)
    moved = rng.normal(0, 2e-3, (36, 3))
    offset = np.array([0.02, -0.015, 0.01])
    state = replace(true, taxels=moved, joints=offset)
    met = contacts(arm, state)[0] + rng.normal(0, 2e-4, (TOUCHES, 3))
    free = replace(arm, taxel_sigma=2e-3, joint_sigma=0.05)
    found = ms.self_touch(free, replace(base, positions=met))
    error = np.linalg.norm(found.positions[0] - positions(arm, state), axis=1)
    nominal = np.linalg.norm(positions(arm, true) - positions(arm, state), axis=1)
    assert np.sqrt(np.mean(error**2)) < 0.5 * np.sqrt(np.mean(nominal**2))
    train = found.distances(free, replace(base, positions=met))
    assert np.sqrt(np.mean(train**2)) < 0.5e-3


def test_overfit_shows_in_touches_that_were_not_used(world):
    arm, base, _ = world
    few, rest = np.arange(20), np.arange(20, TOUCHES)
    free = replace(arm, taxel_sigma=5e-3)
    found = ms.self_touch(free.of(few), base.of(few))
    used = np.sqrt(np.mean(found.distances(free.of(few), base.of(few)) ** 2))
    held = np.sqrt(np.mean(found.distances(free.of(rest), base.of(rest)) ** 2))
    assert held > 1.2 * used


def test_what_the_touches_do_not_tell_is_named(world):
    """Arm held still: a base skin that moves with the arm's mount changes nothing."""
    arm, base, _ = world
    still = replace(arm, angles=np.zeros_like(arm.angles))
    met = contacts(still, SideState.nominal(still))[0]
    free = replace(base, positions=met, mount_sigma=0.05, mount_turn_sigma=0.5)
    found = ms.self_touch(still, free)
    assert found.undetermined
    assert all("mount" in name for name in found.undetermined)
    joints = replace(still, joint_sigma=0.05)
    assert any("joint" in n for n in ms.self_touch(joints, base).undetermined)


def test_priors_that_the_touches_contradict_are_named(world):
    arm, base, _ = world
    found = ms.self_touch(replace(arm, mount_sigma=1e-3), base)
    assert any("mount: displacement along x" in name for name in found.contradicted)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"readings": np.zeros((TOUCHES, 36))}, "a taxel must read above 0"),
        ({"readings": np.ones((TOUCHES, 35))}, "shape of readings"),
        ({"angles": np.zeros((TOUCHES, 2))}, "shape of angles"),
        ({"positions": np.full((36, 3), np.nan)}, "finite table"),
        ({"patch": np.full(36, 2)}, "without gaps"),
    ],
)
def test_bad_sides(world, change, message):
    with pytest.raises(CalibrationError, match=message):
        replace(world[0], **change)


def test_bad_pairs(world):
    arm, base, _ = world
    with pytest.raises(CalibrationError, match="different numbers of touches"):
        ms.self_touch(arm, base.of(np.arange(10)))
    known = replace(arm, mount_sigma=0.0, mount_turn_sigma=0.0)
    with pytest.raises(CalibrationError, match="nothing is unknown"):
        ms.self_touch(known, base)


def test_a_start_from_the_result_has_the_same_uncertainty(world):
    """The scatter starts ten times too large, and the places do not move."""
    arm, base, _ = world
    first = ms.self_touch(arm, base)
    again = ms.self_touch(replace(arm, positions=first.positions[0]), base)
    assert again.scatter == pytest.approx(first.scatter, rel=0.01)
    # the mount turns the taxels about another arm
    np.testing.assert_allclose(again.sigmas[0], first.sigmas[0], rtol=0.15)


@pytest.mark.parametrize(
    ("name", "factor", "words"),
    [
        ("angles", 180 / np.pi, "angles .* too large, got .* rad.* if they are in degrees"),
        ("positions", 1e3, "positions .* too large, got .* m, limit: 3 m.* if they are in mm"),
    ],
)
def test_other_units_are_refused(world, name, factor, words):
    with pytest.raises(CalibrationError, match=words):
        replace(world[0], **{name: factor * getattr(world[0], name)})


def test_sides_and_results_are_shown_in_one_line(world):
    arm, base, _ = world
    assert repr(arm) == "<TouchSide: 36 taxels in 400 touches, moved by 3 joints>"
    found = ms.self_touch(replace(arm, joint_sigma=0.02), base)
    assert found.undetermined
    assert "36 and 400 taxels, 1" in repr(found)
    assert f"{len(found.undetermined)} directions undetermined, 0 priors" in repr(found)
    single = [words for words in found.undetermined if ", " not in words]
    assert all(words.startswith(("first: ", "second: ")) for words in single)
