"""The region that lanes are to cover, and the samples of the lanes so far."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array, Index
from ..geometry.surface.closest_point import Closest


class PointCloud:
    """A set of points that grows, with distances to the nearest of them.

    The points are in trees of growing sizes, so that adding all of n points costs n log(n)^2 in
    total. Source: Bentley and Saxe, "Decomposable searching problems", J. Algorithms 1 (1980).
    """

    def __init__(self, points: Array | None = None) -> None:
        self._trees: list[Any] = []
        if points is not None:
            self.add(points)

    def add(self, points: Array) -> None:
        """Add points (k, 3)."""
        from scipy.spatial import cKDTree

        if not len(points):
            return
        while self._trees and self._trees[-1].n <= 2 * len(points):
            points = np.concatenate([self._trees.pop().data, points])
        self._trees.append(cKDTree(points, balanced_tree=False, compact_nodes=False))

    def distance(self, points: Array, most: float = np.inf) -> Array:
        """Distances (k,) of points (k, 3) to the nearest point; inf beyond `most`."""
        out = np.full(len(points), np.inf)
        for tree in self._trees:
            out = np.minimum(out, tree.query(points, distance_upper_bound=most)[0])
        return out

    def pairs(self, distance: float) -> Index:
        """Pairs (k, 2), the smaller row first, of points at most `distance` apart.

        Rows are those of points that were added at once.
        """
        (tree,) = self._trees
        return np.asarray(tree.query_pairs(distance, output_type="ndarray"), dtype=np.intp)


class Coverage:
    """The region that is to be covered, and the lanes so far."""

    def __init__(self, sites: Array, radius: float, duplicate: float) -> None:
        """The region is within `radius`, m, of the sites (n, 3); samples of lanes less than
        `duplicate`, m, from earlier ones are duplicates.
        """
        self._sites, self._radius, self._duplicate = PointCloud(sites), radius, duplicate
        self.width = float(np.linalg.norm(np.ptp(sites, axis=0))) + 2.0 * radius
        """Diagonal of the region's bounding box, m."""
        self.samples = PointCloud()
        """Samples of the lanes so far."""

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Which points (k, 3) are in the region."""
        return self._sites.distance(points) <= self._radius

    def lacks(self, points: Array) -> NDArray[np.bool_]:
        """Which points (k, 3) are in the region and on none of the lanes so far."""
        return self.contains(points) & (
            self.samples.distance(points, 2.0 * self._duplicate) > self._duplicate
        )

    def add(self, lane: list[Closest], step: float) -> list[NDArray[np.bool_]]:
        """Add a lane; which samples of its chains are in the region and not covered before."""
        if not lane:
            return []
        points = np.concatenate([chain.point for chain in lane])
        new = self.lacks(points)
        # of a lane that returns to itself the earlier samples count
        pairs = PointCloud(points).pairs(self._duplicate)
        back = pairs[pairs[:, 1] - pairs[:, 0] > 3.0 * self._duplicate / step]
        for early, late in back[np.argsort(back[:, 0], kind="stable")]:
            if new[early]:
                new[late] = False
        self.samples.add(points[new])
        return np.split(new, np.cumsum([len(chain.point) for chain in lane])[:-1])
