"""A small exact world for the tests: the paper's sphere, contacts on lanes, readings over discs.

Its bodies are the exact primitives, its contact models those of physics, and its disc means have
more nodes than the estimators'.
"""

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest

from meshskin.contact import ContactModel
from meshskin.contact.disc import disc_mean
from meshskin.contact.material import Material
from meshskin.contact.problem import effective_modulus
from meshskin.estimation.joint.contacts import LinearizedContacts
from meshskin.estimation.joint.likelihood import Likelihood
from meshskin.estimation.joint.readings import Readings
from meshskin.geometry.primitives import Sphere
from meshskin.recording.recording import CONTACT_SCHEMA, READING_SCHEMA, Recording

RADIUS, INDENTER, DISC, YOUNG, POISSON, FORCE = 0.1, 0.01, 2e-3, 0.2e6, 0.49, 3.0


@dataclass
class World:
    """Taxels on a hexagonal lattice at the bottom, contacts on parallel lanes over them."""

    spacing: float = 5e-3
    extent: float = 25e-3
    lane: float = 3.5e-3
    step: float = 0.5e-3
    young: float = YOUNG
    body: object = field(default_factory=lambda: Sphere(RADIUS))
    model: ContactModel = field(default_factory=ContactModel)
    spread: float = 0.01
    """Of the forces."""

    def __post_init__(self):
        n = int(self.extent / self.spacing) + 2
        i, j = np.meshgrid(np.arange(-n, n + 1), np.arange(-n, n + 1))
        flat = np.stack([i + j / 2, j * np.sqrt(3) / 2], -1).reshape(-1, 2) * self.spacing
        flat = flat[np.linalg.norm(flat, axis=1) < self.extent]
        self.truth = self.body.closest(self.raise_(flat + 0.1e-3)).point
        self.ids = 100 + np.arange(len(flat))
        u = np.arange(-self.extent - 4e-3, self.extent + 4e-3, self.step)
        v = np.arange(-self.extent - 4e-3, self.extent + 4e-3, self.lane)
        hit = self.body.closest(self.raise_(np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)))
        self.points, self.normals = hit.point, hit.normal
        self.directions = hit.direction
        self.force = FORCE * (1 + self.spread * np.sin(np.arange(len(self.points))))
        self.modulus = effective_modulus(self.young, POISSON)
        self.patches = self.model.patches(
            force=self.force,
            curvature=hit.curvature,
            indenter_radius=INDENTER,
            effective_modulus=self.modulus,
        )
        self.a = np.maximum(self.patches.first, self.patches.second)
        self.peak = self.patches.peak
        self.peak_reference = float(np.median(self.peak))

    @staticmethod
    def raise_(flat):
        """Points of the sphere's bottom over flat coordinates, by equal arc length."""
        angle = np.linalg.norm(flat, axis=1) / RADIUS
        ring = flat / np.maximum(np.linalg.norm(flat, axis=1), 1e-12)[:, None]
        return RADIUS * np.column_stack([np.sin(angle)[:, None] * ring, -np.cos(angle)])

    @property
    def skin(self):
        """The true skin, as metrics want it."""
        return SimpleNamespace(ids=self.ids, positions=self.truth)

    def pressures(self):
        """Exact pressures (contacts, taxels)."""
        offset = self.truth[None] - self.points[:, None]
        along = np.einsum("mnk,mk->mn", offset, self.normals)
        r = np.sqrt(np.maximum(np.sum(offset**2, -1) - along**2, 0))
        out = np.zeros_like(r)
        near = (r < 1.3 * (self.a[:, None] + DISC)) & (np.linalg.norm(offset, axis=2) < 0.02)
        row = np.nonzero(near)[0]
        if self.model.name != "hertz":
            sides = np.stack([self.directions, np.cross(self.normals, self.directions)])
            x, y = (np.einsum("kj,kj->k", offset[near], side[row]) for side in sides)
            out[near] = np.maximum(self.patches.take(row).reading(x, y, DISC, nodes=150), 0.0)
            return out
        out[near] = self.peak[row] * disc_mean(r[near] / self.a[row], DISC / self.a[row], nodes=24)
        return out

    def record(self, sigma=0.0, threshold=0.0, seed=0):
        """A recording with noise and threshold relative to the peak; both may be zero."""
        p = self.pressures()
        if sigma:
            p += sigma * self.peak_reference * np.random.default_rng(seed).normal(size=p.shape)
        contact, taxel = np.nonzero(p > threshold * self.peak_reference)
        time = 0.01 * np.arange(len(self.points))
        columns = [time, *self.points.T, *self.normals.T, self.force]
        readings = [time[contact], self.ids[taxel].astype(np.int32), p[contact, taxel]]
        return Recording(
            pa.table(columns, schema=CONTACT_SCHEMA),
            pa.table(readings, schema=READING_SCHEMA),
            {"taxel_ids": self.ids.tolist(), "disc_radius_m": DISC},
        )

    def belief(self, sigma=None, threshold=0.0, young=YOUNG, **changes):
        """What the owner of this world knows."""
        fields = {
            "body": self.body,
            "readings": "pressure",
            "indenter": SimpleNamespace(radius=INDENTER),
            "material": Material(young=young, poisson=POISSON, thickness=self.model.thickness),
            "contact": self.model.name,
            "taxel_ids": self.ids,
            "disc_radius": DISC,
            "force_reference": FORCE,
            "noise_sigma": None if sigma is None else sigma * self.peak_reference,
            "threshold": threshold * self.peak_reference,
            "saturation": None,
            "unknown": ("modulus",),
            "priors": {},
            "contact_motion": None,
            "surface_sigma": 0.0,
            "headings": None,
            "module_slots": None,
            "response_groups": (),
        }
        return SimpleNamespace(**fields | changes)


@pytest.fixture(scope="session")
def world():
    """Some 40 taxels on the paper's sphere, and lanes of contacts over them."""
    return World(extent=17e-3)


def changed(recording, **columns):
    """The recording with other columns of readings, or only those rows where `keep` is true."""
    table = recording.readings
    for name, values in columns.items():
        if name == "keep":
            table = table.filter(pa.array(values))
        else:
            column = pa.array(np.asarray(values, dtype=table.column(name).to_numpy().dtype))
            table = table.set_column(table.column_names.index(name), name, column)
    return Recording(recording.contacts, table, recording.metadata)


@pytest.fixture(scope="session")
def change():
    """`changed`, for the tests."""
    return changed


@pytest.fixture(scope="session")
def derivative_holds():
    """Asserts one column of the prediction's Jacobian against a central difference.

    At a random place about the truth; columns: position (3), ln gain, offset, shared unknowns.
    """

    def check(world, case, column):
        data, contact, taxel = case
        model = Likelihood(data, Readings.none())
        scale = np.concatenate([np.full(3, 1e-3), [0.1, 1.0], 0.1 * data.parameters.sigma])
        rng = np.random.default_rng(column)
        about = 0.3 * scale * rng.normal(size=len(scale))
        fixed = LinearizedContacts(data, about[5:])

        def predict(x):
            points = world.truth[taxel] + x[:3]
            extras = np.broadcast_to(x[3:5], (len(taxel), 2))
            return model.predict(contact, points, extras, fixed.at(x[5:]))

        step = 1e-4 * scale[column] * np.eye(len(scale))[column]
        jacobian = predict(about)[1][column]
        numeric = (predict(about + step)[0] - predict(about - step)[0]) / (2 * step[column])
        assert np.abs(jacobian).max() > 0
        assert np.allclose(jacobian, numeric, atol=5e-3 * np.abs(numeric).max())

    return check
