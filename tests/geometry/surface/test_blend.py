"""Patches next to their flat faces: bounds of their heights, on smooth and on rough meshes."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from meshskin.geometry.body import Body
from meshskin.geometry.surface import blend, patch
from meshskin.geometry.surface.creases import crease_curves
from meshskin.geometry.surface.surface import Surface


def rough(subdivisions, amplitude):
    """A sphere of 0.1 m whose vertices are displaced radially by up to a share of the radius."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.1)
    rng = np.random.default_rng(3)
    mesh.vertices *= 1.0 + amplitude * rng.uniform(-1, 1, (len(mesh.vertices), 1))
    return Surface(mesh)


@pytest.mark.parametrize(
    "surface",
    [
        Body.torus(0.1, 0.04, faces=500).surface,
        Body.cylinder(0.05, 0.2, faces=300).surface,
        rough(2, 0.05),
    ],
)
def test_offsets_bound_the_distances_between_patches_and_faces(surface):
    """At 325 points of every face; `offsets` come from the 21 nodes."""
    n = 24
    uv = np.array([(i / n, j / n) for i in range(n + 1) for j in range(n + 1 - i)])
    weight = np.column_stack([1.0 - uv.sum(axis=1), uv])
    on_patch = np.einsum("qk,mkc->mqc", patch.monomials(*uv.T), surface.patches)
    on_face = np.einsum("qk,mkc->mqc", weight, surface.vertices[surface.faces])
    distance = np.linalg.norm(on_patch - on_face, axis=2).max(axis=1)
    assert np.all(distance <= surface.offsets + 1e-12)


@pytest.mark.parametrize(("subdivisions", "amplitude"), [(2, 0.3), (3, 0.05), (3, 0.3)])
def test_no_patch_is_higher_than_the_tangent_planes_at_its_corners(subdivisions, amplitude):
    """As an arc is not higher than its end tangents: to 0.3 % of the shortest side of the face."""
    surface = rough(subdivisions, amplitude)
    corner, jets = surface.fans.corner, surface.jets
    values, base = blend.node_values(jets, corner)
    origin = jets.origin[corner]
    offset = base[:, None] - origin[:, :, None]
    tangent = np.abs(np.einsum("mknc,mkc->mkn", offset, jets.normals[corner])).max(axis=1)
    side = np.linalg.norm(origin - origin[:, [1, 2, 0]], axis=2).min(axis=1)
    excess = np.linalg.norm(values - base, axis=2) - tangent
    assert np.all(excess <= 3.001e-3 * side[:, None])


@pytest.mark.parametrize(("subdivisions", "amplitude"), [(2, 0.02), (3, 0.01)])
def test_patches_stay_within_twice_the_roughness_of_their_faces(subdivisions, amplitude):
    """Where no polynomial fits the vertices, the faces stay flat."""
    assert rough(subdivisions, amplitude).offsets.max() < 2 * amplitude * 0.1


def test_creases_of_faces_that_did_not_change_are_kept():
    """Other jets at some fans and chords at some edges: the curves are those found anew, and those
    of all other edges are not computed again."""
    surface = rough(3, 0.3)
    fans, across = surface.fans, (surface.neighbours, surface.slot)
    chords = np.zeros(fans.corner.shape, dtype=bool)
    jets = surface.jets
    before = crease_curves(jets, fans, *across, chords)
    rng, degree = np.random.default_rng(1), jets.degree.copy()
    degree[rng.integers(len(degree), size=20)] = 0
    later = replace(jets, degree=degree)
    changed = (degree != jets.degree)[fans.corner].any(axis=1)
    chorded = rng.permutation(np.argwhere(fans.sharp))[:20]
    for face, k in chorded:
        there, slot = across[0][face, k], across[1][face, k]
        chords[face, k] = chords[there, slot] = changed[face] = changed[there] = True
    fresh = crease_curves(later, fans, *across, chords)
    kept = crease_curves(later, fans, *across, chords, (before, changed))
    np.testing.assert_allclose(kept.curve, fresh.curve, rtol=0, atol=1e-15)
    assert np.abs(fresh.curve - before.curve).max() > 1e-5
    marked = replace(before, curve=before.curve + 1.0)
    assert (crease_curves(later, fans, *across, chords, (marked, changed)).curve > 0.5).any()
