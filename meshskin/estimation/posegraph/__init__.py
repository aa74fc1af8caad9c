"""Pose graphs: poses from measured displacements, as an NLP in CasADi, solved by IPOPT."""

from meshskin.estimation.posegraph.graph import PoseGraph

__all__ = ["PoseGraph"]
