"""Marginal covariances: the diagonal blocks of the inverse of an information matrix.

The selected inverse of a multifrontal factorization costs about as much as two factorizations,
where solving column by column costs one solve per degree of freedom.

Source: Takahashi, Fagan, Chen, "Formation of a sparse bus impedance matrix" (1973).
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from ...core.arrays import Array
from .cholesky import Cholesky
from .superlu import SingularMatrixError
from .symmetric_blocks import SymmetricBlocks

BLOCK = 6
"""Degrees of freedom of a pose."""
MIN_PIVOT = 1e-13
"""A pivot below this share of its diagonal entry is zero up to rounding: the error of a pivot is
about the number of updates times 1e-16 of the entry."""
PRIOR = 1e-10
"""Information of the prior added to a singular matrix, as a share of its largest diagonal entries:
far above rounding (1e-16) and far below what data determine."""
UNDETERMINED = 1e-2
"""A variance above this share of the prior's variance is that of the prior: a degree of freedom is
determined if its information is above PRIOR / UNDETERMINED = 1e-8 of the largest."""


def marginals(information: sparse.csr_array) -> Array:
    """Covariances (n, 6, 6) of the poses whose joint `information` is (6 n, 6 n), symmetric.

    Degrees of freedom that it does not determine have infinite variance and no covariance.
    """
    lower = sparse.csr_array(sparse.tril(information))
    blocks = SymmetricBlocks.from_lower_triangle(lower, BLOCK)
    cholesky = Cholesky(information.shape[0] // BLOCK, blocks.rows, blocks.columns)
    return covariances(cholesky, blocks)


def covariances(cholesky: Cholesky, information: SymmetricBlocks) -> Array:
    """Covariances (n, 6, 6) of the poses with joint `information` of the pattern of `cholesky`.

    Degrees of freedom that it does not determine have infinite variance and no covariance.
    """
    try:
        return cholesky.diagonal_of_inverse(information, MIN_PIVOT)
    except SingularMatrixError:
        typical = information.diagonal(cholesky.nodes).max(axis=0)
        prior = PRIOR * np.where(typical > 0, typical, 1.0)
        added = np.broadcast_to(np.diag(prior), (cholesky.nodes, BLOCK, BLOCK))
        blocks = cholesky.diagonal_of_inverse(information.add_diagonal(added), MIN_PIVOT)
    variance = np.diagonal(blocks, axis1=1, axis2=2)
    undetermined = variance * prior > UNDETERMINED
    blocks[undetermined[:, :, None] | undetermined[:, None, :]] = 0.0
    pose, freedom = np.nonzero(undetermined)
    blocks[pose, freedom, freedom] = np.inf
    return blocks
