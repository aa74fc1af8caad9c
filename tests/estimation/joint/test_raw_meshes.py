"""A Winkler foundation on raw facets, by trimesh and NumPy: the believed surface is smooth.

Contact points are the closest ones on the triangles, readings are means of the overlap with the
indenter at random points of each taxel's disc, hence noise of their own. Lengths in mm.
"""

import numpy as np
import pyarrow as pa
import pytest
import trimesh
from scipy.spatial import cKDTree

from meshskin.contact.indenter import Indenter
from meshskin.contact.material import Material
from meshskin.estimation.calibrate import calibrate
from meshskin.geometry.body import Body
from meshskin.recording.recording import CONTACT_SCHEMA, READING_SCHEMA, Recording
from meshskin.scene.belief import Belief

INDENTER, DISC, STIFFNESS, FORCE, NODES, TAXELS = 10.0, 2.0, 0.1, 2.0, 64, 50


def pressed(axes, subdivisions, seed, contacts):
    """Positions (n, 3) of taxels on an ellipsoid of flat facets, and a recording of counts."""
    rng, mesh = np.random.default_rng(seed), trimesh.creation.icosphere(subdivisions)
    mesh.vertices *= axes
    points, face = trimesh.sample.sample_surface(mesh, 60000, seed=seed)
    normals, taxels = mesh.face_normals[face], []
    distance = np.linalg.norm(points - points[0], axis=1)
    for row in np.argsort(distance):
        if not taxels or np.linalg.norm(points[taxels] - points[row], axis=1).min() > 5.0:
            taxels.append(row)
        if len(taxels) == TAXELS:
            break
    near = np.flatnonzero(distance < distance[taxels].max() + 5.0)
    chosen = rng.choice(near, contacts, replace=False)
    depth = np.sqrt(
        FORCE * np.exp(0.1 * rng.normal(size=contacts)) / (np.pi * STIFFNESS * INDENTER)
    )
    centres = points[chosen] + normals[chosen] * (INDENTER - depth)[:, None]
    touched, distance, _ = trimesh.proximity.closest_point(mesh, centres)
    dense = trimesh.sample.sample_surface(mesh, 1000000, seed=seed + 1)[0]
    inside = cKDTree(dense).query_ball_point(centres, INDENTER)
    force = [
        np.sum(INDENTER - np.linalg.norm(dense[r] - c, axis=1))
        for r, c in zip(inside, centres, strict=True)
    ]
    force = STIFFNESS * mesh.area / len(dense) * np.array(force)
    reading = np.zeros((contacts, TAXELS))
    for k, row in enumerate(taxels):
        first = np.linalg.svd(normals[row][None])[2][1:]
        at = np.flatnonzero(np.linalg.norm(centres - points[row], axis=1) < INDENTER + DISC)
        radius, angle = (
            DISC * np.sqrt(rng.random((len(at), NODES))),
            rng.uniform(0, 2 * np.pi, (len(at), NODES)),
        )
        disc = (
            points[row] + np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=2) @ first
        )
        reading[at, k] = np.maximum(
            INDENTER - np.linalg.norm(disc - centres[at, None], axis=2), 0
        ).mean(axis=1)
    peak = np.quantile(reading[reading > 0], 0.99)
    reading += 0.01 * peak * rng.normal(size=reading.shape)
    contact, taxel = np.nonzero(reading > 0.03 * peak)
    time, outward = 0.05 * np.arange(contacts), (centres - touched) / distance[:, None]
    columns = [time, *(1e-3 * touched).T, *outward.T, force]
    readings = [time[contact], taxel.astype(np.int32), 1000 * reading[contact, taxel]]
    log = Recording(
        pa.table([np.ascontiguousarray(c) for c in columns], schema=CONTACT_SCHEMA),
        pa.table(readings, schema=READING_SCHEMA),
        {"taxel_ids": list(range(TAXELS)), "disc_radius_m": 1e-3 * DISC},
    )
    body = Body.from_mesh(trimesh.Trimesh(1e-3 * mesh.vertices, mesh.faces, process=False))
    belief = Belief(
        body=body, indenter=Indenter(1e-3 * INDENTER), material=Material(0.2e6, 0.49),
        taxel_ids=np.arange(TAXELS), disc_radius=1e-3 * DISC, readings="raw",
    )  # fmt: skip
    return 1e-3 * points[taxels], calibrate(log, belief)


@pytest.mark.slow
@pytest.mark.parametrize("contacts", [900, 2400])
def test_stated_deviations_hold_on_raw_facets(contacts):
    """Independent errors of the contacts would state 0.6 to 0.8 of the error."""
    square, stated = [], []
    for axes in ((50.0, 50.0, 50.0), (60.0, 40.0, 35.0)):
        for seed in range(2):
            truth, found = pressed(np.array(axes), 4, seed, contacts)
            square.append(np.sum((found.positions - truth) ** 2, axis=1))
            stated.append(found.position_sigma**2)
            assert found.response.alike_contacts > 1.2
    assert 0.8 < np.sqrt(np.mean(stated) / np.mean(square)) < 1.25
