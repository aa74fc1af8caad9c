"""The calibration linearised: how far one Gauss-Newton step moves the taxels.

At a solution the gradient of the likelihood is zero. Readings (or contacts) that differ give it
another gradient g there, and

    shift = -H^-1 g,   H = J^T W J,

over all taxels and what they share, is where the estimate goes, to first order in the difference.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...core.se3 import Array
from ...estimation import chart
from ...estimation.data.measurements import gather
from ...estimation.joint import fault_detection
from ...estimation.joint.joint_estimator import JointEstimator
from ...estimation.joint.parametrization import SurfaceParametrization

if TYPE_CHECKING:
    from ...recording.recording import Recording
    from ...scene.belief import Belief
    from ...scene.scene import Scene


FAR = 5e-3
"""m; a taxel that solves further from where it is has not been told by its readings."""
STEPS = 12
"""Most Gauss-Newton steps to a solution."""
AT_REST = 1e-7
"""Step, m, of the taxels at which a solution is found."""


@dataclass(frozen=True)
class Step:
    """A Gauss-Newton step of n taxels and what they share."""

    move: Array
    """(n, 3), m; NaN for a taxel that is not determined."""
    shared: Array
    """(ks,)."""


@dataclass(frozen=True)
class Solution:
    """Where the calibration is linearised: n taxels and what they share."""

    points: Array
    """(n, 3), body frame, m; NaN for a taxel that is not determined."""
    shared: Array
    """The shared unknowns (ks,), in the order of the belief's."""

    @classmethod
    def true(cls, scene: Scene) -> Solution:
        """Where the calibration of a scene without effects ends, but for rounding."""
        return cls(np.asarray(scene.skin.positions), np.zeros(1))

    def solved(self, recording: Recording, belief: Belief) -> Solution:
        """The solution for a recording, by steps from this one; no reading is doubted.

        A taxel that moves by more than it reaches is none that the readings determine.
        """
        found = self
        for _ in range(STEPS):
            step = found.step(recording, belief)
            found = Solution(found.points + step.move, found.shared + step.shared)
            away = np.linalg.norm(found.points - self.points, axis=1) > FAR
            found.points[away] = np.nan
            if not np.nanmax(np.abs(step.move), initial=0.0) > AT_REST:
                break
        return found

    def step(self, recording: Recording, belief: Belief) -> Step:
        """The Gauss-Newton step on a recording.

        The belief declares no unknowns of single taxels and no rigid modules. Raises as `gather`.
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
        return Step(move, shared)


def determined_taxels(recording: Recording, belief: Belief) -> np.ndarray:
    """Which taxels (n,) have readings that determine their position: read, and not stuck."""
    data = gather(recording, belief)
    out = np.asarray(data.counts > 0)
    out[fault_detection.stuck_taxels(data).rows] = False
    return out
