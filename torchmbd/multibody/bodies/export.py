"""Assembled matrices of a body for other programs: all six freedoms of all nodes, without supports.

Checked in tests/multibody/bodies/test_from_matrices.py.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import scipy.io
import scipy.sparse
import torch

from torchmbd.errors import InputError
from torchmbd.fem.elements import Assembly
from torchmbd.math.sparse import SparseMatrix
from torchmbd.multibody.bodies.reduced import matrices


def assembled(body: Any) -> tuple[Any, Any]:
    """M and K [6 n, 6 n] of the present design, rows 6 * node + i. InputError for bodies without matrices of their nodes."""
    with torch.no_grad():
        if body.given_structure is not None:
            if not hasattr(body.given_structure, "matrices"):
                raise InputError(f"{body.name!r} was reduced elsewhere; allowed: a body of elements or matrices")
            M, K = body.given_structure.matrices.now()
        else:
            if not body.assembly.freedoms.plain:
                raise InputError(f"nodes of {body.name!r} are linked; allowed: a body without links, or save_reduced")
            K, M = matrices(Assembly(body.mesh, body.assembly.parts))
    if K.values.dim() > 1:
        raise InputError(f"{body.name!r} has {K.values.shape[0]} designs at once; allowed: one")
    mass = M.pattern.to_scipy(M.values) if isinstance(M, SparseMatrix) else scipy.sparse.diags_array(M.numpy())
    return scipy.sparse.csr_array(mass), scipy.sparse.csr_array(K.pattern.to_scipy(K.values))


def save_matrices(body: Any, path: str | Path) -> tuple[Path, Path]:
    """Write path_M.mtx and path_K.mtx, and return these paths."""
    files = Path(f"{path}_M.mtx"), Path(f"{path}_K.mtx")
    for file, matrix in zip(files, assembled(body), strict=True):
        with file.open("wb") as handle:
            scipy.io.mmwrite(handle, scipy.sparse.coo_array(matrix), precision=17, symmetry="symmetric")
    return files
