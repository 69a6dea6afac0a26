"""Eigenvalues of the linearized system with right and left vectors, from which their derivatives follow.

    P(s) = [s^2 M + s C + K, Phi_q'; Phi_q, 0]        P(s) r = 0,  l^H P(s) = 0,  l^H P'(s) r = 1

    ds = -l^H dP r

r = (x, multipliers). Natural frequencies are those of the conservative part: s = i w, and P has the symmetric part of K and the
antisymmetric one of C (Coriolis). There l is a multiple of r, dw is real, and the other parts add nothing to the real part of
l^H dP r, so that one formula holds for both. Forces that turn with a body make K unsymmetric: all of K counts then.
Where eigenvalues coincide, vectors are orthonormal in this sense; a pair with one vector only (defective) has no derivative.
Source: Lancaster, Numer. Math. 6 (1964) 377-387; Tisseur and Meerbergen, SIAM Rev. 43 (2001) 235-286.
Checked in tests/extensions/vibrations/test_eigenvalues.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import scipy.linalg
import torch
from torch import Tensor

from torchmbd.fem.reduction.basis import CLUSTER
from torchmbd.multibody.equilibrium.linearized import Linearization, Vibrations, rounding_of_squares, whirl
from torchmbd.multibody.saddle.rank import RELATIVE

_GUARD = 4  # vibrations beyond those asked for, so that those that coincide are complete
_FEW = 6  # the reciprocal of the largest share of all vibrations that `_lowest_whirl` is for
_SINGLE_SHAPE = "one of several that coincide and have a single shape (defective)"
_FREE, _GROWS = "zero, that of a free motion", "not a number: vibrations grow"
NOT_RETAINED = "that of a mode that this design does not retain"
# Share of |s| that the imaginary part of an oscillating pole has at least: nearly equal real poles get 1e-4 by rounding.
SWINGS = 1e-2
_DEFECTIVE = 1e-6  # cosine between the left and the right vector, P' between them, below which rounding decides


def damping_ratios(poles: Tensor) -> Tensor:
    """-Re s / |s| [lanes, freedoms] of poles [lanes, 2 freedoms] that oscillate, in their order; then nan for the others."""
    s = poles
    known = s.detach().imag > SWINGS * s.detach().abs()
    first = known.to(torch.float64).argsort(dim=1, descending=True, stable=True)[:, : s.shape[1] // 2]
    s, known = s.gather(1, first), known.gather(1, first)
    # Others take no part, also not by a derivative at zero.
    return torch.where(known, -s.real / torch.where(known, s, 1.0).abs(), torch.nan)


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Eigenvalues of one design.

    values        [k] [rad/s] natural angular frequencies, as `Vibrations` has them; or poles [1/s], complex
    right, left   complex [n_v, k], increments of the coordinates
    force, slip   complex [rows, k], multipliers of the right and of the left vector
    cluster       numbers [k]; eigenvalues of one number coincide
    fault         [k] why an eigenvalue has no derivative, else ""
    """

    values: Tensor
    right: Tensor
    left: Tensor
    force: Tensor
    slip: Tensor
    cluster: Tensor
    fault: tuple[str, ...]

    @property
    def roots(self) -> Tensor:
        """s [k] of the module header."""
        return self.values if self.values.is_complex() else 1j * self.values.nan_to_num()

    def padded(self, count: int) -> Spectrum:
        """The same with so many eigenvalues: zeros without vectors stand for those that other designs have."""
        k, further = len(self.values), count - len(self.values)
        if not further:
            return self
        values, right, left, force, slip = (
            torch.nn.functional.pad(x, (0, further))
            for x in (self.values, self.right, self.left, self.force, self.slip)
        )
        cluster = torch.cat([self.cluster, torch.arange(k, count)])  # numbers of members: none is as large
        return Spectrum(values, right, left, force, slip, cluster, (*self.fault, *[NOT_RETAINED] * further))

    @classmethod
    def natural(cls, rest: Linearization, count: int | None = None) -> Spectrum:
        """Natural frequencies in the order of `Vibrations`; count: of the lowest alone, which may take less time."""
        n = rest.N.shape[1]
        if rest.rotates and count is not None and count + _GUARD < n // _FEW and rest.gyroscopic:
            pairs = _lowest_whirl(rest, count + _GUARD)
            if pairs is not None:
                w, right = pairs[0][:count], pairs[1][:, :count]
                return _normalized(rest, w, _full(rest, right), _full(rest, right), ("",) * count)
        if rest.rotates and n:
            rest.factored_inertia()
            C, K = rest.reduced(rest.C), rest.reduced(rest.K)
            s, V, _ = _state_vectors(rest.inertia, 0.5 * (C - C.T), 0.5 * (K + K.T))
            w, upper = whirl(s)
            right = left = _full(rest, V[:, upper])
        else:
            vibrations = Vibrations.of(rest)
            w = 2.0 * math.pi * vibrations.frequencies
            right = left = vibrations.shapes.to(torch.complex128)
        if rest.nonconservative and not rest.rotates:
            M, K = rest.inertia, rest.reduced(rest.K)
            squares, L, R = _eigenvectors(torch.linalg.solve(M, K))
            order = squares.real.argsort()
            right = _full(rest, R[:, order])
            left = _full(rest, torch.linalg.solve(M.to(L.dtype), L[:, order]))
        keep = slice(0, count)
        fault = tuple(_GROWS if math.isnan(x) else _FREE if x == 0.0 else "" for x in w[keep].tolist())
        return _normalized(rest, w[keep], right[:, keep], left[:, keep], fault)

    @classmethod
    def poles(cls, rest: Linearization) -> Spectrum:
        """Poles in rising order of the size of their imaginary part, then of the real one; pairs -, +."""
        rest.factored_inertia()
        rest = rest.in_vibrations
        s, R, L = _state_vectors(rest.inertia, rest.damping, rest.stiffness)
        free = _free(rest, s, R)
        s = torch.where(free, 0.0, s)
        order = sorted(range(len(s)), key=lambda i: (abs(s[i].imag.item()), s[i].real.item(), s[i].imag.item()))
        fault = tuple(_FREE if x else "" for x in free[order].tolist())
        return _normalized(rest, s[order], _full(rest, R[:, order]), _full(rest, L[:, order]), fault)


def _free(rest: Linearization, s: Tensor, Y: Tensor) -> Tensor:
    """Which poles [k] with vectors [freedoms, k] are zero but for rounding, those of free motions: neither inertia nor
    stiffness does work on them."""
    inertia, stiffness = ((Y.conj() * (X.to(Y.dtype) @ Y)).sum(0).real for X in (rest.inertia, rest.stiffness))
    squares = stiffness / inertia
    small = rounding_of_squares(rest, Y / inertia.sqrt(), squares)
    return (s.abs().square() <= small) & (squares.abs() <= small)


def _lowest_whirl(rest: Linearization, count: int) -> tuple[Tensor, Tensor] | None:
    """The lowest angular frequencies [count] of a gyroscopic system and vectors [freedoms, count]; None where the stiffness is
    not positive definite.

    With K = L L', M = m m' and z = (L' y, m' y') the state equations are z = R z', R antisymmetric: i R z = z / w.
    """
    n, (M, C, K) = rest.N.shape[1], (rest.reduced(x) for x in (rest.M, rest.C, rest.K))
    (L, singular), m = torch.linalg.cholesky_ex(0.5 * (K + K.T)), torch.linalg.cholesky(0.5 * (M + M.T))
    if int(singular):
        return None
    inverse = torch.linalg.solve_triangular(L, torch.eye(n, dtype=K.dtype), upper=False)
    R = torch.zeros(2 * n, 2 * n, dtype=K.dtype)
    R[:n, :n], R[:n, n:], R[n:, :n] = -inverse @ C @ inverse.T, -inverse @ m, (inverse @ m).T
    skew = 0.5 * (R - R.T)
    largest = [2 * n - count, 2 * n - 1]
    values, Z = scipy.linalg.eigh((1j * skew).numpy(), subset_by_index=largest)  # pyright: ignore[reportAssignmentType]
    Y = inverse.T.to(torch.complex128) @ torch.from_numpy(Z)[:n]
    return 1.0 / torch.from_numpy(values).flip(0), Y.flip(1)


def _state_vectors(M: Tensor, C: Tensor, K: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Poles [2 n] of M y'' + C y' + K y = 0, right and left vectors y [n, 2 n]."""
    n = len(M)
    A = torch.zeros(2 * n, 2 * n, dtype=K.dtype)
    A[:n, n:] = torch.eye(n, dtype=K.dtype)
    A[n:, :n], A[n:, n:] = -torch.linalg.solve(M, K), -torch.linalg.solve(M, C)
    values, left, right = _eigenvectors(A)
    return values, right[:n], torch.linalg.solve(M.to(left.dtype), left[n:])


def _eigenvectors(A: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Eigenvalues [n] of a matrix, left and right vectors [n, n], complex."""
    if not len(A):
        none = A.to(torch.complex128)
        return none.diagonal(), none, none
    values, left, right = scipy.linalg.eig(A.numpy(), left=True)  # pyright: ignore[reportAssignmentType]
    values, left, right = (torch.from_numpy(x).to(torch.complex128) for x in (values, left, right))
    return values, left, right


def _full(rest: Linearization, Y: Tensor) -> Tensor:
    """Increments of the coordinates [n_v, k] out of those of the degrees of freedom [freedoms, k]."""
    full = Y.new_zeros(len(rest.forces), Y.shape[1])
    full[rest.active] = rest.N.to(Y.dtype) @ Y
    return full


def _normalized(rest: Linearization, values: Tensor, right: Tensor, left: Tensor, fault: tuple[str, ...]) -> Spectrum:
    """The spectrum with l^H P' r = 1; eigenvalues with a fault get vectors of zeros."""
    natural = not values.is_complex()
    s = 1j * values.nan_to_num() if natural else values
    cluster = _clusters(values)
    M, C, K = (x[rest.active][:, rest.active].to(s.dtype) for x in (rest.M, rest.C, rest.K))
    r, l = right[rest.active], left[rest.active]
    slope = 2.0 * s * (M @ r) + C @ r
    slope = 1j * slope if natural else slope  # by w
    faults = list(fault)
    products = (l.conj() * slope).sum(0)
    products = products.real.to(s.dtype) if natural else products
    sizes = l.norm(dim=0) * slope.norm(dim=0)
    scaled = left / products.conj()
    counts = torch.bincount(cluster, minlength=len(values))[cluster]
    for i in ((counts == 1) & ~(products.abs() > _DEFECTIVE * sizes)).nonzero()[:, 0].tolist():
        faults[i] = faults[i] or _SINGLE_SHAPE
    for number in cluster[counts > 1].unique().tolist():
        members = [i for i in (cluster == number).nonzero()[:, 0].tolist() if not faults[i]]
        if not members:
            continue
        B = l[:, members].mH @ slope[:, members]
        B = B.real.to(s.dtype) if natural else B
        if float(torch.linalg.svdvals(B)[-1]) > _DEFECTIVE * float(sizes[members].max()):
            scaled[:, members] = left[:, members] @ torch.linalg.inv(B).mH
        else:
            for i in members:
                faults[i] = _SINGLE_SHAPE
    faulty = torch.tensor([bool(x) for x in faults], dtype=torch.bool)
    right, left = torch.where(faulty, 0.0, right), torch.where(faulty, 0.0, scaled)
    r, l = right[rest.active], left[rest.active]
    back = torch.linalg.pinv(rest.Phi_q[:, rest.active].T, rtol=RELATIVE).to(s.dtype)
    force = -back @ (s * s * (M @ r) + s * (C @ r) + K @ r)
    slip = -back @ ((s * s).conj() * (M.mH @ l) + s.conj() * (C.mH @ l) + K.mH @ l)
    return Spectrum(values, right, left, force, slip, cluster, tuple(faults))


def _clusters(values: Tensor) -> Tensor:
    """Numbers of groups [k] of eigenvalues that coincide."""
    number = torch.arange(len(values))
    size = values.abs()
    near = (values[:, None] - values).abs() <= CLUSTER * torch.maximum(size[:, None], size)
    for i in range(len(values)):
        for j in near[i, :i].nonzero()[:, 0].tolist():
            number = torch.where(number == number[i], number[j], number)
    return number
