"""Buckling of a body under a series of stress states, such as those of a motion: a share of the critical load at each time.

    -Kg(t) x = index(t) K x,      Kg(t) = sum_k c_k(t) Kg_k          index = 1 / factor, the largest

K is one matrix and Kg(t) lies in a space of few dimensions, so do the shapes x(t): all times are solved in one basis V of
shapes. It starts from the shapes at a few times and from smooth random ones, and grows by the static displacements K^-1 r
under the residuals r(t) = Kg(t) x + index K x of all times, until these are below TOLERANCE of the largest index. Then the full
eigenproblem at the time of the largest index must find no larger one.
Differentiable, forward and reverse, in K, the stress states and c; equal indices have the mean of their derivatives. V has no
derivative: at its tolerance that of an index needs none.
Source: Y. Saad, Numerical Methods for Large Eigenvalue Problems (2011), chapter 8 (Davidson's method).
Checked in tests/design/test_buckling_index.py: against the full eigenproblem at all times.
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
from torchmbd.fem.elements.geometric import projected_geometric_stiffness
from torchmbd.fem.reduction import StaticLoads
from torchmbd.math.sparse import SparseMatrix
from torchmbd.multibody.bodies import FlexibleBody
from torchmbd.multibody.statics.eigenproblem import GUARD, NONE, inverse_factors, lowest_vectors
from torchmbd.multibody.statics.supported_body import SupportedBody, Supports

# Of a residual, in the norm of K^-1, of the largest index. Of a plate on a motion values were 1e-9 off, derivatives 1e-7.
TOLERANCE = 1e-5
SAMPLES = 5  # times whose shapes the basis starts from
RANDOM = 4  # smooth random shapes in it
RANK = 1e-11  # of the largest: smaller parts of the series are none
ROUNDS = 30
GROWTH = 24  # shapes more in a round


class BucklingSeries:
    """A body on supports, ready to find its buckling indices under any series of stress states.

    body, supports   as of `buckling`; supports stand still. Raises InputError where these are wrong
    """

    def __init__(self, body: FlexibleBody, supports: Supports | None = None) -> None:
        self.supported = SupportedBody(body, supports)
        if bool(self.supported.imposed.any()):
            raise InputError(f"supports of {body.name!r} are displaced; allowed along a motion: supports at rest")
        self._static = StaticLoads(self.supported.pattern)

    def __call__(
        self, moved: Float[Tensor, "lanes n 6 k"], c: Float[Tensor, "lanes times k"], number: int = 1
    ) -> Float[Tensor, "lanes times number"]:
        """The largest indices, falling; zero where the stress only stiffens, nan where c is not finite.

        moved   displacements of all nodes that make the stress states
        c       how much there is of each at each time
        Raises InputError where the supports leave the body movable, or number is not possible.
        """
        supported, lanes = self.supported, len(c)
        if number > supported.pattern.size:
            raise InputError(
                f"number is {number!r}; allowed: 1 to {supported.pattern.size}, the free freedoms of {supported.name!r}"
            )
        good = torch.isfinite(c.detach()).all(-1, keepdim=True)
        c = torch.where(good, c, 0.0)
        K = supported.restricted(supported.assembly.stiffness())
        K = SparseMatrix(K.pattern, K.values.expand(lanes, -1), symmetric=True)
        with torch.no_grad():
            Kg = supported.geometric(moved).expand(lanes, -1, -1)
        V, y, scale = _Basis.apply(self, number, K.values, Kg, c)
        a = V.mT @ (K @ V)
        B = projected_geometric_stiffness(supported.assembly.stressed(moved), supported.motion(V))
        b = torch.einsum("ltk,lkij->ltij", c, B.expand(lanes, -1, -1, -1))
        a, b = (y.mT @ x @ y for x in (a[:, None], b))
        index = inverse_factors(a, b)[..., :number]
        return torch.where(good, torch.where(index > NONE * scale[:, None, None], index, 0.0), torch.nan)

    def find(self, number: int, K: Tensor, Kg: Tensor, c: Tensor) -> list[_Shapes]:
        """The basis of each lane; numbers only."""
        supported = self.supported
        start = torch.from_numpy(np.random.default_rng(0).standard_normal((supported.pattern.size, RANDOM)))
        try:
            smooth = self._static(SparseMatrix(supported.pattern, K, symmetric=True), start)
        except InputError as error:
            raise supported.movable(error) from None
        found = []
        for own, states, weights, first in zip(K, Kg, c, smooth, strict=True):
            search = _Search(self, own.numpy(), states.numpy(), weights.numpy(), number)
            found.append(search.run(first.numpy()))
        return found


class _Shapes(NamedTuple):
    """Basis V [N, m], the shapes in it at each time [times, m, some], the largest index of all."""

    V: np.ndarray
    y: np.ndarray
    scale: float


class _Search:
    """Of one lane: K [nnz], Kg [k, nnz], c [times, k]."""

    def __init__(self, series: BucklingSeries, K: np.ndarray, Kg: np.ndarray, c: np.ndarray, number: int) -> None:
        self.pattern, self.name = series.supported.pattern, series.supported.name
        self.Kg, self.c = _fewest(Kg, c)
        self.K, self.number = self.pattern.to_scipy(K), number
        self.solve = scipy.sparse.linalg.splu(self.K).solve
        self.stacked = scipy.sparse.vstack([self.pattern.to_scipy(x) for x in self.Kg], format="csr")
        self.values = K
        self.mixed = np.random.default_rng(0).standard_normal(((number + 1) * len(c), min(GROWTH, self.pattern.size)))

    def run(self, start: np.ndarray) -> _Shapes:
        times = np.unique(np.linspace(0, len(self.c) - 1, SAMPLES).astype(int))
        V = self._grown(np.zeros((len(start), 0)), np.hstack([start, *(self._exact(t) for t in times)]))
        for _ in range(ROUNDS):
            y, index, residual, error = self._in(V)
            scale = index.max(initial=0.0)
            if error.max(initial=0.0) <= TOLERANCE * scale or V.shape[1] == len(V):
                exact = self._exact(peak := int(index[:, 0].argmax()))
                first = exact[:, 0]
                if not first.any() or self._quotient(first, peak) <= scale * (1.0 + 1e-6):
                    return _Shapes(V, y, scale)
                residual = exact
            V = self._grown(V, residual)
        warn(f"buckling of {self.name!r}: shapes of all times are found to {error.max() / scale:.1e} only")
        return _Shapes(V, y, scale)

    def _exact(self, time: int) -> np.ndarray:
        """Shapes of the full eigenproblem at a time [N, number + GUARD], zero where there is none."""
        some = min(self.number + GUARD, self.pattern.size)
        if (
            np.linalg.norm(self.c[time]) <= NONE * np.linalg.norm(self.c, axis=1).max()
        ):  # Lanczos's method asks for a load
            return np.zeros((self.pattern.size, some))
        K, Kg = (torch.from_numpy(x) for x in (self.values, self.c[time] @ self.Kg))
        return lowest_vectors(self.pattern, K, Kg, some)[0].numpy()

    def _quotient(self, x: np.ndarray, time: int) -> float:
        Kg = self.pattern.to_scipy(self.c[time] @ self.Kg)
        return float(-(x @ (Kg @ x)) / (x @ (self.K @ x)))

    def _in(self, V: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Shapes in a basis [times, m, some] and indices [times, some]; displacements under the residuals of those that are
        asked for and one more [N, r], and the norms of these by times."""
        (N, m), k = V.shape, len(self.Kg)
        H = (self.stacked @ V).reshape(k, N, m)
        B = np.einsum("ni,knj->kij", V, H, optimize=True)
        b = (self.c @ B.reshape(k, -1)).reshape(-1, m, m)
        values, vectors = np.linalg.eigh(0.5 * (b + b.swapaxes(1, 2)))
        some = min(self.number + GUARD, m)
        index, y = -values[:, :some], vectors[:, :, :some]
        wanted = min(self.number + 1, some)
        x = y[:, :, :wanted] * (index[:, None, :wanted] > NONE * index.max(initial=0.0))
        coefficients = np.einsum("tk,tmw->kmtw", self.c, x).reshape(k * m, -1)
        R = H.transpose(1, 0, 2).reshape(N, k * m) @ coefficients
        R += (self.K @ V) @ (x * index[:, None, :wanted]).transpose(1, 0, 2).reshape(m, -1)
        size = np.sqrt(self.K.diagonal())[:, None]
        Q = np.linalg.qr((R / size) @ self.mixed[: R.shape[1]])[0]  # spans nearly what the residuals do
        W, own = self.solve(size * Q), Q.T @ (R / size)
        error = np.sqrt(np.maximum(np.einsum("at,ab,bt->t", own, W.T @ (size * Q), own, optimize=True), 0.0))
        return y, index, W, error

    def _grown(self, V: np.ndarray, more: np.ndarray) -> np.ndarray:
        """V and what is new in others, orthonormal in K."""
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


def _fewest(Kg: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """As many combinations of the stress states as the series has dimensions, and how much there is of each."""
    size = np.sqrt(np.einsum("kn,kn->k", Kg, Kg)) + np.finfo(float).tiny
    u, s, v = np.linalg.svd(c * size, full_matrices=False)
    kept = s >= RANK * s[0]
    return v[kept] @ (Kg / size[:, None]), u[:, kept] * s[kept]


class _Basis(torch.autograd.Function):
    """V [lane, N, m], y [lane, times, m, some] and the largest index [lane] of K [lane, nnz], Kg [lane, k, nnz] and c
    [lane, times, k]. Numbers without a derivative."""

    @staticmethod
    def forward(series: BucklingSeries, number: int, K: Tensor, Kg: Tensor, c: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        found = series.find(number, K, Kg, c)
        m = max(shapes.V.shape[1] for shapes in found)
        V, y = (
            [np.pad(x, [(0, m - n if axis == pad else 0) for axis, n in enumerate(x.shape)]) for x in given]
            for given, pad in (([f.V for f in found], 1), ([f.y for f in found], 1))
        )
        scale = torch.tensor([shapes.scale for shapes in found], dtype=K.dtype)
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
