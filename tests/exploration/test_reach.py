"""What an indenter reaches: against closed forms on a cylinder and on an L-shaped prism."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.core.errors import ConfigError, ReachError
from meshskin.core.se3 import orthonormal_basis, transform
from meshskin.exploration import reach as module
from meshskin.exploration.left_out import other_contact
from meshskin.geometry.mesh.triangles import Triangles
from meshskin.geometry.region import Cap
from meshskin.robot.collision import EDGE, HOLLOW

from ..real_data import DATA, needs_icub

MATERIAL = ms.Material(young=0.2e6)


def hertz(radius, force, curvature=0.0):
    """Contact radius and depth, m, of a sphere on a sphere of that curvature, 1/m."""
    reduced = 1 / (1 / radius + curvature)
    a = (3 * force * reduced / (4 * MATERIAL.effective_modulus)) ** (1 / 3)
    return a, a**2 / reduced


def angle_prism(width=0.06, thick=0.02, length=0.1):
    """An L of two plates: the outline in x, y, extruded along z, in fine triangles."""
    outline = [(0, 0), (width, 0), (width, thick), (thick, thick), (thick, width), (0, width)]
    base = np.array(outline)
    corners = np.concatenate([np.c_[base, np.zeros(6)], np.c_[base, np.full(6, length)]])
    caps = [(0, 1, 2), (0, 2, 3), (0, 3, 5), (3, 4, 5)]
    faces = [t[::-1] for t in caps] + [tuple(k + 6 for k in t) for t in caps]
    for k in range(6):
        j = (k + 1) % 6
        faces += [(k, j, j + 6), (k, j + 6, k + 6)]
    mesh = trimesh.Trimesh(corners, faces, process=False)
    mesh = mesh.subdivide_to_size(4e-3)
    return ms.Body.from_triangles("angle", Triangles(mesh.vertices, mesh.faces), open=False)


def test_a_sphere_is_reached_everywhere():
    found = [*ms.reach(ms.Body.sphere(0.1), (2e-3, 10e-3)), *ms.reach(ms.Body.sphere(0.1), 10e-3)]
    assert [one.radius for one in found] == [2e-3, 10e-3, 10e-3]
    for one in found:
        assert one.share == 1.0
        assert not one.reasons


def test_a_cylinder_but_for_its_rims():
    radius, length, indenter, force = 0.03, 0.08, 8e-3, 1.0
    (one,) = ms.reach(ms.Body.cylinder(radius, length), [indenter], force=force, material=MATERIAL)
    assert one.force == force
    a, _ = hertz(indenter, force, 0.5 / radius)
    side, cap = 2 * np.pi * radius * (length - 2 * a), 2 * np.pi * (radius - a) ** 2
    total = 2 * np.pi * radius * length + 2 * np.pi * radius**2
    # 1,500 points: 1.2 %; the patch is that of one place, in one of both directions
    assert one.share == pytest.approx((side + cap) / total, abs=0.05)
    assert one.reasons == {EDGE: pytest.approx(1 - one.share)}


@pytest.mark.deep
def test_an_inner_corner_keeps_a_sphere_at_its_radius():
    """Along the inner edge a band of the indenter's radius, and of the depth, is not reached."""
    body, width, thick, length = angle_prism(), 0.06, 0.02, 0.1
    found = ms.reach(body, (4e-3, 8e-3, 16e-3), force=0.2, material=MATERIAL)
    perimeter, cross = 4 * width, 2 * width * thick - thick**2
    total = perimeter * length + 2 * cross
    for one in found:
        _, depth = hertz(one.radius, one.force)
        band = 2 * (one.radius + depth) * length / total
        assert one.reasons[HOLLOW] == pytest.approx(band, abs=0.035)
    assert found[0].share > found[1].share > found[2].share
    assert module.recommended(found).radius in (4e-3, 8e-3)


def test_hidden_surfaces_do_not_count():
    outer, inner = trimesh.creation.icosphere(4, 0.05), trimesh.creation.icosphere(4, 0.03)
    inner.invert()
    hollow = trimesh.util.concatenate([outer, inner])
    body = ms.Body("hollow ball", hollow)
    points, normals = module.even_points(body)
    seen = module.visible(body, points, normals)
    assert np.array_equal(seen, np.linalg.norm(points, axis=1) > 0.04)


def test_a_force_too_large_for_a_small_indenter_is_reduced():
    small, large = ms.reach(ms.Body.sphere(0.1), (2e-3, 20e-3), force=3.0, material=MATERIAL)
    assert large.force == 3.0
    a, _ = hertz(2e-3, small.force)
    assert a / 2e-3 == pytest.approx(module.GENTLE_WIDTH)
    assert small.share == 1.0


def test_the_recommended_indenter_is_the_largest_that_reaches_nearly_all():
    found = [module.Reach(r, 1.0, share) for r, share in ((2e-3, 0.5), (4e-3, 0.47), (8e-3, 0.04))]
    assert module.recommended(found).radius == 4e-3
    assert module.recommendation(found) == "4 mm reaches 47% instead of 4% with 8 mm"
    lighter = [module.Reach(8e-3, force, share) for force, share in ((3.0, 0.6), (1.5, 0.8))]
    lighter.append(module.Reach(4e-3, 3.0, 0.85))
    words = module.recommendation(lighter)
    assert words == "8 mm reaches 80% with 1.5 N or less instead of 60% with 3 N or less"
    none = [module.Reach(r, 1.0, 0.0) for r in (2e-3, 4e-3)]
    assert module.recommendation(none) == "none reaches anything"


def test_what_is_not_reached_is_in_parts_that_are_never_zero():
    parts = {"edge: near": 0.031, "edge: far": 0.02, "concave": 0.002}
    words = str(module.Reach(5e-3, 1.26, 0.947, parts))
    assert words == "5 mm reaches 95% with 1.3 N or less (not reached: edge 5%, concave <1%)"
    assert str(module.Reach(5e-3, 1.0, 1.0)) == "5 mm reaches 100% with 1 N or less"


@pytest.mark.deep
def test_a_plan_recommends_an_indenter_that_fits():
    """12 mm from an inner corner a sphere of 16 mm does not fit, one of 8 mm does."""
    body = angle_prism()
    x, z = np.meshgrid([0.032, 0.054], np.linspace(0.03, 0.07, 6))
    hit = body.closest(np.column_stack([x.ravel(), np.full(12, 0.02), z.ravel()]))
    poses = transform(orthonormal_basis(hit.normal), hit.point)
    skin, near = ms.Skin(poses, np.arange(12)), ms.Skin(poses[::2], np.arange(6))
    options = {"material": MATERIAL, "force": 0.5, "mode": "quasi_static"}
    plan = ms.explore(body, skin, indenter=ms.Indenter.sphere(16e-3), **options)
    (note,) = plan.notes
    assert "8 mm reaches 100% instead of 50% with 16 mm (part of the taxels" in note
    with pytest.raises(ReachError, match="8 mm reaches 100% instead of 0% with 16 mm"):
        ms.explore(body, near, indenter=ms.Indenter.sphere(16e-3), **options)
    assert not ms.explore(body, skin, indenter=ms.Indenter.sphere(8e-3), **options).notes


@pytest.mark.deep
def test_a_plan_recommends_a_lighter_force_where_it_reaches_more(monkeypatch):
    """In a bowl of 20 mm the patch of 3 N is too wide for contact models (a/R = 0.60, limit 0.52),
    that of 1.5 N is not (0.48): a plan under 3 N presses with it, too."""
    ball = trimesh.creation.icosphere(4, 20e-3)
    faces = ball.faces[(ball.triangles_center[:, 2] < -14e-3)][:, ::-1]
    bowl = ms.Body.from_mesh(trimesh.Trimesh(ball.vertices, faces), open=True)
    skin = ms.Skin.cover(bowl, spacing=5e-3, count=3, region=Cap(direction=(0.0, 0.0, -1.0)))
    scene = ms.Scene(
        body=bowl,
        skin=skin,
        indenter=ms.Indenter.sphere(8e-3),
        material=ms.Material(young=0.4e6),
        loop=ms.Loop(mode="quasi_static"),
    )
    found = module.other_contacts(scene)
    assert [one.force for one in found[:3]] == [3.0, 1.5, 0.75]
    assert found[0].share == 1.0
    left_out = dict.fromkeys(range(3), "elliptic contact does not hold")
    assert other_contact(scene, left_out) == ""
    none = (replace(found[0], share=0.0), *found[1:])
    assert module.recommended(none) is found[1]
    monkeypatch.setattr(module, "other_contacts", lambda scene: none)
    assert other_contact(scene, left_out).startswith("use a lighter force: 8 mm reaches")
    assert other_contact(scene, {}) == ""


@pytest.mark.parametrize(("radii", "word"), [((), "no radius"), ((4e-3, 0.0), "radius of an")])
def test_values_out_of_range(radii, word):
    with pytest.raises(ConfigError, match=word):
        ms.reach(ms.Body.sphere(0.1), radii)


@pytest.mark.slow
@needs_icub
def test_smaller_indenters_reach_more_of_an_icub_forearm():
    (file,) = DATA.glob("icub_body/meshes/sim_sea_2-5_l_forearm_prt-binary.stl")
    found = ms.reach(ms.Body.load(file, units="mm", open=True), (2e-3, 4e-3, 8e-3))
    assert found[0].share > found[1].share > found[2].share > 0.4
    assert module.recommended(found).radius == 2e-3
