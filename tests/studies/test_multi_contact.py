"""Contacts of a sphere with bodies that have hollows: positions, number, forces and patches."""

from types import SimpleNamespace

import multi_contact
import numpy as np
import pytest
import trimesh
from scipy.optimize import minimize_scalar

from meshskin import Body, contact
from meshskin.contact import boundary_elements, influence
from meshskin.core.errors import ContactError

from ..hard.test_mesh import extrude
from ..height_field import height_field

SOFT = {"modulus": 0.5e6, "poisson": 0.45}


def open_body(height, count=61, half=0.03):
    """An open body z = height(x, y) over a square."""
    return Body("field", trimesh.Trimesh(*height_field(height, half, count), process=False))


@pytest.fixture(scope="module")
def valley():
    return open_body(lambda x, y: 100.0 * x**2)


def test_one_contact_on_a_convex_body():
    body = Body.ellipsoid((0.1, 0.07, 0.05))
    foot = body.closest([[0.05, 0.05, 0.05]])
    found = multi_contact.find_contacts(body, foot.point[0] + 9e-3 * foot.normal[0], 0.01)
    assert len(found) == 1
    assert found.point == pytest.approx(foot.point, abs=1e-8)
    assert found.normal == pytest.approx(foot.normal, abs=1e-6)
    assert found.curvature == pytest.approx(foot.curvature, rel=1e-4)
    assert found.depth == pytest.approx(1e-3, abs=1e-8)


def test_no_contact_out_of_reach():
    found = multi_contact.find_contacts(Body.sphere(0.1), [0.0, 0.0, 0.12], 0.01)
    assert len(found) == 0
    assert found.point.shape == (0, 3)


def test_two_walls_of_a_v_groove():
    groove = open_body(lambda x, y: np.abs(x))
    height = (0.01 - 0.3e-3) * np.sqrt(2)
    found, force, patches = multi_contact.solve_contacts(groove, [0.0, 0.0, height], 0.01, **SOFT)
    assert len(found) == 2
    order = np.argsort(found.point[:, 0])
    root = np.sqrt(0.5)
    assert found.normal[order] == pytest.approx(np.array([[root, 0, root], [-root, 0, root]]))
    assert found.depth == pytest.approx(0.3e-3, abs=1e-9)
    hertz = 4 / 3 * 0.5e6 / (1 - 0.45**2) * np.sqrt(0.01) * 0.3e-3**1.5
    assert force == pytest.approx(hertz, rel=1e-6)
    assert [p.depth for p in patches] == pytest.approx([0.3e-3] * 2, rel=1e-6)


def test_two_sides_of_a_valley(valley):
    """z = 100 x^2 is tighter than the sphere at its bottom: the sphere rests on both sides."""
    centre = np.array([0.0, 0.0, 0.0121])
    foot = minimize_scalar(
        lambda x: np.hypot(x, 100 * x**2 - centre[2]), bounds=(1e-3, 0.02), options={"xatol": 1e-12}
    )
    found = multi_contact.find_contacts(valley, centre, 0.0105)
    assert len(found) == 2
    assert np.sort(found.point[:, 0]) == pytest.approx([-foot.x, foot.x], abs=2e-6)
    assert found.depth == pytest.approx(0.0105 - foot.fun, abs=1e-7)
    slope = 200 * foot.x
    bend = -200 / (1 + slope**2) ** 1.5
    assert found.curvature == pytest.approx(np.array([[0.0, bend]] * 2), abs=0.5)
    assert found.smooth.all()


def test_unequal_sides_are_ordered_by_depth(valley):
    found = multi_contact.find_contacts(valley, [0.3e-3, 0.0, 0.0121], 0.0106)
    assert len(found) == 2
    assert found.depth[0] > found.depth[1] + 1e-5
    assert found.point[0, 0] > 0


def test_each_patch_is_that_of_its_model(valley):
    for thickness in (None, 3e-3):
        model = "elliptic" if thickness is None else "layered"
        found, force, patches = multi_contact.solve_contacts(
            valley, [0.0, 0.0, 0.0121], 0.0103, thickness=thickness, **SOFT
        )
        for f, k, depth, patch in zip(force, found.curvature, found.depth, patches, strict=True):
            alone = contact.solve(
                model,
                force=f,
                curvature=k,
                indenter_radius=0.0103,
                thickness=thickness,
                **SOFT,
            )
            assert patch.peak == alone.peak
            assert alone.depth == pytest.approx(depth, rel=1e-8)


def test_distant_contacts_equal_boundary_elements_over_both():
    """Boundary elements over two distant bumps include the displacement of one by the other."""
    n, h, separation = 128, 1.2e-4, 8e-3
    x = (np.arange(n) - (n - 1) / 2) * h
    one = ((x - separation / 2) ** 2)[:, None] + x**2
    e_star = 0.5e6 / (1 - 0.45**2)
    both = boundary_elements.solve_grid(
        np.minimum(one, one[::-1]) / 0.02,
        influence.Influence((n, n), (h, h), e_star, 0.45),
        0.1,
        h**2,
    )
    single = contact.solve("elliptic", force=0.05, curvature=0.0, indenter_radius=0.01, **SOFT)
    assert both.pressure.max() == pytest.approx(single.peak, rel=5e-3)
    neighbour = 0.05 / (np.pi * e_star * separation)  # neglected by solve_contacts
    assert both.approach == pytest.approx(single.depth + neighbour, rel=5e-3)


def test_thin_wall_is_touched_from_outside_only():
    plate = trimesh.creation.box((0.06, 0.06, 0.002))
    for _ in range(4):
        plate = plate.subdivide()
    found = multi_contact.find_contacts(Body("plate", plate), [0.003, 0.002, 0.001 + 0.007], 0.01)
    assert len(found) == 1
    assert found.point[0] == pytest.approx([0.003, 0.002, 0.001], abs=1e-6)


def test_rings_edges_and_centres_inside_the_body_raise():
    torus = Body.torus(0.05, 0.02)
    with pytest.raises(ContactError, match="along a curve"):
        multi_contact.find_contacts(torus, [0.0, 0.0, 0.0], 0.031)
    for height in (0.018, 0.0):  # just under the surface, and deeper than the sphere reaches
        with pytest.raises(ContactError, match="inside the body"):
            multi_contact.find_contacts(torus, [0.05, 0.0, height], 0.01)
    with pytest.raises(ContactError, match="finite"):
        multi_contact.find_contacts(torus, [np.nan, 0.0, 0.0], 0.01)
    roof = open_body(lambda x, y: -np.abs(x))
    assert not multi_contact.find_contacts(roof, [0.0, 0.0, 0.0095], 0.01).smooth.any()
    with pytest.raises(ContactError, match="edge"):
        multi_contact.solve_contacts(roof, [0.0, 0.0, 0.0095], 0.01, **SOFT)


def test_overlapping_patches_raise():
    shallow = open_body(lambda x, y: 52.0 * x**2)
    found = multi_contact.find_contacts(shallow, [0.0, 0.0, 0.0101], 0.0102)
    assert len(found) == 2
    with pytest.raises(ContactError, match=r"overlap|wide"):
        multi_contact.solve_contacts(shallow, [0.0, 0.0, 0.0101], 0.0102, **SOFT)


@pytest.mark.slow
def test_shallow_minima_on_a_fine_mesh_are_separate():
    """The closest faces lie off the minima: the iterations must not end in the other minimum."""
    shallow = open_body(lambda x, y: 52.0 * x**2, count=241)
    found = multi_contact.find_contacts(shallow, [1e-6, 0.0, 0.0101], 0.0102)
    x = np.linspace(-0.01, 0.01, 2_000_001)
    distance = np.hypot(x - 1e-6, 52 * x**2 - 0.0101)
    least = 1 + np.flatnonzero((np.diff(distance[:-1]) < 0) & (np.diff(distance[1:]) > 0))
    assert len(least) == 2
    assert np.sort(found.point[:, 0]) == pytest.approx(x[least], abs=2e-6)


def test_two_contacts_in_a_v_groove():
    """A ball between the flanks touches both; beside the middle, the nearer one more deeply."""
    outline = [(-0.05, -0.05), (0.05, -0.05), (0.05, 0.02), (0.02, 0.02), (0.0, 0.0), (-0.02, 0.02),
               (-0.05, 0.02)]  # fmt: skip
    vertices, faces = extrude(outline, 0.1)
    body = Body.from_mesh(SimpleNamespace(vertices=vertices, faces=faces))
    radius, aside = 5e-3, 1e-4
    height = (radius - 3e-4) * np.sqrt(2.0)
    found = multi_contact.find_contacts(body, [aside, height, 0.003], radius)
    assert len(found) == 2
    depth = radius - (height + aside * np.array([-1.0, 1.0])) / np.sqrt(2.0)
    np.testing.assert_allclose(found.depth, depth, atol=1e-9)
    foot = 0.5 * (height + np.array([aside, -aside]))
    np.testing.assert_allclose(
        found.point, np.column_stack([[foot[0], -foot[1]], foot, [0.003] * 2]), atol=1e-9
    )
    np.testing.assert_allclose(
        found.normal * np.sqrt(2.0), [[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0]], atol=1e-6
    )
    assert found.smooth.all()
    np.testing.assert_allclose(found.curvature, 0.0, atol=1e-6)
    _, force, _ = multi_contact.solve_contacts(
        body, [aside, height, 0.003], radius, modulus=0.2e6, poisson=0.49
    )
    e_star = 0.2e6 / (1 - 0.49**2)
    np.testing.assert_allclose(force, 4 / 3 * e_star * np.sqrt(radius) * depth**1.5, rtol=1e-6)
