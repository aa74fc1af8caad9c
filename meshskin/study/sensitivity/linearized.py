"""The linearised calibration: the shift of the taxels by one Gauss-Newton step.

At a solution the gradient of the negative log likelihood is zero. For other readings (or contacts)
it is g there, and the estimate moves, to first order in their difference, by

    shift = -H^-1 g,   H = J^T W J,

over all taxels and the unknowns that they share.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...core.arrays import Array
from ...estimation import chart
from ...estimation.data.measurements import gather
from ...estimation.joint import fault_detection
from ...estimation.joint.joint_estimator import JointEstimator
from ...estimation.joint.parametrization import SurfaceParametrization

if TYPE_CHECKING:
    from ...recording.recording import Recording
    from ...scene.belief import Belief
    from ...scene.scene import Scene


MAX_DISTANCE = 5e-3
"""Distance, m, from its start beyond which a taxel counts as not determined: about the range in
which it responds to a contact."""
MAX_STEPS = 12
"""Most Gauss-Newton steps to a solution."""
STEP_TOLERANCE = 1e-7
"""Step, m, of the taxels below which a solution is found: far below any budget."""


@dataclass(frozen=True)
class Solution:
    """The point at which the calibration is linearised: n taxels and ks shared unknowns."""

    points: Array
    """Positions (n, 3), body frame, m; NaN for a taxel that is not determined."""
    shared: Array
    """Shared unknowns (ks,), in the order of the belief's."""

    @classmethod
    def true(cls, scene: Scene) -> Solution:
        """The true positions: the solution for a scene without effects."""
        return cls(np.asarray(scene.skin.positions), np.zeros(1))

    def solved(self, recording: Recording, belief: Belief) -> Solution:
        """The solution for a recording, by steps from this one, without outlier rejection.

        A taxel that moves by more than MAX_DISTANCE is not determined.
        """
        found = self
        for _ in range(MAX_STEPS):
            move, shared = found.step(recording, belief)
            found = Solution(found.points + move, found.shared + shared)
            away = np.linalg.norm(found.points - self.points, axis=1) > MAX_DISTANCE
            found.points[away] = np.nan
            if not np.nanmax(np.abs(move), initial=0.0) > STEP_TOLERANCE:
                break
        return found

    def step(self, recording: Recording, belief: Belief) -> tuple[Array, Array]:
        """The Gauss-Newton step for a recording: moves (n, 3), m, and shared unknowns (ks,).

        A taxel that is not determined moves by NaN. The belief must declare no unknowns of single
        taxels and no rigid modules. Raises as `gather`.
        """
        data = gather(recording, belief)
        live = np.flatnonzero(np.isfinite(self.points[:, 0]) & (data.counts > 0))
        charts = chart.charts_at(belief.body, self.points[live])
        stuck = np.isin(data.taxel, fault_detection.stuck_taxels(data).rows)
        places = SurfaceParametrization(charts, step=float(np.median(data.radii)))
        run = JointEstimator(data, live, places, np.where(stuck, 0.0, 1.0), iterations=1)
        run.relinearize(places, self.shared, select_anew=True)
        problem, state = run.problem, run.state
        blocks, left = problem.blocks(state), problem.reduce(state)
        shared = np.asarray(-np.linalg.solve(left.hessian, left.gradient), dtype=float)
        gradient = blocks.gradient + blocks.coupling @ shared
        local = -np.linalg.solve(blocks.hessian, gradient[:, :, None])[:, :2, 0]
        local = places.limit_step(np.asarray(local, dtype=float))
        move = np.full_like(self.points, np.nan)
        move[live] = np.einsum("nij,nj->ni", charts.tangents, local)
        return move, shared


def determined_taxels(recording: Recording, belief: Belief) -> np.ndarray:
    """Which taxels (n,) have readings that determine their position: read, and not stuck."""
    data = gather(recording, belief)
    out = np.asarray(data.counts > 0)
    out[fault_detection.stuck_taxels(data).rows] = False
    return out
