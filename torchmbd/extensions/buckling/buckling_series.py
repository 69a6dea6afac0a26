"""Buckling of a body under a series of stress states, such as those of a motion: a buckling index at each time.

    -Kg(t) x = index(t) K x,      Kg(t) = sum_k c_k(t) Kg_k          index = 1 / factor, the largest

K is constant and Kg(t) is in a space of few dimensions; so are the shapes x(t), and all times are solved in one basis V of
shapes. It starts from the shapes at a few times and from smooth random ones, and grows by the static displacements K^-1 r
under the residuals r(t) = Kg(t) x + index K x of all times, until these are below TOLERANCE of the largest index. At the end
the full eigenproblem at the time of the largest index must have no larger index.
Differentiable, forward and reverse, in K, the stress states and c; equal indices have the mean of their derivatives. V has no
derivative, as the derivative of an index does not need it at this tolerance.
Source: Y. Saad, Numerical Methods for Large Eigenvalue Problems (2011), chapter 8 (Davidson's method).
Checked in tests/extensions/buckling/test_buckling_index.py: against the full eigenproblem at all times.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError, warn
from torchmbd.extensions.buckling.eigenproblem import GUARD, NONE, inverse_factors, lowest_vectors
from torchmbd.fem.reduction import StaticLoads
from torchmbd.math.sparse import SparseMatrix
from torchmbd.multibody.bodies import FlexibleBody
from torchmbd.multibody.statics.supported_body import Changes, SupportedBody, Supports

# Largest residual in the norm of K^-1, as a share of the largest index. In the motion of a plate values had errors of 1e-9,
# derivatives of 1e-7.
TOLERANCE = 1e-5
SAMPLES = 5  # times whose shapes are in the first basis
RANDOM = 4  # smooth random shapes in the first basis
RANK = 1e-11  # share of the largest singular value below which a part of the series is zero
ROUNDS = 30
GROWTH = 24  # most shapes that a round adds


class BucklingSeries:
    """Buckling indices of a body on supports, for any series of stress states.

    body, supports   as in `linear_buckling`, without imposed displacements. Raises InputError if these are wrong
    """

    def __init__(self, body: FlexibleBody, supports: Supports | None = None) -> None:
        self.supported = SupportedBody(body, supports)
        if bool(self.supported.imposed.any()):
            raise InputError(
                "supports",
                supports,
                allowed="at rest along a motion",
                state="are displaced",
                noun=f"supports of {body.name!r}",
            )
        self._static = StaticLoads(self.supported.pattern)

    def __call__(
        self,
        displacements: Float[Tensor, "lanes n 6 k"],
        c: Float[Tensor, "lanes times k"],
        number: int = 1,
        changes: Changes = (),
    ) -> Float[Tensor, "lanes times number"]:
        """The largest indices, descending; zero where the stress only stiffens, nan where c is not finite.

        displacements   of all nodes, whose stresses are the k stress states
        c               factors of the states at each time
        changes         of the last displacements, as in `SupportedBody.geometric`
        Raises InputError if the supports leave the body movable, or number is not possible.
        """
        supported, lanes = self.supported, len(c)
        if number > supported.pattern.size:
            raise InputError(
                "number",
                number,
                f"1 to {supported.pattern.size}, the degrees of freedom that {supported.name!r} has on its supports",
            )
        finite = torch.isfinite(c.detach()).all(-1, keepdim=True)
        c = torch.where(finite, c, 0.0)
        K = supported.restricted(supported.assembly.stiffness())
        K = SparseMatrix(K.pattern, K.values.expand(lanes, -1), symmetric=True)
        with torch.no_grad():
            Kg = supported.geometric(displacements, changes).expand(lanes, -1, -1)
        V, y, scale = _Basis.apply(self, number, K.values, Kg, c)
        a = V.mT @ (K @ V)
        B = supported.projected_geometric(displacements, changes, supported.motion(V))
        b = torch.einsum("ltk,lkij->ltij", c, B.expand(lanes, -1, -1, -1))
        a, b = (y.mT @ x @ y for x in (a[:, None], b))
        index = inverse_factors(a, b)[..., :number]
        return torch.where(finite, torch.where(index > NONE * scale[:, None, None], index, 0.0), torch.nan)

    def find(self, number: int, K: Tensor, Kg: Tensor, c: Tensor) -> list[_Shapes]:
        """The basis of each lane, of tensors without derivatives."""
        supported = self.supported
        start = torch.from_numpy(np.random.default_rng(0).standard_normal((supported.pattern.size, RANDOM)))
        try:
            smooth = self._static(SparseMatrix(supported.pattern, K, symmetric=True), start)
        except InputError as error:
            raise supported.movable(error) from None
        lanes = []
        for stiffness, states, factors, first in zip(K, Kg, c, smooth, strict=True):
            search = _Search(self, stiffness.numpy(), states.numpy(), factors.numpy(), number)
            lanes.append(search.run(first.numpy()))
        return lanes


class _Shapes(NamedTuple):
    """Basis V [N, m], coefficients y of the shapes in it at each time [times, m, count], the largest index of all times."""

    V: np.ndarray
    y: np.ndarray
    scale: float


class _Search:
    """The search for the basis of one lane: K [nnz], Kg [k, nnz], c [times, k]."""

    def __init__(self, series: BucklingSeries, K: np.ndarray, Kg: np.ndarray, c: np.ndarray, number: int) -> None:
        self.pattern, self.name = series.supported.pattern, series.supported.name
        self.Kg, self.c = _independent_states(Kg, c)
        self.K, self.number = self.pattern.to_scipy(K), number
        self.solve = scipy.sparse.linalg.splu(self.K).solve
        self.stacked = scipy.sparse.vstack([self.pattern.to_scipy(x) for x in self.Kg], format="csr")
        self.values = K
        self.mixed = np.random.default_rng(0).standard_normal(((number + 1) * len(c), min(GROWTH, self.pattern.size)))

    def run(self, start: np.ndarray) -> _Shapes:
        times = np.unique(np.linspace(0, len(self.c) - 1, SAMPLES).astype(int))
        V = self._grown(np.zeros((len(start), 0)), np.hstack([start, *(self._exact(t) for t in times)]))
        for _ in range(ROUNDS):
            y, index, residual, error = self._solve_in(V)
            scale = index.max(initial=0.0)
            if error.max(initial=0.0) <= TOLERANCE * scale or V.shape[1] == len(V):
                exact = self._exact(peak := int(index[:, 0].argmax()))
                first = exact[:, 0]
                if not first.any() or self._quotient(first, peak) <= scale * (1.0 + 1e-6):
                    return _Shapes(V, y, scale)
                residual = exact
            V = self._grown(V, residual)
        warn(
            f"buckling of {self.name!r}: the shapes of some times have a residual of {error.max() / scale:.1e}, "
            "so the indices may be inaccurate"
        )
        return _Shapes(V, y, scale)

    def _exact(self, time: int) -> np.ndarray:
        """Shapes of the full eigenproblem at a time [N, number + GUARD], zero where there are no more."""
        count = min(self.number + GUARD, self.pattern.size)
        if (
            np.linalg.norm(self.c[time]) <= NONE * np.linalg.norm(self.c, axis=1).max()
        ):  # no load: Lanczos's method fails
            return np.zeros((self.pattern.size, count))
        K, Kg = (torch.from_numpy(x) for x in (self.values, self.c[time] @ self.Kg))
        return lowest_vectors(self.pattern, K, Kg, count)[0].numpy()

    def _quotient(self, x: np.ndarray, time: int) -> float:
        """Rayleigh quotient of a shape at a time: its index."""
        Kg = self.pattern.to_scipy(self.c[time] @ self.Kg)
        return float(-(x @ (Kg @ x)) / (x @ (self.K @ x)))

    def _solve_in(self, V: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Coefficients of shapes in a basis [times, m, count] and indices [times, count]; and of the residuals of the requested
        shapes and one more, the static displacements [N, r] and their norms [times]."""
        (N, m), k = V.shape, len(self.Kg)
        H = (self.stacked @ V).reshape(k, N, m)
        B = np.einsum("ni,knj->kij", V, H, optimize=True)
        b = (self.c @ B.reshape(k, -1)).reshape(-1, m, m)
        values, vectors = np.linalg.eigh(0.5 * (b + b.swapaxes(1, 2)))
        count = min(self.number + GUARD, m)
        index, y = -values[:, :count], vectors[:, :, :count]
        checked = min(self.number + 1, count)
        x = y[:, :, :checked] * (index[:, None, :checked] > NONE * index.max(initial=0.0))
        coefficients = np.einsum("tk,tmw->kmtw", self.c, x).reshape(k * m, -1)
        R = H.transpose(1, 0, 2).reshape(N, k * m) @ coefficients
        R += (self.K @ V) @ (x * index[:, None, :checked]).transpose(1, 0, 2).reshape(m, -1)
        size = np.sqrt(self.K.diagonal())[:, None]
        Q = np.linalg.qr((R / size) @ self.mixed[: R.shape[1]])[0]  # spans nearly the space of the residuals
        W, r = self.solve(size * Q), Q.T @ (R / size)
        error = np.sqrt(np.maximum(np.einsum("at,ab,bt->t", r, W.T @ (size * Q), r, optimize=True), 0.0))
        return y, index, W, error

    def _grown(self, V: np.ndarray, more: np.ndarray) -> np.ndarray:
        """A basis of V and `more`, orthonormal in K."""
        more = more[:, more.any(0)]
        if not more.shape[1]:
            return V
        more = more / np.sqrt(np.einsum("ni,ni->i", more, self.K @ more))
        for _ in range(2):
            more = more - V @ (V.T @ (self.K @ more))
            gram = more.T @ (self.K @ more)
            size, turn = scipy.linalg.eigh(0.5 * (gram + gram.T))
            kept = size > 1e-12
            more = more @ (turn[:, kept] / np.sqrt(size[kept]))
        return np.hstack([V, more[:, -(len(V) - V.shape[1]) :]]) if V.shape[1] < len(V) else V


def _independent_states(Kg: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Kg and c of as few combinations of the stress states as the series has dimensions."""
    size = np.sqrt(np.einsum("kn,kn->k", Kg, Kg)) + np.finfo(float).tiny
    u, s, v = np.linalg.svd(c * size, full_matrices=False)
    kept = s >= RANK * s[0]
    return v[kept] @ (Kg / size[:, None]), u[:, kept] * s[kept]


class _Basis(torch.autograd.Function):
    """V [lane, N, m], y [lane, times, m, count] and the largest index [lane], out of K [lane, nnz], Kg [lane, k, nnz] and c
    [lane, times, k]; without derivatives."""

    @staticmethod
    def forward(series: BucklingSeries, number: int, K: Tensor, Kg: Tensor, c: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        lanes = series.find(number, K, Kg, c)
        m = max(shapes.V.shape[1] for shapes in lanes)
        V, y = (
            [np.pad(x, [(0, m - n if axis == 1 else 0) for axis, n in enumerate(x.shape)]) for x in arrays]
            for arrays in ([shapes.V for shapes in lanes], [shapes.y for shapes in lanes])
        )
        scale = torch.tensor([shapes.scale for shapes in lanes], dtype=K.dtype)
        return torch.from_numpy(np.stack(V)), torch.from_numpy(np.stack(y)), scale

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        ctx.mark_non_differentiable(*output)

    @staticmethod
    def jvp(ctx: Any, *_: Any) -> Any:
        return None, None, None

    @staticmethod
    def backward(ctx: Any, *_: Any) -> Any:
        return None, None, None, None, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple, series: BucklingSeries, number: int, *tensors: Tensor) -> Any:
        wide = (
            x.expand(info.batch_size, *x.shape) if dim is None else x.movedim(dim, 0)
            for x, dim in zip(tensors, in_dims[2:], strict=True)
        )
        outputs = _Basis.apply(series, number, *(x.flatten(0, 1) for x in wide))
        return tuple(x.unflatten(0, (info.batch_size, -1)) for x in outputs), (0, 0, 0)  # pyright: ignore
