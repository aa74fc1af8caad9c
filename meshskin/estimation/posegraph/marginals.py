"""Marginal covariances: the diagonal blocks of an inverse, without the rest of it.

The information matrix is factored by fronts; then the inverse is built from the last front to the
first, each needing only its parent's. That costs about as much as two factorisations, where solving
column by column costs n times a solve.

Source: Takahashi, Fagan, Chen, "Formation of a sparse bus impedance matrix" (1973).
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from ...core.se3 import Array
from .cholesky import Blocks, Cholesky, SingularError

BLOCK = 6
"""Degrees of freedom of a pose."""
SINGULAR = 1e-13
"""A pivot below this share of its diagonal entry is zero up to rounding."""
PRIOR = 1e-10
"""Information added where the matrix is singular, as a share of the diagonal."""
UNSEEN = 1e-2
"""A variance above this share of the prior's comes from the prior: nothing was seen."""


def marginals(information: sparse.csr_array) -> Array:
    """Covariances (n, 6, 6) of the poses whose joint `information` is (6 n, 6 n), symmetric.

    Degrees of freedom that it does not determine get an infinite variance and no covariance.
    """
    blocks = lower_blocks(sparse.csr_array(sparse.tril(information)))
    cholesky = Cholesky(information.shape[0] // BLOCK, blocks.rows, blocks.columns)
    return covariances(cholesky, blocks)


def lower_blocks(lower: sparse.csr_array) -> Blocks:
    """The blocks of a symmetric matrix (6 n, 6 n), given its lower triangle."""
    blocks = sparse.bsr_array(lower, blocksize=(BLOCK, BLOCK))
    rows = np.repeat(np.arange(len(blocks.indptr) - 1), np.diff(blocks.indptr))
    return Blocks(rows, blocks.indices, blocks.data)


def covariances(cholesky: Cholesky, information: Blocks) -> Array:
    """As `marginals`, by the fronts of its pattern."""
    try:
        return cholesky.diagonal_of_inverse(information, SINGULAR)
    except SingularError:
        typical = information.diagonal(cholesky.nodes).max(axis=0)
        prior = PRIOR * np.where(typical > 0, typical, 1.0)
        added = np.broadcast_to(np.diag(prior), (cholesky.nodes, BLOCK, BLOCK))
        blocks = cholesky.diagonal_of_inverse(information.and_diagonal(added), SINGULAR)
    variance = np.diagonal(blocks, axis1=1, axis2=2)
    unseen = variance * prior > UNSEEN
    blocks[unseen[:, :, None] | unseen[:, None, :]] = 0.0
    pose, freedom = np.nonzero(unseen)
    blocks[pose, freedom, freedom] = np.inf
    return blocks
