"""Linear buckling of a flexible body: factors of its loads at which it has a second equilibrium, and the shapes.

    K u = f,      (K + factor Kg(u)) shape = 0

K, Kg   stiffness and geometric stiffness (fem/elements/geometric.py) on the freedoms that the supports leave
u       displacements under the loads and the displacements of supports; supports hold still while the body buckles
1/factor  are eigenvalues of -Kg shape = (1/factor) K shape, so factors of loads that only stiffen are infinite

Factors are differentiable, forward and reverse, in every parameter of the body, through K, u and Kg. Where factors coincide
each has the mean of their derivatives (fem/reduction/spectral.py). Shapes are numbers without a derivative.
Assumed: u is small; the loads keep their directions and grow together.
Source: O. C. Zienkiewicz and R. L. Taylor, The Finite Element Method, vol. 2.
Checked in tests/multibody/statics/test_buckling.py, tests/validation/test_buckling.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse.linalg
import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.elements import FREEDOMS, Assembly
from torchmbd.fem.reduction import StaticLoads, eigenvalues
from torchmbd.math.module_call import outside
from torchmbd.math.owned import all_true, whole
from torchmbd.math.sparse import Pattern, SparseMatrix
from torchmbd.multibody.bodies import FlexibleBody
from torchmbd.multibody.bodies.interpolation import node_indices
from torchmbd.multibody.bodies.stiffening import check_stressed
from torchmbd.multibody.statics.nodal_loads import Loads, NodalLoads

SMALL = 400  # freedoms; below, a dense method costs no more
GUARD = 4  # eigenvalues beyond those asked for, so that the members of a cluster are known
NONE = 1e-7  # of the largest eigenvalue of either sign: what is below is none
RESTARTS = 100  # of Lanczos's method
Supports = Mapping[Any, str | Sequence[float | None]]


class Buckling(NamedTuple):
    """The result of `buckling`.

    factors        of the loads [*lanes, number] [-], ascending; inf: there is no further buckling shape
    shapes         buckling shapes [*lanes, nodes, 6, number], largest displacement 1; zero where there is none
    displacements  static displacements under the loads [*lanes, nodes, 6] [m, rad]
    status         "ok", or why factors are infinite

    >>> steel = mbd.Ply.isotropic(E=210e9, nu=0.3, density=7850.0)
    >>> tube = mbd.sections.tube(0.02, steel, [0.0], 1e-3)
    >>> column = mbd.FlexibleBody.beam("column", mbd.BeamLine.straight(2.0, 4), tube, reference="start")
    >>> found = mbd.buckling(column, {"end": (1.0, 0.0, 0.0)})  # a pull
    >>> found.factors.item(), found.status
    (inf, 'no buckling: the loads stiffen the body in all further shapes')
    """

    factors: Float[Tensor, "*lanes number"]
    shapes: Float[Tensor, "*lanes nodes 6 number"]
    displacements: Float[Tensor, "*lanes nodes 6"]
    status: str


def buckling(body: FlexibleBody, loads: Loads, supports: Supports | None = None, number: int = 1) -> Buckling:
    """Find the lowest positive factors of loads at which a body buckles; differentiable by its parameters.

    body      a FlexibleBody
    loads     nodes -> force [N], or force and moment [N, N m], in mesh axes, in total: 3 or 6 numbers, spread over the areas
              or lengths of the cells and sides of a node set. Nodes: a node, a set, or a tuple of these
    supports  nodes -> freedoms that are held, as "u1 u3 phi2", or "all"; or six numbers, displacements and rotations that
              are imposed [m, rad], None where it is free. None: the reference nodes of the body are held
    number    of factors
    Raises InputError where arguments are wrong or the supports leave the body movable.

    >>> steel = mbd.Ply.isotropic(E=210e9, nu=0.3, density=7850.0)
    >>> tube = mbd.sections.tube(0.02, steel, [0.0], 1e-3)
    >>> column = mbd.FlexibleBody.beam("column", mbd.BeamLine.straight(2.0, 8), tube, reference="start")
    >>> found = mbd.buckling(column, {"end": (-1000.0, 0.0, 0.0)})
    >>> euler = torch.pi**2 * tube.stiffness()[4, 4] / (2 * 2.0)**2
    >>> round((1000.0 * found.factors[0] / euler).item(), 2)  # shear
    1.0
    """
    return outside(lambda: BucklingCase(body, loads, supports))(number)


class BucklingCase:
    """A body with loads and supports, ready to find its buckling factors in any design: `case(number)`.

    body, loads, supports as of `buckling`. Raises InputError where these are wrong.
    """

    def __init__(self, body: FlexibleBody, loads: Loads, supports: Supports | None = None) -> None:
        if not isinstance(body, FlexibleBody):
            raise InputError(f"body of buckling is {body!r}; allowed: a FlexibleBody")
        if body.given is not None:
            raise InputError(
                f"body {body.name!r} of buckling is made of matrices, which give no stress; allowed: one of elements"
            )
        check_stressed(body.name, "buckling", body.parts)
        self.body = body
        self.assembly = Assembly(body.mesh, body.assembly.parts, (), body.links)
        held = _held(body, {tuple(body.reference): "all"} if supports is None else supports)
        free = self.assembly.freedoms.free
        row = {int(f): i for i, f in enumerate(free)}
        for f in held:
            if f not in row:
                raise InputError(
                    f"supports hold node {f // 6} of {body.name!r}, which follows another; allowed: its leader"
                )
        self._imposed = torch.zeros(len(free), 1, dtype=torch.float64)
        kept = torch.ones(len(free), dtype=torch.bool)
        for f, value in held.items():
            self._imposed[row[f], 0], kept[row[f]] = value, False
        if not bool(kept.any()):
            raise InputError(f"supports hold all freedoms of {body.name!r}; allowed: fewer")
        self.kept = kept.nonzero()[:, 0]
        self.pattern, self._positions = self.assembly.pattern.restrict(self.kept)
        self.loads = NodalLoads(body.mesh, body.name, loads)
        self._moves = bool(self._imposed.any())
        if not self.loads.any and not self._moves:
            raise InputError(
                f"loads of {body.name!r} are zero; allowed: at least one force, or an imposed displacement"
            )
        self._static = StaticLoads(self.pattern)
        with torch.no_grad():
            self.assembly.stiffness()  # finds its places, which torch.func does not allow

    def __call__(self, number: int = 1) -> Buckling:
        """The lowest positive factors, and shapes, of the present design.

        Raises InputError where the supports leave the body movable, or number is not possible.
        """
        if not whole(number) or not 1 <= number <= self.pattern.size:
            allowed = f"1 to {self.pattern.size}, the free freedoms of {self.body.name!r}"
            raise InputError(f"number is {number!r}; allowed: {allowed}")
        K = self.assembly.stiffness()
        inner = SparseMatrix(self.pattern, K.values[..., self._positions], symmetric=True)
        forces = self.assembly.freedoms.gathered(self.loads()[..., None])
        pull = forces - K @ self._imposed if self._moves else forces
        try:
            u = self._static(inner, pull[..., self.kept, :])
        except InputError as error:
            raise InputError(f"supports of {self.body.name!r} leave it movable: {error}") from None
        known = self._imposed.expand(*u.shape[:-2], -1, -1).index_copy(-2, self.kept, u)
        moved = self.assembly.freedoms.expand(known)
        Kg = self.assembly.geometric(moved).values[..., 0, :][..., self._positions]
        lanes = np.broadcast_shapes(inner.values.shape[:-1], Kg.shape[:-1])
        inverse, vectors = _eigen(self.pattern, inner.values.expand(*lanes, -1), Kg.expand(*lanes, -1), number)
        factors, shapes = _factors(inverse), self._shapes(vectors.detach())
        found = torch.isfinite(factors)
        status = "ok" if all_true(found) else "no buckling: the loads stiffen the body in all further shapes"
        return Buckling(factors, shapes * found[..., None, None, :], moved[..., 0], status)

    def _shapes(self, vectors: Float[Tensor, "*lanes N number"]) -> Float[Tensor, "*lanes n 6 number"]:
        none = vectors.new_zeros(*vectors.shape[:-2], len(self._imposed), vectors.shape[-1])
        motion = self.assembly.freedoms.expand(none.index_copy(-2, self.kept, vectors))
        flat = motion[..., :3, :].flatten(-3, -2)
        size = flat.gather(-2, flat.abs().argmax(-2, keepdim=True))[..., None, :]
        return motion / torch.where(size == 0.0, 1.0, size)


def _held(body: FlexibleBody, supports: Supports) -> dict[int, float]:
    """Freedoms 6 * node + i that are held, and where."""
    if not isinstance(supports, Mapping) or not supports:
        raise InputError(
            f"supports of {body.name!r} is {supports!r}; allowed: nodes -> freedoms, at least one, or None"
        )
    found: dict[int, float] = {}
    for where, given in supports.items():
        values = _values(body, where, given)
        for node in node_indices(body.mesh, list(where) if isinstance(where, tuple) else where):
            for i, x in enumerate(values):
                if x is not None and found.setdefault(6 * node + i, x) != x:
                    raise InputError(
                        f"supports of {body.name!r} put {FREEDOMS[i]} of node {node} at two places; allowed: one"
                    )
    return found


def _values(body: FlexibleBody, where: Any, given: Any) -> list[float | None]:
    if isinstance(given, str):
        names = list(FREEDOMS) if given == "all" else given.replace(",", " ").split()
        if names and all(name in FREEDOMS for name in names):
            return [0.0 if name in names else None for name in FREEDOMS]
    elif isinstance(given, Sequence) and len(given) == 6 and all(x is None or _finite(x) for x in given):
        return [None if x is None else float(x) for x in given]
    allowed = f"some of {' '.join(FREEDOMS)}, or 'all', or six numbers, None where it is free"
    raise InputError(f"support {where!r} of {body.name!r} is {given!r}; allowed: {allowed}")


def _finite(x: Any) -> bool:
    return isinstance(x, (int, float)) and not isinstance(x, bool) and bool(np.isfinite(x))


def _eigen(
    pattern: Pattern, K: Float[Tensor, "*lanes nnz"], Kg: Float[Tensor, "*lanes nnz"], number: int
) -> tuple[Float[Tensor, "*lanes number"], Float[Tensor, "*lanes N number"]]:
    """1 / factors, falling, with their derivatives, zero where there is none; and their vectors, which have no derivative."""
    lanes, n = K.shape[:-1], pattern.size
    some = min(number + GUARD, n)
    flat, scale = _Vectors.apply(pattern, some, K.reshape(-1, pattern.nnz), Kg.reshape(-1, pattern.nnz))
    vectors, scale = flat.reshape(*lanes, n, some), scale.reshape(*lanes, 1)
    a, b = (vectors.mT @ (SparseMatrix(pattern, values) @ vectors) for values in (K, Kg))
    missing = torch.diag_embed((vectors == 0.0).all(-2).to(a.dtype))
    L = torch.linalg.cholesky(0.5 * (a + a.mT) + missing)
    half = torch.linalg.solve_triangular(L, 0.5 * (b + b.mT), upper=False)
    Kr = torch.linalg.solve_triangular(L, half.mT, upper=False)
    inverse = -eigenvalues(0.5 * (Kr + Kr.mT))[..., :number]
    return torch.where(inverse > NONE * scale, inverse, 0.0), vectors[..., :number]


class _Vectors(torch.autograd.Function):
    """Eigenvectors [lane, N, some] of Kg x = value K x of the lowest values, K-orthonormal, by rising value, zero where there
    is none below zero; and the largest value of either sign [lane]. Numbers without a derivative: the derivative of an
    eigenvalue needs none of its vector."""

    @staticmethod
    def forward(pattern: Pattern, some: int, K: Tensor, Kg: Tensor) -> tuple[Tensor, Tensor]:
        found = [_vectors(pattern, a, b, some) for a, b in zip(K, Kg, strict=True)]
        vectors, scale = zip(*found, strict=True)
        return torch.stack(vectors), torch.tensor(scale, dtype=K.dtype)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        ctx.mark_non_differentiable(*output)
        ctx.shapes = [x.shape for x in output]

    @staticmethod
    def jvp(ctx: Any, *_: Any) -> Any:
        return None, None

    @staticmethod
    def backward(ctx: Any, *_: Any) -> Any:
        return None, None, None, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple, pattern: Pattern, some: int, K: Tensor, Kg: Tensor) -> Any:
        wide = (
            x.expand(info.batch_size, *x.shape) if dim is None else x.movedim(dim, 0)
            for x, dim in ((K, in_dims[2]), (Kg, in_dims[3]))
        )
        outputs = _Vectors.apply(pattern, some, *(x.flatten(0, 1) for x in wide))
        return tuple(x.unflatten(0, (info.batch_size, -1)) for x in outputs), (0, 0)  # pyright: ignore


def _vectors(pattern: Pattern, K: Tensor, Kg: Tensor, some: int) -> tuple[Tensor, float]:
    """Of one lane."""
    A, B = pattern.to_scipy(Kg), pattern.to_scipy(K)
    if pattern.size <= max(SMALL, 4 * some):
        values, found = scipy.linalg.eigh(A.toarray(), B.toarray())
        scale, values, found = np.abs(values).max(), values[:some], found[:, :some]
    else:
        factor = scipy.sparse.linalg.splu(B.tocsc())
        inverse = scipy.sparse.linalg.LinearOperator(B.shape, factor.solve, dtype=float)  # pyright: ignore
        options: dict[str, Any] = {
            "M": B,
            "Minv": inverse,
            "v0": np.random.default_rng(0).standard_normal(pattern.size),
        }
        largest = scipy.sparse.linalg.eigsh(A, 1, which="LM", tol=1e-2, **options)  # pyright: ignore
        scale = float(abs(largest[0][0]))
        try:
            values, found = scipy.sparse.linalg.eigsh(A, some, which="SA", maxiter=RESTARTS, **options)
        except scipy.sparse.linalg.ArpackNoConvergence as error:  # the others crowd at zero: loads that stiffen
            values, found = error.eigenvalues, error.eigenvectors
    order = [i for i in np.argsort(values) if values[i] < -NONE * scale]
    vectors = np.zeros((pattern.size, some))
    vectors[:, : len(order)] = found[:, order]
    return torch.from_numpy(vectors), float(scale)


def _factors(inverse: Float[Tensor, "*lanes number"]) -> Float[Tensor, "*lanes number"]:
    there = inverse.detach() > 0.0
    return torch.where(there, 1.0 / torch.where(there, inverse, 1.0), torch.inf)
