"""What depends on a graph's edges alone, and is kept: elimination, NLP, IPOPT's memory."""

from __future__ import annotations

import functools
import hashlib
import threading
from collections import OrderedDict

import numpy as np

from .cholesky import Cholesky
from .ordering import Integers
from .problem import PoseGraphProblem


class Topology:
    """Edges (m, 2) between `poses`, of which `anchors` are held."""

    def __init__(self, poses: int, edges: Integers, anchors: Integers) -> None:
        self.poses, self.edges, self.anchors = poses, edges, anchors
        self._lock = threading.Lock()
        self._problems: dict[str, PoseGraphProblem] = {}

    @functools.cached_property
    def cholesky(self) -> Cholesky:
        """Of matrices with a block for every pose and every edge."""
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
    """The topologies met last, at most `edges` edges in all."""

    def __init__(self, edges: int) -> None:
        self._limit, self._lock = edges, threading.Lock()
        self._topologies: OrderedDict[bytes, Topology] = OrderedDict()

    def get(self, poses: int, edges: Integers, anchors: Integers) -> Topology:
        """Their topology, made or known from before; the anchors follow from the edges."""
        named = hashlib.blake2b(f"{poses} ".encode())
        named.update(np.ascontiguousarray(edges, dtype=np.int64).tobytes())
        key = named.digest()
        with self._lock:
            if key not in self._topologies:
                self._topologies[key] = Topology(poses, edges, anchors)
            self._topologies.move_to_end(key)
            while sum(len(t.edges) for t in self._topologies.values()) > self._limit:
                if len(self._topologies) == 1:
                    break
                self._topologies.popitem(last=False)
            return self._topologies[key]


kept = TopologyCache(edges=400_000)
