"""The warping problem E u = f, E = integral of B' D B, solved by a sparse factorization, and its derivatives.

The kernel of E consists of the section's translations and its rotation about x. Forces of warping are in equilibrium to
rounding, because every element represents a rigid motion exactly; so these four motions are held at two nodes without
reactions, and stress and energy do not depend on the choice of nodes. Derivatives, for a change dE of the elements' stiffness:

    E du = df - dE u                forward
    f~ = E^-1 u~,  E~ = - f~ u'     reverse (of the nodes of each element)

All directions share one factorization per design. Differentiable once, forward and reverse, under vmap and jacfwd.
Checked in tests/fem/sections/test_section_gradients.py.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import bsr_array, csc_array
from scipy.sparse.linalg import SuperLU, splu
from torch import Tensor

from torchmbd.errors import SimulationFailure
from torchmbd.fem.sections.geometry import SectionGeometry
from torchmbd.math.vmap import FirstDerivative, batch_first


class WarpingProblem:
    """E of one mesh: the positions of its entries, found once; the factors and the results of the last designs."""

    def __init__(self, geometry: SectionGeometry, yz: Float[Tensor, "n 2"]) -> None:
        self.geometry = geometry
        n, nodes = geometry.nodes, geometry.connectivity
        pair = (nodes[:, :, None] * n + nodes[:, None, :]).flatten()
        unique, position = torch.unique(pair, return_inverse=True)
        self.blocks, self.position = len(unique), position
        indptr = np.concatenate([[0], np.cumsum(np.bincount(unique // n, minlength=n))])
        order = np.arange(9 * self.blocks, dtype=np.float64).reshape(-1, 3, 3)
        csc = bsr_array((order, unique % n, indptr), shape=(3 * n, 3 * n)).tocsc()
        self._order, self._indices, self._indptr = csc.data.astype(np.int64), csc.indices, csc.indptr
        held = np.zeros(3 * n, dtype=bool)
        held[_held_freedoms(yz)] = True
        cols = np.repeat(np.arange(3 * n), np.diff(csc.indptr))
        self._diagonal = np.flatnonzero((csc.indices == cols) & held[cols])
        self._removed = np.flatnonzero(held[csc.indices] | held[cols])
        self.held = torch.from_numpy(np.flatnonzero(held))
        self._factors: tuple[Tensor, list[SuperLU]] | None = None
        self._results: dict[str, tuple[Tensor, Tensor]] = {}

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_factors": None, "_results": {}}  # these do not travel between processes

    def result(self, name: str, designs: Tensor, of: Callable[[], Tensor]) -> Tensor:
        """Return of(), a function of the designs; that of the last ones is kept, for all rows of a gradient."""
        known = self._results.get(name)
        if known is None or not torch.equal(known[0], designs):
            known = self._results[name] = (designs, of())
        return known[1]

    def matrix(self, element: Float[Tensor, "m 3k 3k"]) -> csc_array:
        """Return E of one design, with the identity in the rows and columns of held degrees of freedom."""
        k = element.shape[-1] // 3
        blocks = element.reshape(-1, k, 3, k, 3).transpose(2, 3).reshape(-1, 3, 3)
        data = element.new_zeros(self.blocks, 3, 3).index_add_(0, self.position, blocks).numpy().ravel()[self._order]
        data[self._removed] = 0.0
        data[self._diagonal] = 1.0
        return csc_array((data, self._indices, self._indptr), shape=(len(self._indptr) - 1,) * 2)

    def factors(self, E: Float[Tensor, "lane m 3k 3k"]) -> list[SuperLU]:
        """Return the factorization of each lane; kept for the next call with the same E."""
        if self._factors is None or not torch.equal(self._factors[0], E):
            self._factors = (E.clone(), [self._factorize(lane) for lane in E])
        return self._factors[1]

    def substitute(self, factors: list[SuperLU], f: Float[Tensor, "lane freedoms c"]) -> Tensor:
        f = f.clone()
        f[:, self.held] = 0.0
        u = [torch.from_numpy(factor.solve(right.numpy())) for factor, right in zip(factors, f, strict=True)]
        return torch.stack(u)

    def _factorize(self, element: Tensor) -> SuperLU:
        try:
            # E is symmetric and positive definite: no pivoting, and an ordering for symmetric patterns.
            return splu(
                self.matrix(element), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            )
        except RuntimeError as error:
            raise SimulationFailure(f"the warping problem of a section is singular: {error}") from error


def solve(
    problem: WarpingProblem, E: Float[Tensor, "*lanes m 3k 3k"], f: Float[Tensor, "*lanes freedoms c"]
) -> Float[Tensor, "*lanes freedoms c"]:
    """u = E^-1 f; E: stiffness of the elements."""
    lanes = E.shape[:-3]
    flat = f.expand(*lanes, *f.shape[-2:]).reshape(-1, *f.shape[-2:])
    return _Solve.apply(problem, E.reshape(-1, *E.shape[-3:]), flat).reshape(*lanes, *f.shape[-2:])


class _Solve(torch.autograd.Function):
    @staticmethod
    def forward(problem: WarpingProblem, E: Tensor, f: Tensor) -> Tensor:
        return problem.substitute(problem.factors(E), f)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.problem = inputs[0]
        ctx.set_materialize_grads(False)
        ctx.save_for_forward(inputs[1], output)
        ctx.save_for_backward(inputs[1], output)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, problem: WarpingProblem, E: Tensor, f: Tensor) -> tuple:
        return _batched(_Solve, info, in_dims, problem, E, f)

    @staticmethod
    def jvp(ctx: Any, _: Any, dE: Tensor | None, df: Tensor | None) -> Tensor:
        E, u = ctx.saved_tensors
        right = torch.zeros_like(u) if df is None else df
        if dE is not None:
            right = right - ctx.problem.geometry.element_force(dE, u)
        return _Substitute.apply(ctx.problem, E, right)

    @staticmethod
    def backward(ctx: Any, u_bar: Tensor | None) -> Any:
        if u_bar is None:
            return None, None, None
        E, u = ctx.saved_tensors
        dofs = ctx.problem.geometry.dofs
        f_bar: Any = _Substitute.apply(ctx.problem, E, u_bar)
        return None, -f_bar[..., dofs, :] @ u[..., dofs, :].mT, f_bar


class _Substitute(FirstDerivative):
    """E^-1 f with constant E, for the derivatives of u; its own derivatives in E are refused."""

    of = "section stiffness"

    @staticmethod
    def forward(problem: WarpingProblem, E: Tensor, f: Tensor) -> Tensor:
        return problem.substitute(problem.factors(E), f)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, problem: WarpingProblem, E: Tensor, f: Tensor) -> tuple:
        return _batched(_Substitute, info, in_dims, problem, E, f)


def _batched(function: Any, info: Any, in_dims: tuple, problem: WarpingProblem, E: Tensor, f: Tensor) -> tuple:
    """vmap: over designs, new lanes in front; over right-hand sides alone, more columns of one factorization."""
    size = info.batch_size
    f = batch_first(f, in_dims[2], size)
    if in_dims[1] is None:
        wide = f.movedim(0, -1).flatten(-2)  # [lane, freedoms, c * size]
        return function.apply(problem, E, wide).unflatten(-1, (-1, size)), 3
    E = E.movedim(in_dims[1], 0)
    result = function.apply(problem, E.flatten(0, 1), f.flatten(0, 1))
    return result.unflatten(0, (size, -1)), 0


def _held_freedoms(yz: Tensor) -> list[int]:
    """Return degrees of freedom to hold: all of a central node, and one far away, against rotation about x."""
    first = int(((yz - yz.mean(0)) ** 2).sum(1).argmin())
    arm = yz - yz[first]
    second = int((arm**2).sum(1).argmax())
    across = 2 if arm[second, 0].abs() >= arm[second, 1].abs() else 1
    return [3 * first, 3 * first + 1, 3 * first + 2, 3 * second + across]
