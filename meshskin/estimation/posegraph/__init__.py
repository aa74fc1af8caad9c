"""Pose graphs: poses from measured displacements, as an NLP in CasADi, solved by IPOPT."""

from .graph import PoseGraph

__all__ = ["PoseGraph"]
