"""Contacts over edges of the body, where no quadric describes the surface within a patch.

A thin layer on a rigid prism, written here with NumPy alone: pressure is stiffness times the
overlap of the indenter with the layer along the face's normal, and a taxel reads its mean over a
disc.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pyarrow as pa
import pytest
import trimesh

import meshskin as ms
from meshskin.estimation.data.gather import gather
from meshskin.estimation.data.patch_shape import over_edges
from meshskin.estimation.localization import CalibratedSkin
from meshskin.estimation.next_contact import next_contacts
from meshskin.estimation.online.frames import RecordedFrames
from meshskin.estimation.online.known_response import KnownResponse
from meshskin.estimation.trilateration.trilaterate import with_noise_off_edges
from meshskin.estimation.uncertainty import metrics
from meshskin.geometry.region import Cap
from meshskin.recording.recording import CONTACT_SCHEMA, READING_SCHEMA, Recording

FACES, APOTHEM, INDENTER, DISC, STIFFNESS, FORCE, PITCH = 6, 0.04, 6e-3, 2e-3, 3e8, 2.0, 5e-3
WIDTH = 2 * APOTHEM * np.tan(np.pi / FACES)
ARC, HEIGHT = (
    x.ravel()
    for x in np.meshgrid(WIDTH / 2 + PITCH * np.arange(-4, 1) + 1e-3, PITCH * np.arange(-2, 3))
)


def on_prism(arc, height):
    """Points and normals of arc lengths from the middle of a face, and heights, m."""
    face = np.round(np.asarray(arc) / WIDTH)
    angle, along = 2 * np.pi * face / FACES, arc - WIDTH * face
    zero = np.zeros_like(angle)
    normal = np.stack([np.cos(angle), np.sin(angle), zero], axis=-1)
    tangent = np.stack([-np.sin(angle), np.cos(angle), zero], axis=-1)
    up = np.asarray(height)[..., None] * [0.0, 0.0, 1.0]
    return APOTHEM * normal + along[..., None] * tangent + up, normal


def overlap(centre, points, normals):
    """Overlap of balls with the lines into the body at points (m, k, 3), m."""
    apart = points - centre[:, None]
    along = np.einsum("mkj,mkj->mk", apart, normals)
    root = along**2 - np.einsum("mkj,mkj->mk", apart, apart) + INDENTER**2
    return np.where(root > 0, np.maximum(along + np.sqrt(np.maximum(root, 0)), 0), 0)


@cache
def recording(seed=0, count=150, noise=0.01):
    """Taps at random places about an edge, raw readings in a unit of their own."""
    rng = np.random.default_rng(seed)
    arc = rng.uniform(ARC.min() - 3e-3, ARC.max() + 1e-3, count)
    height = rng.uniform(HEIGHT.min() - 3e-3, HEIGHT.max() + 3e-3, count)
    points, normals = on_prism(arc, height)
    force = FORCE * np.exp(0.2 * rng.standard_normal(count))
    near, step = np.linspace(-6e-3, 6e-3, 31, retstep=True)
    u, v = (x.ravel() for x in np.meshgrid(near, near))
    around = on_prism(arc[:, None] + u, height[:, None] + v)
    low, high = np.zeros(count), np.full(count, 3e-3)
    for _ in range(30):
        depth = (low + high) / 2
        centre = points + (INDENTER - depth)[:, None] * normals
        more = STIFFNESS * step**2 * overlap(centre, *around).sum(axis=1) < force
        low, high = np.where(more, depth, low), np.where(more, high, depth)
    k = np.arange(100) + 0.5
    disc = DISC * np.sqrt(k / 100) * np.exp(1j * np.pi * (1 + 5**0.5) * k)
    felt = on_prism(ARC[:, None] + disc.real, HEIGHT[:, None] + disc.imag)
    shape = (1, -1, 3)
    reading = overlap(
        centre, *(np.broadcast_to(x.reshape(shape), (count, x.size // 3, 3)) for x in felt)
    )
    reading = reading.reshape(count, len(ARC), -1).mean(axis=2)
    noise *= np.median(reading.max(axis=0))
    reading += noise * rng.standard_normal(reading.shape)
    contact, taxel = np.nonzero(reading > 3 * noise)
    time = 0.02 * np.arange(count)
    columns = [np.ascontiguousarray(x) for x in (time, *points.T, *normals.T, force)]
    readings = [time[contact], taxel.astype(np.int32), STIFFNESS * reading[contact, taxel]]
    facts = {"taxel_ids": list(range(len(ARC))), "disc_radius_m": DISC}
    return Recording(
        pa.table(columns, schema=CONTACT_SCHEMA), pa.table(readings, schema=READING_SCHEMA), facts
    )


@pytest.fixture(scope="module")
def belief(tmp_path_factory):
    radius = APOTHEM / np.cos(np.pi / FACES)
    mesh = trimesh.creation.cylinder(radius, 0.2, sections=FACES)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / FACES, [0, 0, 1]))
    path = tmp_path_factory.mktemp("edges") / "prism.stl"
    mesh.export(path)
    return ms.Belief(
        body=ms.Body.load(path, "m"), indenter=ms.Indenter.sphere(INDENTER),
        material=ms.Material(0.5e6, 0.49), taxel_ids=np.arange(len(ARC)), disc_radius=DISC,
        contact="learned",
    )  # fmt: skip


def contact_model(belief, contact):
    """The belief in a contact model; that of a thin layer suits the foam."""
    if contact != "elliptic":
        belief = belief.with_(material=ms.Material(0.16e6, 0.46, 1e-3))
    return belief.with_(contact=contact)


def test_uneven_contacts_are_those_over_an_edge(belief):
    data = gather(recording(1), belief)
    away = np.degrees(
        np.abs(np.angle(np.exp(1j * (np.arctan2(*data.points.T[1::-1]) - np.pi / 6))))
    )
    assert np.all(data.uneven[away < 2.0] > 5.0)
    assert data.uneven[away > 12.0].max() < 0.1


@pytest.mark.deep
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_taxels_beside_an_edge_are_where_their_sigma_says(belief, seed):
    found = ms.calibrate(recording(seed), belief)
    off = np.linalg.norm(found.positions - on_prism(ARC, HEIGHT)[0], axis=1)
    placed = np.isfinite(off)
    score = off[placed] / found.position_sigma[placed]
    assert placed.mean() > 0.9
    assert score.max() < 4.0


@pytest.mark.parametrize(
    "contact", ["auto", *(pytest.param(c, marks=pytest.mark.deep) for c in ("elliptic", "layered"))]
)
def test_taxels_beside_an_edge_under_a_contact_model(belief, contact):
    """None was left out of the estimates that were 18 standard deviations off without a deviation
    of the readings over the edge."""
    found = ms.calibrate(recording(1), contact_model(belief, contact))
    off = np.linalg.norm(found.positions - on_prism(ARC, HEIGHT)[0], axis=1)
    placed = np.isfinite(off)
    far = np.abs(ARC - WIDTH / 2) > 12e-3
    assert found.response is None
    assert placed.mean() > 0.8
    assert (off[placed] / found.position_sigma[placed]).max() < 5.0
    assert off[far & placed].max() < 0.1e-3
    assert found.position_sigma[far & placed].max() < 0.1e-3


@pytest.mark.parametrize(
    "method",
    ["trilateration", "posegraph", pytest.param("posegraph_isotropic", marks=pytest.mark.deep)],
)
def test_circles_beside_an_edge(belief, method):
    """Residuals of contacts off the edge do not scale the deviations of those over it: the pose
    graphs were 8 and 10 standard deviations off."""
    found = ms.calibrate(recording(1), contact_model(belief, "elliptic"), method=method)
    off = np.linalg.norm(found.positions - on_prism(ARC, HEIGHT)[0], axis=1)
    placed = np.isfinite(off)
    assert placed.sum() > 9
    assert (off[placed] / found.position_sigma[placed]).max() < 4.0


def test_noise_by_circles_off_edges(belief):
    believed = contact_model(belief, "elliptic")
    noisy, more = (gather(recording(1, noise=noise), believed) for noise in (0.03, 0.06))
    assert noisy.noise is None
    ratio = with_noise_off_edges(more).noise / with_noise_off_edges(noisy).noise
    assert ratio == pytest.approx(2.0, rel=0.15)
    known = believed.with_(noise_sigma=2e3)
    data = gather(recording(1), known)
    assert with_noise_off_edges(data) is data


@pytest.mark.slow
def test_a_map_tested_by_touches_over_an_edge(belief):
    """A taxel beside the edge was taken for dead, for it was silent where the model has it read."""
    believed = contact_model(belief, "elliptic")
    previous = ms.calibrate(recording(11, 300), believed)
    found = ms.recalibrate(previous, recording(1, 40), believed)
    assert not found.findings
    assert (found.unit_states == "confirmed").sum() > 18
    touches = recording(1, 40)
    lost = touches.readings.filter(pa.array(touches.reading_taxel != 6))
    dead = ms.recalibrate(previous, replace(touches, readings=lost), believed)
    assert [finding.number for finding in dead.findings] == [6]


def test_next_contacts_keep_off_the_edge(belief):
    """Where readings over the edge counted as others did, the part was 0.12."""
    believed = contact_model(belief, "elliptic").with_(force_reference=FORCE)
    chosen = next_contacts(ms.calibrate(recording(1), believed), believed, 8)
    part = over_edges(believed, believed.body.closest(chosen.points), np.full(8, FORCE))
    assert part.mean() < 0.05


@pytest.mark.slow
def test_a_calibrated_skin_has_the_errors_of_its_learned_response(belief):
    taps = recording(1)
    found = ms.calibrate(taps, belief)
    skin = CalibratedSkin.of(found, gather(taps, belief))
    near = np.abs(np.arctan2(*skin.data.points.T[1::-1]) - np.pi / FACES) * APOTHEM < 1e-3
    response, d = found.response, skin.deviations
    assert (d.position, d.force) == (response.contact_scatter, response.force_scatter)
    assert 0.1 < response.edge_error < 0.6
    assert np.all(skin.data.precision[near] < 0.2)
    known = KnownResponse.of(found, taps)
    online = known.online()
    frames = RecordedFrames(known.recording, online.ids, known.errors)
    online.update(*frames.part(0, len(taps.points)))
    stored = online.estimate.store.columns["unevenness"].values
    assert np.median(stored[near] / skin.data.unevenness[near]) == pytest.approx(1.0, abs=0.1)


def narrow(recording, width):
    """The recording without the contacts further than `width`, m, from the edge."""
    angle = np.arctan2(*recording.points.T[1::-1]) - np.pi / FACES
    near = np.abs(angle) * APOTHEM < width
    read = near[recording.reading_contact]
    return Recording(
        recording.contacts.filter(pa.array(near)),
        recording.readings.filter(pa.array(read)),
        recording.metadata,
    )


@pytest.mark.slow
def test_contacts_mostly_over_an_edge_test_no_contact_model(belief):
    near = narrow(recording(1), 3e-3)
    believed = ms.calibrate(near, contact_model(belief, "elliptic"))
    assert believed.verdict.level == "DOUBT"
    assert any("over edges of the body" in words for words in believed.verdict.reasons)
    chosen = ms.calibrate(near, contact_model(belief, "auto"))
    assert chosen.response is not None


@pytest.mark.deep
@pytest.mark.parametrize("reference", [None, 0.5])
def test_the_online_estimate_weighs_contacts_over_edges_as_the_batch_estimate(belief, reference):
    believed = contact_model(belief, "elliptic").with_(
        force_reference=reference, noise_sigma=2e3, threshold=6e3
    )
    batch = ms.calibrate(recording(), believed)
    online = ms.OnlineCalibration(believed)
    online.update_recording(recording())
    online.settle()
    both = np.isfinite(batch.positions[:, 0]) & np.isfinite(online.positions[:, 0])
    apart = np.linalg.norm(online.positions - batch.positions, axis=1) / batch.position_sigma
    assert both.sum() > 15
    assert apart[both].max() < 0.05


@pytest.mark.deep
@pytest.mark.parametrize("method", ["joint", "trilateration"])
def test_many_contacts_over_an_edge_do_not_average_the_error_of_the_model(belief, method):
    """Taken as independent, these errors had standard deviations of 0.5 and 0.3 of their size."""
    found = ms.calibrate(recording(1, 1000), contact_model(belief, "elliptic"), method=method)
    beside = np.abs(ARC - WIDTH / 2) < 2e-3
    off = np.linalg.norm(found.positions - on_prism(ARC, HEIGHT)[0], axis=1)[beside]
    stated = found.position_sigma[beside]
    assert 0.7 < np.sqrt(np.mean(stated**2) / np.mean(off**2)) < 1.8


@pytest.mark.slow
def test_contacts_are_alike_among_all_that_came(belief):
    believed = contact_model(belief, "elliptic").with_(noise_sigma=2e3, threshold=6e3)
    data = gather(taps := recording(1, 1000), believed)
    over = data.unevenness > 0
    assert np.all(data.alike[~over] == 1)
    assert np.median(data.alike[over]) > 1.5
    online = ms.OnlineCalibration(believed)
    online.update_recording(taps)
    store = online.estimate.store
    last = np.flatnonzero(over)[-3:]
    part = store.part(np.empty(0, dtype=int), last).data
    assert part.alike.tolist() == data.alike[last].tolist()
    assert gather(recording(1, 150), believed).alike.max() < data.alike.max()


@pytest.fixture(scope="module")
def rippled():
    """A scene on a capsule with ripples within every patch, and its recording. This world has no
    errors there."""
    mesh = ms.Body.capsule(0.03, 0.1, faces=6000).mesh.copy()
    height = 0.3e-3 * np.sin(2 * np.pi * mesh.vertices[:, 2] / 14e-3)
    mesh.vertices = mesh.vertices + height[:, None] * mesh.vertex_normals
    body = ms.Body.from_mesh(mesh)
    base = ms.Scene.load("sphere_noisy")
    scene = base.with_(
        body=body,
        skin=ms.Skin.cover(body, spacing=6e-3, count=30, seed=1, region=Cap((1.0, 0.0, 0.2))),
        material=ms.Material(young=0.4e6),
        indenter=ms.Indenter.sphere(8e-3),
        loop=replace(base.loop, mode="quasi_static"),
        exploration=replace(base.exploration, pattern="lanes", lane_spacing=2.5e-3),
    )
    return scene, ms.simulate(scene, seed=1)


@pytest.mark.deep
def test_readings_over_edges_do_not_make_others_outlying(rippled):
    """Residuals of the readings over the ripples are small beside the deviation that these are
    given."""
    scene, recorded = rippled
    found = ms.calibrate(recorded, scene.belief(noise_sigma=None))
    assert not any(found.faults)
    assert found.fit.noise == pytest.approx(scene.belief().noise_sigma, rel=0.15)


@pytest.mark.deep
def test_edges_that_cause_no_misfit_cost_nothing(rippled):
    """Weighed by the heights there, the error was 1.51 times the bound."""
    scene, recorded = rippled
    data = gather(recorded, scene.belief())
    assert data.edges > 0.5 * len(data.points)
    found = ms.calibrate(recorded, scene.belief())
    bound = metrics.cramer_rao(recorded, scene.belief(), scene.skin).covariance
    ratio = np.sum(metrics.position_errors(found, scene.skin) ** 2)
    assert ratio < 1.2**2 * np.trace(bound, axis1=1, axis2=2).sum()
