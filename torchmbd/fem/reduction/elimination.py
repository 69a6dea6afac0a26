"""The factorization of positive definite matrices by the cheaper of two methods: dense blocks of a band, or a sparse factor.

Blocks (blocks.py) suit many designs of a slender body: their solves run for all lanes at once in compiled code. A wide body has
wide blocks, of which blocks store N b numbers and use N b^2 products; a sparse factor (sparse_factor.py) has about N log N
entries. `layout` compares the seconds of one reduction, a factorization and COLUMNS solves, by the rates below.
Modes and their derivatives agree to 1e-9.
Modes, static loads and stiffening of one design factorize equal numbers on one layout; `factorize` does it once (latest.py).
Checked in tests/fem/reduction/test_sparse_factor.py.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from torchmbd.fem.reduction.blocks import BlockFactor, BlockRoot, DiagonalRoot, mass_root, storage
from torchmbd.fem.reduction.forms import (
    NO_INERTIA,
    Dense,
    Diagonal,
    Form,
    Indefinite,
    IndefiniteLane,
    Sparse,
    lane_name,
)
from torchmbd.fem.reduction.latest import Latest
from torchmbd.fem.reduction.partition import Partition, partition
from torchmbd.fem.reduction.shift import SAFE_PIVOT, choose_shift
from torchmbd.fem.reduction.sparse_factor import SparseFactor, SparseLayout, SparseRoot, solves_columns_together
from torchmbd.math.sparse import Pattern

Layout = Partition | SparseLayout
Factor = BlockFactor | SparseFactor
Root = DiagonalRoot | BlockRoot | SparseRoot

COLUMNS = 150  # of a reduction: 10 to 15 steps of 8 columns, and some solves for derivatives
BLOCK_CUBE, BLOCK_ENTRY = 0.6e-9, 0.5e-9  # seconds for each b^3 of a factorization, each entry and column of a solve
# Seconds for each entry of L of a factorization; each entry and column of a solve with the operators of torch around it: where
# compiled code solves for several columns together, and where a library solves for one after another.
FILL, FILL_ENTRY = 85e-9, 0.8e-9
FILL_APART, FILL_ENTRY_APART = 40e-9, 4e-9
HALVINGS, ITERATIONS = 8, 20  # of the search for the row that moves most, once for an error
CALLS = 0.05  # seconds: operations of torch between solves, which compiled code does not need for blocks


def layout(K_form: Form, M_form: Form) -> Layout:
    """Return the cheaper layout for K - sigma M."""
    blocks = partition(K_form, M_form)
    patterns = tuple(dict.fromkeys(form.pattern for form in (K_form, M_form) if isinstance(form, Sparse)))
    if not patterns or isinstance(K_form, Dense) or isinstance(M_form, Dense):
        return blocks
    return blocks if seconds_of_blocks(blocks) <= seconds_of_fill(*patterns) else _sparse_layout(patterns)


def seconds_of_blocks(blocks: Partition) -> float:
    """Predict the seconds of one reduction by blocks."""
    size = np.array(blocks.sizes, dtype=float)
    coupling = size[1:] * size[:-1]
    products = (size**3).sum()
    return BLOCK_CUBE * products + COLUMNS * BLOCK_ENTRY * ((size**2).sum() + 2.0 * coupling.sum())


def seconds_of_fill(*patterns: Pattern) -> float:
    """Predict the seconds of one reduction by a sparse factor.

    On plates and boxes of 10,000 to 120,000 degrees of freedom, L has (log2 N - 9) nnz / 2 entries within a fifth.
    """
    nnz, size = max(p.nnz for p in patterns), patterns[0].size
    fill = 0.5 * nnz * max(np.log2(size) - 9.0, 1.0)
    together = solves_columns_together()
    factor, entry = (FILL, FILL_ENTRY) if together else (FILL_APART, FILL_ENTRY_APART)
    return CALLS + (factor + COLUMNS * entry) * fill


@lru_cache(maxsize=16)
def _sparse_layout(patterns: tuple[Pattern, ...]) -> SparseLayout:
    size = patterns[0].size
    diagonal = torch.arange(size)
    if len(patterns) == 1 and len(patterns[0].diagonal) == size:
        return SparseLayout(patterns[0])
    rows, cols = (torch.cat([*(getattr(p, name) for p in patterns), diagonal]) for name in ("rows", "cols"))
    return SparseLayout(Pattern.gather(rows, cols, size)[0])


def factorize(
    layout: Layout,
    K_form: Form,
    K: Tensor,
    M_form: Form | None = None,
    M: Tensor | None = None,
    shift: Tensor | None = None,
) -> Factor:
    """Factorize K - shift M of values [lane, *entry] and shift [lane]."""
    if M_form is not None and M is not None and shift is not None and shift.any():
        return _shifted(layout, K_form, K, M_form, M, shift)
    return _latest((layout, K_form), (K,), lambda: _factorized(layout, K_form, K))


_latest: Latest[Factor] = Latest()


def _factorized(layout: Layout, K_form: Form, K: Tensor) -> Factor:
    if isinstance(layout, Partition):
        return BlockFactor(layout, storage(layout, K_form, K))
    return SparseFactor(layout, layout.values(K_form, K))


def _shifted(layout: Layout, K_form: Form, K: Tensor, M_form: Form, M: Tensor, shift: Tensor) -> Factor:
    if isinstance(layout, Partition):
        flat = storage(layout, K_form, K) - shift[:, None] * storage(layout, M_form, M)
        return BlockFactor(layout, flat)
    values = layout.values(K_form, K) - shift[:, None] * layout.values(M_form, M)
    return SparseFactor(layout, values)


def root(layout: Layout, form: Form, values: Tensor) -> Root:
    """Factorize M = G G'. Raises Indefinite where it is not positive definite."""
    try:
        if isinstance(layout, Partition):
            return mass_root(layout, form, values)
        if isinstance(form, Diagonal):
            return DiagonalRoot(layout.order, values)
        return SparseRoot(layout, layout.values(form, values))
    except IndefiniteLane as error:
        row = _loosest(layout, form, values[error.lane : error.lane + 1])
        raise Indefinite("M", lane_name(error.lane, len(values)), NO_INERTIA, row) from None


def _loosest(layout: Layout, form: Form, A: Tensor) -> int:
    """The row of A [1, *entry] that moves most in its lowest mode, by inverse iteration with a shift just below this mode."""
    like, ones = Diagonal(form.size), torch.ones(1, form.size, dtype=torch.float64)

    def shifted(shift: Tensor) -> tuple[Factor, Tensor]:
        factor = _shifted(layout, form, A, like, ones, shift)
        return factor, factor.pivot

    below, factor = choose_shift(form.diagonal(A), ones, shifted)
    above = torch.zeros_like(below)
    for _ in range(HALVINGS):
        middle = 0.5 * (below + above)
        nearer, pivot = shifted(middle)
        if pivot[0] > SAFE_PIVOT:
            below, factor = middle, nearer
        else:
            above = middle
    X = torch.from_numpy(np.random.default_rng(1).standard_normal((1, form.size, 1)))
    for _ in range(ITERATIONS):
        X = factor.solve(X / X.norm())
    return int(layout.order[X[0, :, 0].abs().argmax()])


class Solver:
    """A^-1 of symmetric positive definite matrices of one form, after `factorize`.

    freedoms   the numbers of its rows, for errors; None: 0, 1, ...
    """

    factor: Factor

    def __init__(self, form: Form, rows: Layout | None = None, freedoms: Tensor | None = None) -> None:
        self.form, self.layout, self._freedoms = form, rows or layout(form, Diagonal(form.size)), freedoms

    def factorize(self, values: Tensor, fault: str) -> None:
        """Factorize A of values [lane, *entry]; Indefinite says its lane and `fault` where it is not definite."""
        self.factor = factorize(self.layout, self.form, values)
        weak = self.factor.pivot <= SAFE_PIVOT
        if weak.any():
            lane = int(weak.nonzero()[0])
            row = _loosest(self.layout, self.form, values[lane : lane + 1])
            row = row if self._freedoms is None else int(self._freedoms[row])
            fault = f"{fault} without stiffness, or against it"
            raise Indefinite("K", lane_name(lane, len(values)), fault, row)

    def solve(self, F: Tensor) -> Tensor:
        """A^-1 F for columns F [lane, T, N, k]."""
        lanes, T, N, k = F.shape
        flat = F.movedim(1, 2).reshape(lanes, N, T * k).index_select(1, self.layout.order)
        solved = self.factor.solve(flat).index_select(1, self.layout.inverse)
        return solved.reshape(lanes, N, T, k).movedim(2, 1)
