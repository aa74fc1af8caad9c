"""What depends on the edges of a graph alone, kept for all graphs with the same edges."""

from __future__ import annotations

import functools
import hashlib
import threading
from collections import OrderedDict

import numpy as np

from .cholesky import Cholesky
from .ordering import IntArray
from .problem import PoseGraphProblem


class Topology:
    """Edges (m, 2) between `poses` poses, of which `anchors` are fixed."""

    def __init__(self, poses: int, edges: IntArray, anchors: IntArray) -> None:
        self.poses, self.edges, self.anchors = poses, edges, anchors
        self._lock = threading.Lock()
        self._problems: dict[str, PoseGraphProblem] = {}

    @functools.cached_property
    def cholesky(self) -> Cholesky:
        """Factorizations of matrices with a block for every pose and every edge."""
        return Cholesky(self.poses, *self.edges.T)

    def problem(self, residual: str) -> PoseGraphProblem:
        """The NLP with the kernel's `residual` "log" or "vec", built when first asked for."""
        with self._lock:
            if residual not in self._problems:
                self._problems[residual] = PoseGraphProblem(
                    self.edges, self.anchors, residual, self.cholesky
                )
            return self._problems[residual]


class TopologyCache:
    """The most recently used topologies, at most `edges` edges in all."""

    def __init__(self, edges: int) -> None:
        self._limit, self._lock = edges, threading.Lock()
        self._topologies: OrderedDict[bytes, Topology] = OrderedDict()

    def get(self, poses: int, edges: IntArray, anchors: IntArray) -> Topology:
        """The topology of these edges, new or from the cache; the anchors follow from the edges."""
        digest = hashlib.blake2b(f"{poses} ".encode())
        digest.update(np.ascontiguousarray(edges, dtype=np.int64).tobytes())
        key = digest.digest()
        with self._lock:
            if key not in self._topologies:
                self._topologies[key] = Topology(poses, edges, anchors)
            self._topologies.move_to_end(key)
            while sum(len(t.edges) for t in self._topologies.values()) > self._limit:
                if len(self._topologies) == 1:
                    break
                self._topologies.popitem(last=False)
            return self._topologies[key]


topology_cache = TopologyCache(edges=400_000)
"""The cache of the process. An edge takes up to 15 kB after solving with both residuals (torus3D),
mostly in IPOPT, so that the limit is about 6 GB."""
