"""Layouts from co-activation: closed forms, simulated touches with known truth, real ones."""

from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.errors import CalibrationError, ConfigError
from meshskin.estimation.layout import coactivity, placement, stress, tiles
from meshskin.estimation.layout.alignment import aligned, root_mean_square
from meshskin.skin import slots

from ...real_data import DATA, needs_torso

PITCH = 6.5e-3


def lattice(rows: int, columns: int, pitch: float = PITCH) -> np.ndarray:
    """A hexagonal lattice (rows * columns, 2), m."""
    i, j = np.mgrid[:rows, :columns].reshape(2, -1)
    return pitch * np.column_stack([j + 0.5 * (i % 2), np.sqrt(0.75) * i])


def touched(points: np.ndarray, count: int, radius: float = 10e-3, seed: int = 0) -> np.ndarray:
    """Graded frames (count, n) of touches spread evenly, of slightly varying radius."""
    rng = np.random.default_rng(seed)
    low, high = points.min(axis=0) - radius, points.max(axis=0) + radius
    centre = rng.uniform(low, high, (count, points.shape[1]))
    size = radius * rng.normal(1.0, 0.1, count)
    off = np.linalg.norm(centre[:, None] - points, axis=2) + rng.normal(0, 5e-4, (count, 1))
    return np.maximum(1.0 - (off / size[:, None]) ** 2, 0.0)


def modules(origins, angles) -> tuple[np.ndarray, np.ndarray]:
    """Ids (n,) and positions (n, 2), m, of the ten taxels of modules at given poses."""
    ids = np.concatenate([12 * k + np.array(slots.TAXELS) for k in range(len(angles))])
    module = placement.Modules(
        ids // 12, slots.OFFSETS[ids % 12, :2], np.asarray(origins), np.asarray(angles)
    )
    return ids, module.positions


def tiling(rows: int = 3, columns: int = 4, pitch: float = 18.4e-3):
    """Poses of triangular modules edge to edge."""
    side, origins, angles = pitch * np.sqrt(3.0), [], []
    for i in range(rows):
        for j in range(columns):
            down = (i + j) % 2
            height = side * np.sqrt(0.75) * i + (pitch / 2 if down else 0.0)
            origins.append((0.5 * side * j, height))
            angles.append(np.pi if down else 0.0)
    return np.array(origins), np.array(angles)


def test_the_overlap_of_discs_is_the_closed_form():
    """At d = r the lens is (2 pi / 3 - sqrt(3) / 2) r^2."""
    lens = 2 * np.pi / 3 - np.sqrt(0.75)
    index = np.array([1.0, lens / (2 * np.pi - lens), 0.0])
    found = coactivity.disc_distances(index, np.array([1.0]))
    np.testing.assert_allclose(found, [0.0, 1.0, 2.0], atol=1e-5)


def test_distances_are_those_of_simulated_touches():
    points = lattice(12, 12)
    radius = 10e-3
    frames = touched(points, 20_000) > 0
    lengths = coactivity.path_lengths(coactivity.distinct_levels(frames))
    true = stress.distances(points) / radius
    near = (true > 0.5) & (true < 1.3)  # the touches' radii vary: far pairs share the large ones
    ratio = lengths[near] / true[near]
    assert abs(np.mean(ratio) - 1.0) < 0.04
    assert np.std(ratio) < 0.06


def test_exact_distances_give_exact_positions():
    points = lattice(6, 5)
    found = stress.in_plane(stress.distances(points))
    assert root_mean_square(aligned(found, points) - points) < 1e-6 * PITCH


@pytest.mark.parametrize("kind", ["modules", "body"])
def test_the_gradient_of_the_stress_is_that_of_differences(kind):
    rng = np.random.default_rng(3)
    if kind == "modules":
        ids, points = modules(*tiling(1, 3))
        offsets = slots.OFFSETS[ids % 12, :2]
        start = placement.Modules(ids // 12, offsets, *[np.array(x) for x in tiling(1, 3)])
    else:
        plane = lattice(4, 4)
        body = ms.Body.sphere(0.1)
        points = np.column_stack([plane, np.full(len(plane), 0.1)])
        start = placement.OnBody.at(body, points)
    lengths = stress.distances(points) * rng.uniform(0.9, 1.1, (len(points),) * 2)
    lengths = (lengths + lengths.T) / 2e-2
    weight = stress.weights(lengths)
    _, gradient = placement._normal_equations(start, lengths, weight, 9e-3)

    def value(step: np.ndarray) -> float:
        moved = start.moved(step[:-1])
        if kind == "body":  # the arcs' bulge is held in a step
            moved = replace(moved, rotations=start.rotations)
        return placement._stress(moved, lengths, weight, 9e-3 + step[-1])

    for k in [*range(6), len(gradient) - 1]:
        step = np.zeros(len(gradient))
        step[k] = 1e-6
        slope = (value(step) - value(-step)) / 2e-6
        assert slope == pytest.approx(gradient[k], rel=1e-4, abs=1e-7 * np.abs(gradient).max())


@pytest.mark.deep
def test_a_layout_without_any_knowledge():
    points = lattice(9, 9)
    frames = touched(points, 6000)
    frames[:, 7] = 0.0
    found = ms.layout(frames, np.arange(81) + 100)
    assert found.unit == "spacings"
    assert "mirror image, scale" in found.gauge
    assert found.reasons[7] == "answers in no frame"
    assert np.isnan(found.positions[7]).all()
    assert (np.delete(found.reasons, 7) == "").all()
    error = np.linalg.norm(aligned(found.positions, points, scale=True) - points, axis=1)
    assert np.sqrt(np.nanmean(error**2)) < 0.25 * PITCH
    assert np.nanmean(error < 2 * found.sigma * PITCH) > 0.9
    assert found.uncertain[7]
    assert not np.delete(found.uncertain, 7).any()


def test_what_is_touched_seldom_is_more_uncertain():
    points = lattice(8, 12)
    frames = touched(points, 4000) > 0
    rng = np.random.default_rng(1)
    right = points[:, 0] > np.median(points[:, 0])
    keep = ~frames[:, right].any(axis=1) | (rng.uniform(size=len(frames)) < 0.03)
    found = ms.layout(frames[keep], spacing=PITCH)
    assert np.nanmedian(found.sigma[right]) > 1.3 * np.nanmedian(found.sigma[~right])


@pytest.mark.deep
def test_rigid_modules_give_scale_and_handedness():
    ids, points = modules(*tiling())
    frames = touched(points, 5000) > 0
    found = ms.layout(frames, ids, module_slots=slots.OFFSETS)
    assert found.unit == "m"
    assert "mirror" not in found.gauge
    off = aligned(found.positions, points, mirror=False) - points
    assert root_mean_square(off) < 1.5e-3
    exact = ms.layout(frames, ids, module_slots=slots.OFFSETS, tiled=True)
    assert root_mean_square(aligned(exact.positions, points, mirror=False) - points) < 0.1 * PITCH


def near(true: placement.Modules, unit: float = 12e-3) -> np.ndarray:
    """Exact distances (n, n) of taxels nearer than 1.4 units, 0 of others."""
    lengths = stress.distances(true.positions) / unit
    return np.where(lengths < 1.4, lengths, 0.0)


def test_a_tiling_finds_turns_by_thirds_and_refuses_what_does_not_tile():
    origins, angles = tiling()
    rng = np.random.default_rng(0)
    ids, _ = modules(origins, angles)
    turned = angles + 2 * np.pi / 3 * rng.integers(0, 3, len(angles))
    true = placement.Modules(ids // 12, slots.OFFSETS[ids % 12, :2], origins, turned)
    moved = true.moved(rng.normal(0, 1, 36) * np.tile([1.5e-3, 1.5e-3, 0.1], 12))
    placed, misfit = tiles.tiled(moved, near(true), 12e-3)
    off = aligned(placed.positions, true.positions, mirror=False) - true.positions
    assert root_mean_square(off) < 0.6e-3  # the pitch is that of the moved ones
    assert misfit.max() < 6e-3


def test_five_modules_about_a_corner_do_not_tile_the_plane():
    """As on a cone: neighbours agree, the way around does not."""
    angle = 2 * np.pi / 5 * np.arange(5)
    radius = 18.4e-3 / (2 * np.sin(np.pi / 5))
    ids, _ = modules(np.zeros((5, 2)), angle)
    origins = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    # a corner of each, at 90 degrees in its frame, points to the middle
    cone = placement.Modules(ids // 12, slots.OFFSETS[ids % 12, :2], origins, angle + np.pi / 2)
    with pytest.raises(CalibrationError, match="1 of 5 edges contradict"):
        tiles.tiled(cone, near(cone), 12e-3)


def test_parts_that_no_edge_joins_are_tiled_apart():
    origins, angles = tiling(1, 3)
    both = np.concatenate([origins, origins + np.array([0.0, 60e-3])])
    ids, _ = modules(both, np.tile(angles, 2))
    true = placement.Modules(ids // 12, slots.OFFSETS[ids % 12, :2], both, np.tile(angles, 2))
    placed, misfit = tiles.tiled(true, near(true), 12e-3)
    np.testing.assert_allclose(placed.positions, true.positions, atol=1e-9)
    assert misfit.max() < 1e-9


def test_parts_are_placed_by_near_taxels_across_their_gap():
    """One of two strips is 4 mm off and turned; the unit is believed a tenth too small."""
    origins, angles = tiling(1, 6)
    second = placement.rotated(origins, 0.05) + np.array([2e-3, 33e-3])
    both, turns = np.concatenate([origins, second]), np.concatenate([angles, angles + 0.05])
    ids, _ = modules(both, turns)
    true = placement.Modules(ids // 12, slots.OFFSETS[ids % 12, :2], both, turns)
    wrong = placement.rotated(second, 0.08) + np.array([3e-3, 2e-3])
    start = replace(
        true,
        origins=np.concatenate([origins, wrong]),
        angles=np.concatenate([angles, angles + 0.13]),
    )
    assert root_mean_square(aligned(start.positions, true.positions) - true.positions) > 1e-3
    placed, misfit = tiles.tiled(start, near(true), 10.8e-3)
    off = aligned(placed.positions, true.positions, mirror=False) - true.positions
    assert root_mean_square(off) < 1e-5
    moved = np.linalg.norm(placed.positions - start.positions, axis=1)
    np.testing.assert_allclose(misfit, np.sqrt(np.bincount(ids // 12, moved**2) / 10), rtol=1e-9)
    np.testing.assert_allclose(
        placed.positions.mean(axis=0), start.positions.mean(axis=0), atol=1e-9
    )


@pytest.mark.deep
def test_a_layout_on_a_sphere_is_that_of_the_taxels():
    body = ms.Body.sphere(0.06)
    plane = lattice(8, 8, 5e-3)
    plane -= plane.mean(axis=0)
    hit = body.closest(np.column_stack([plane, np.full(len(plane), 0.06)]))
    rng = np.random.default_rng(0)
    centre = body.closest(
        np.column_stack([rng.uniform(-25e-3, 25e-3, (4000, 2)), np.full(4000, 0.06)])
    ).point
    off = np.linalg.norm(centre[:, None] - hit.point, axis=2)
    frames = np.maximum(1.0 - off / 7e-3, 0.0)
    frames = frames[frames.any(axis=1)]
    found = ms.layout(frames, spacing=5e-3, body=body)
    assert "not determined: mirror image, and motions that take the body to itself" in found.gauge
    on_surface = body.closest(found.positions).distance
    assert np.abs(on_surface).max() < 1e-6
    assert root_mean_square(aligned(found.positions, hit.point) - hit.point) < 1.5e-3


@pytest.mark.parametrize(
    ("frames", "knowledge", "message"),
    [
        (np.zeros((5, 4)), {}, "no taxel answers"),
        (np.ones(4), {}, "a row per frame"),
        (-np.ones((5, 4)), {}, "not negative"),
        (np.full((5, 4), np.nan), {}, "finite"),
        ([["a"]], {}, "must be numbers"),
        (np.eye(6), {}, "too few taxels answer together"),
        (np.ones((5, 4)), {"ids": [0, 1, 1, 2]}, "different whole numbers"),
        (np.ones((5, 4)), {"spacing": -1.0}, "out of range"),
        (np.ones((5, 4)), {"spacing": 1.0, "touch_radius": 1.0}, "one scale"),
        (np.ones((5, 4)), {"tiled": True}, "need module_slots"),
        (np.ones((5, 4)), {"module_slots": [1.0]}, "must be positions"),
        (np.ones((5, 4)), {"module_slots": [[0.0, 0.0], [np.nan, 0.0]]}, "must be finite"),
        (np.ones((5, 4)), {"module_slots": [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]}, "different places"),
        (np.ones((5, 4)), {"body": ms.Body.sphere(0.1)}, "needs a scale"),
        (np.ones((5, 4)), {"centre": [0.0, 0.0, 0.1]}, "needs a body"),
    ],
)
def test_bad_input(frames, knowledge, message):
    with pytest.raises(CalibrationError, match=message):
        ms.layout(frames, **knowledge)


def test_a_path_is_no_body():
    with pytest.raises(
        ConfigError, match=r"must be a Body, got 'a.stl'; give Body.load\('a.stl'\)"
    ):
        ms.layout(np.ones((5, 4)), spacing=5e-3, body="a.stl")


def test_an_alignment_needs_three_points():
    with pytest.raises(ConfigError, match="at least 3"):
        aligned(np.eye(2), np.eye(2))


@needs_torso
@pytest.mark.slow
def test_the_torso_of_icub():
    """Two modules of the published layout are turned by 120 degrees, as their touches show."""
    from scipy.io import loadmat

    folder = DATA / "icub_torso_touches"
    published = loadmat(folder / "TorsoTaxPosCut.mat")
    frames = loadmat(folder / "torso1exper1thumbACut.mat")["TrainTorso1expA"]
    ids = published["TorsoNumbTaxCut"].ravel().astype(int) - 1
    true = 1e-3 * published["TorsoTaxPosCut"][:2].T
    found = ms.layout(frames, ids, module_slots=slots.OFFSETS, tiled=True)
    error = np.linalg.norm(aligned(found.positions, true, scale=True) - true, axis=1)
    assert np.sqrt(np.mean(error**2)) < 3.2e-3
    turned = np.isin(ids // 12, [256, 260])
    rest = aligned(found.positions[~turned], true[~turned], scale=True) - true[~turned]
    assert root_mean_square(rest) < 1.2e-3
