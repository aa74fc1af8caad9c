"""Comparison of skins: alignment, distances, exchanged and renumbered modules and taxels."""

import warnings

import numpy as np
import pytest

from meshskin.cli import main
from meshskin.core import se3
from meshskin.core.errors import ConfigError, SkinError
from meshskin.geometry.body import Body
from meshskin.geometry.region import Cap
from meshskin.skin import slots
from meshskin.skin.compare import compare, module_centres, rms, words
from meshskin.skin.skin import Skin

from ..real_data import DATA, needs_skin

MOTION = se3.transform(se3.exp_so3([0.3, -0.5, 1.0]), [0.1, 0.2, -0.05])


@pytest.fixture(scope="module")
def arm():
    """Twenty modules on a capsule."""
    return Skin.modules(Body.capsule(0.05, 0.2), count=20).skin


@pytest.fixture(scope="module")
def plain():
    return Skin.cover(Body.sphere(), spacing=5e-3, count=80, region=Cap((0, 0, -1)))


def moved(skin, noise=0.0, motion=MOTION):
    """The skin in another frame, its taxels displaced at random (m)."""
    poses = se3.inverse(motion) @ skin.poses
    poses[:, :3, 3] += noise * np.random.default_rng(0).normal(size=(len(skin), 3))
    return Skin(poses, skin.ids)


def renamed(skin, change, size=12):
    """The skin with the numbers of its units changed: {old: new}."""
    units = [change.get(unit, unit) for unit in (skin.ids // size).tolist()]
    return Skin(skin.poses, size * np.array(units) + skin.ids % size)


def test_a_skin_equals_itself(arm):
    d = compare(arm, arm)
    assert d.unaligned.max() == 0.0
    assert d.aligned.max() < 1e-15
    assert d.permutation == {}
    assert len(d.only_a) == len(d.only_b) == 0


def test_a_rigid_motion_is_found(arm):
    d = compare(arm, moved(arm))
    np.testing.assert_allclose(d.alignment, MOTION, atol=1e-12)
    assert d.unaligned.min() > 0.01
    assert d.aligned.max() < 1e-12
    assert d.sentences() == ()


def test_noise_remains_and_the_worst_taxel_is_listed(plain):
    poses = moved(plain, 1e-4).poses
    poses[17, :3, 3] += 2e-3
    d = compare(plain, Skin(poses, plain.ids))
    assert rms(np.delete(d.aligned, 17)) == pytest.approx(1e-4 * np.sqrt(3), rel=0.15)
    with pytest.raises(ConfigError, match="count of the worst taxels is out of range, got -1"):
        d.worst(-1)
    taxel, off = d.worst(3)[0]
    assert taxel == 17
    assert off == pytest.approx(2e-3 * np.sqrt(3), rel=0.1)
    assert d.permutation == {}


@pytest.mark.parametrize("noise", [0.0, 3e-4])
def test_exchanged_modules_are_named(arm, noise):
    d = compare(arm, renamed(moved(arm, noise), {3: 7, 7: 3}))
    assert d.unit == "module"
    assert d.permutation == {3: 7, 7: 3}
    assert d.sentences() == ("modules 3 and 7 exchanged",)
    assert d.permutation
    assert rms(d.paired) < 1.2 * np.sqrt(3) * noise + 1e-12
    assert rms(d.aligned) > 10e-3
    assert len(d.paired) == 200


def test_a_cycle_of_modules_is_named(arm):
    d = compare(arm, renamed(moved(arm, 1e-4), {2: 5, 5: 11, 11: 2}))
    assert d.sentences() == ("modules permuted: 2 -> 5 -> 11 -> 2 (A -> B)",)


def test_all_modules_permuted_and_moved(arm):
    order = np.random.default_rng(1).permutation(20)
    change = dict(enumerate(order.tolist()))
    d = compare(arm, renamed(moved(arm, 1e-4), change))
    assert d.permutation == {a: b for a, b in change.items() if a != b}
    assert d.permutation
    np.testing.assert_allclose(d.alignment, MOTION, atol=1e-3)


def test_renamed_modules_are_named(arm):
    d = compare(arm, renamed(arm, {4: 40}))
    assert d.sentences() == ("module 4 of A is module 40 of B",)
    assert d.permutation
    assert set(d.only_a // 12) == {4}
    assert set(d.only_b // 12) == {40}
    d = compare(arm, renamed(arm, {k: k + 1 for k in range(20)}))
    assert d.sentences() == ("module numbers of B are those of A plus 1",)
    assert d.permutation


def test_a_renumbered_chain_is_one_sentence():
    assert words({1: 2, 2: 3, 3: 7, 4: 5, 5: 4, 6: 9}, "module") == (
        "modules renumbered: 1 -> 2 -> 3 -> 7 (A -> B)",
        "module 6 of A is module 9 of B",
        "modules 4 and 5 exchanged",
    )


def test_taxels_that_moved_with_their_modules_are_described_by_modules():
    """Modules 4 and 6 exchanged with their slots 0 and 5, module 8 rotated in its place."""
    swap = {0: 5, 5: 0}
    where = {4: 6, 6: 4, 8: 8, 9: 11, 11: 9}
    permutation = {
        12 * m + s: 12 * there + swap.get(s, s) * (m != 9) + s * (m == 9)
        for m, there in where.items()
        for s in slots.TAXELS
    }
    permutation = {a: b for a, b in permutation.items() if a != b}
    assert words(permutation, "taxel") == (
        "modules 4 and 6 exchanged",
        "modules 9 and 11 exchanged",
        "slots 0 1 2 3 4 5 7 8 9 11 are slots 5 1 2 3 4 0 7 8 9 11 of B "
        "in modules 4, 6, 8, 11 of A",
    )
    permutation[12 * 4] = 1000  # a taxel that went elsewhere
    assert all(line.startswith("taxel") for line in words(permutation, "taxel"))


def test_exchanged_taxels_of_a_skin_without_modules(plain):
    d = compare(plain, renamed(moved(plain, 1e-4), {5: 77, 77: 5}, size=1))
    assert d.unit == "taxel"
    assert d.sentences() == ("taxels 5 and 77 exchanged",)
    assert d.permutation


def test_another_layout_is_not_a_permutation(plain):
    other = Skin.cover(Body.sphere(), spacing=5e-3, count=80, region=Cap((0, 0, -1)), seed=5)
    assert not compare(plain, other).permutation


def frames(skin, change=None):
    """The frames of a skin's modules, as in the URDF of iCub: each at slot 3, ids the numbers."""
    at = slots.slot(skin.ids) == slots.CENTRE
    numbers = slots.module(skin.ids[at]).tolist()
    return Skin(skin.poses[at], np.array([(change or {}).get(n, n) for n in numbers]))


@pytest.mark.parametrize("frames_first", [False, True])
def test_module_frames_are_compared_with_modules(arm, frames_first):
    """Taxels 0 to 19 of the frames are modules 0 to 19, not the taxels of modules 0 and 1."""
    pair = (frames(moved(arm)), arm) if frames_first else (arm, frames(moved(arm)))
    d = compare(*pair)
    assert d.frames == ("A" if frames_first else "B")
    assert d.ids.tolist() == list(range(20))
    assert not d.permutation
    assert d.aligned.max() < 1e-12
    expected = se3.inverse(MOTION) if frames_first else MOTION
    np.testing.assert_allclose(d.alignment, expected, atol=1e-12)


def test_exchanged_module_frames_are_named(arm):
    d = compare(arm, frames(moved(arm, 1e-4), {3: 7, 7: 3, 12: 30}))
    assert d.unit == "module"
    assert d.permutation == {3: 7, 7: 3, 12: 30}
    assert d.permutation
    assert d.only_a.tolist() == [12]
    assert d.only_b.tolist() == [30]
    assert rms(d.paired) < 3e-4


def test_a_number_whose_module_was_removed_is_used_again(arm):
    """Module 19 is taken off, and module 5 gets its number."""
    kept = Skin(arm.poses[slots.module(arm.ids) != 19], arm.ids[slots.module(arm.ids) != 19])
    d = compare(arm, renamed(moved(kept), {5: 19}))
    assert d.sentences() == ("module 5 of A is module 19 of B",)
    assert d.paired.max() < 1e-12
    assert set(slots.module(d.paired_ids).tolist()) == set(range(19))


def test_skins_without_a_common_id(plain):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        d = compare(plain, Skin(plain.poses[:20] + 0.0, plain.ids[:20] + 1000))
    assert len(d.ids) == 0
    assert np.isfinite(d.alignment).all()


def test_a_few_taxels_of_modules_are_not_module_frames(arm):
    part = np.flatnonzero(slots.module(arm.ids) < 2)
    d = compare(arm, Skin(arm.poses[part], arm.ids[part]))
    assert not d.by_modules
    assert d.unaligned.max() == 0.0


def test_module_centres_without_slot_3():
    ids = np.array([0, 1, 3, 12, 13])
    at = np.arange(15.0).reshape(5, 3)
    numbers, centres = module_centres(ids, at)
    assert numbers.tolist() == [0, 1]
    assert np.array_equal(centres, [at[2], (at[3] + at[4]) / 2])


@pytest.mark.parametrize("scale", [0.3, 3.0])
def test_an_explanation_removes_half_of_the_difference(arm, scale):
    """An exchange of two of twenty modules beside displacements of all: named if it is most of
    the difference."""
    exchanged = renamed(moved(arm), {3: 7, 7: 3})
    rng = np.random.default_rng(2)
    poses = exchanged.poses.copy()
    rest = rms(compare(arm, exchanged).aligned)
    step = scale * rest / np.sqrt(3) * rng.normal(size=(20, 3))
    module = slots.module(exchanged.ids)
    poses[~np.isin(module, (3, 7)), :3, 3] += step[module[~np.isin(module, (3, 7))]]
    d = compare(arm, Skin(poses, exchanged.ids))
    if d.permutation:
        assert rms(d.paired) <= 0.5 * rms(compare(arm, exchanged).aligned) * (1 + scale)
    assert bool(d.sentences()) == bool(d.permutation) == (scale < 1)


def test_parts_of_a_skin(plain):
    few = Skin(plain.poses[:50], plain.ids[:50])
    d = compare(plain, few)
    assert len(d.ids) == 50
    np.testing.assert_array_equal(d.only_a, np.arange(50, 80))
    assert d.aligned.max() < 1e-15
    assert d.permutation == {}


def test_skins_that_cannot_be_compared(plain):
    with pytest.raises(SkinError, match="skin B has too few taxels, got 2"):
        compare(plain, Skin(plain.poses[:2], plain.ids[:2]))
    with pytest.raises(SkinError, match="ids of a skin must be distinct"):
        compare(Skin(plain.poses, np.zeros(80, dtype=np.int64)), plain)


@needs_skin
def test_real_files():
    mesh = Skin.load(DATA / "icub_skin/positions/left_forearm_mesh.txt")
    free = Skin.load(DATA / "icub_skin/positions/left_forearm_nomesh.txt")
    d = compare(mesh, free)
    assert rms(d.aligned) == pytest.approx(3.7e-3, rel=0.02)
    assert d.permutation == {}
    assert len(d.only_a) == 1
    sole = Skin.load(DATA / "icub_skin/cad/left_foot_mesh.txt")
    d = compare(sole, Skin.load(DATA / "icub_skin/cad/l_sole_transforms.txt"))
    assert d.sentences() == ("module numbers of B are those of A plus 1",)
    assert d.paired.max() < 1e-6


@needs_skin
def test_real_module_frames():
    """The forearm's file and the URDF's frames agree to 0.13 mm, module by module."""
    urdf = DATA / "icub_body/iCubGazeboV2_5.urdf"
    if not urdf.exists():
        pytest.skip(f"needs {urdf}")
    forearm = Skin.load(DATA / "icub_skin/positions/left_forearm_V2.txt")
    for part in ("l_forearm", "r_forearm"):
        d = compare(forearm, Skin.load(urdf, part))
        assert (len(d.ids), len(d.only_a), len(d.only_b)) == (24, 0, 0)
        assert not d.permutation
        assert d.aligned.max() < 0.2e-3
    foot = Skin.load(DATA / "icub_skin/positions/left_foot.txt")
    d = compare(foot, Skin.load(urdf, "l_sole"))
    assert d.unaligned.max() < 1e-6
    d = compare(foot, Skin.load(urdf, "r_sole"))
    assert "modules 0 and 8 exchanged" in d.sentences()
    assert d.paired.max() < 2e-6
    leg = Skin.load(DATA / "icub_skin/positions/left_leg_lower.txt")
    d = compare(leg, Skin.load(urdf, "r_lower_leg"))
    assert d.permutation == {22: 20, 23: 19, 43: 46, 46: 43}  # the other leg is wired differently
    mesh = Skin.load(DATA / "icub_skin/cad/left_foot_mesh.txt")
    assert compare(mesh, Skin.load(urdf, "l_sole")).paired.max() < 2e-6


@pytest.mark.parametrize(
    ("mirror", "scale", "text"),
    [
        ((1, 1, 1), 1.01, "B is A scaled by 1.01"),
        ((1, -1, 1), 1.0, "B is A mirrored along (0.00, 1.00, 0.00)"),
        ((-1, 1, 1), 1.02, "B is A mirrored along (1.00, 0.00, 0.00) and scaled by 1.02"),
    ],
)
def test_mirrored_and_scaled_maps_are_named(arm, capsys, tmp_path, mirror, scale, text):
    poses = arm.poses.copy()
    poses[:, :3, 3] *= scale * np.array(mirror)
    d = compare(arm, Skin(poses, arm.ids))
    assert str(d.reshape) == text
    assert d.permutation == {}
    assert d.reshaped.max() < 1e-6
    assert rms(d.aligned) > 1e-4
    noisy = poses.copy()
    noisy[:, :3, 3] += np.random.default_rng(0).normal(scale=0.1e-3, size=(len(arm), 3))
    assert (compare(arm, Skin(noisy, arm.ids)).reshape.mirror is None) == (min(mirror) > 0)
    for name, skin in (("a", arm), ("b", Skin(poses, arm.ids))):
        skin.save(tmp_path / f"{name}.csv")
    assert main(["diff", str(tmp_path / "a.csv"), str(tmp_path / "b.csv")]) == 1
    printed = capsys.readouterr().out
    assert "B is A " in printed
    assert "this explains the difference" in printed


def test_noise_is_no_scale(arm):
    assert compare(arm, moved(arm, noise=1e-4)).reshape is None


def test_a_larger_skin_of_another_shape_is_no_scale(arm):
    """Shrunk to a point it is nearer to A than at its size."""
    poses = arm.poses.copy()
    poses[:, :3, 3] = 5.0 * np.random.default_rng(0).permutation(poses[:, :3, 3])
    assert compare(arm, Skin(poses, arm.ids)).reshape is None
