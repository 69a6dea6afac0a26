"""Eigenvalues of small vibrations about states of a motion, differentiable: an `Integration` of `Motion`.

    ds = -l^H dP r          dP by the state, the data and the multipliers that balance them; l, r constant (spectrum.py)

P r is one derivative of the residual: along x = r, x' = s r, x'' = s^2 r and the multipliers of r. So l^H P r is written in the
functions of the equations, once, and its gradient is that of the eigenvalue.
Forward mode multiplies the same gradient, a row for each eigenvalue, by the directions.
Eigenvalues that coincide have the mean of their derivatives. It is the derivative of every function that is symmetric in them;
others are refused, in reverse mode by unequal cotangents, in forward mode where the derivatives along the direction differ.
Checked in tests/vibrations/test_eigenvalues.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import DesignFailure, InputError
from torchmbd.integrate.motion import Motion, Tensors
from torchmbd.integrate.pullback import leaf
from torchmbd.math.pair import Pair
from torchmbd.multibody.system import Dynamics, equations
from torchmbd.multibody.system.equilibrium import SPIN
from torchmbd.multibody.system.linearized import Linearization
from torchmbd.multibody.system.rank import RELATIVE
from torchmbd.multibody.system.steady_rotation import Observer, ObserverAtRest, SteadyRotation
from torchmbd.vibrations.spectrum import Spectrum

NATURAL, POLES = "natural", "poles"
_NEIGHBORS = 6  # vibrations above those asked for that are looked at, as they may coincide with these
_UNEQUAL = 1e-6  # of derivatives of eigenvalues that coincide: more than rounding
_HELD = "allowed: functions of other eigenvalues, or drives, joints and springs that hold the mechanism"


def eigenvalues(
    dynamics: Dynamics,
    q: Tensor,
    t: Tensor,
    rotation: SteadyRotation | None,
    kind: str,
    modes: Sequence[int] | None = None,
    symmetric: bool = False,
) -> Tensor:
    """Eigenvalues [k, lanes] of small vibrations about q [n_q, 1, lanes], at rest or in steady rotation; differentiable by q
    and the data of the dynamics.

    kind        "natural": angular frequencies [rad/s]; "poles" [1/s], complex
    modes       their numbers from 0, in the order of spectrum.py; None: all
    symmetric   what is made of them is symmetric in those that coincide, so that no derivative is refused
    """
    model, names = replace(dynamics, data={}), tuple(dynamics.data)
    problem = _AboutState(kind=kind, modes=modes, symmetric=symmetric, model=model, names=names, t=t, rotation=rotation)
    parts: Any = Motion.apply(problem, q, *dynamics.data.values())
    parts = [x[:, 0] for x in parts]
    return torch.complex(*parts) if kind == POLES else parts[0]


def poles_of_matrices(M: Tensor, C: Tensor, K: Tensor) -> Tensor:
    """Poles [2 n, lanes] of M z'' + C z' + K z = 0, matrices [n, n, lanes] by which they are differentiable."""
    problem = _OfMatrices(kind=POLES, modes=None, symmetric=False)
    real, imag = Motion.apply(problem, *(x[:, :, None] for x in (M, C, K)))  # pyright: ignore[reportGeneralTypeIssues]
    return torch.complex(real[:, 0], imag[:, 0])


@dataclass(eq=False, kw_only=True)
class _Eigenproblem:
    """`Integration`; inputs [..., lanes], outputs the real and, of poles, the imaginary parts [k, 1, lanes]."""

    kind: str
    modes: Sequence[int] | None
    symmetric: bool
    inputs: list[Tensor] = field(default_factory=list, init=False)
    spectra: list[Spectrum] = field(default_factory=list, init=False)

    def values(self, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        lanes = max(x.shape[-1] for x in inputs)
        self.inputs = [x.expand(*x.shape[:-1], lanes) for x in inputs]
        self.spectra = [self._spectrum([x[..., lane : lane + 1] for x in self.inputs]) for lane in range(lanes)]
        sizes = {self._size(lane) for lane in range(lanes)}
        if len(sizes) > 1:
            raise InputError(
                f"lanes have {sorted(sizes)} vibrations; allowed: designs with the same number of freedoms"
            )
        (size,) = sizes
        if wrong := [k for k in self.modes or () if not 0 <= k < size]:
            raise InputError(f"number is {wrong[0] + 1}; allowed: 1 to {size}, the vibrations of the system")
        self.modes = range(size) if self.modes is None else self.modes
        parts = torch.stack([x.values[list(self.modes)] for x in self.spectra], -1)[:, None]
        return (parts.real, parts.imag) if parts.is_complex() else (parts,)

    def _spectrum(self, inputs: Sequence[Tensor]) -> Spectrum:
        """Of one lane."""
        raise NotImplementedError(type(self).__name__)

    def _size(self, lane: int) -> int:
        """How many eigenvalues there are."""
        return len(self.spectra[lane].values)

    def _slopes(self, modes: Sequence[int], pairs: Sequence[tuple[int, int]]) -> tuple[list[Tensor], list[Tensor]]:
        """Inputs as leaves, and -l_i^H P r_j [pairs, lanes] as their functions: its real and, of poles, its imaginary part."""
        raise NotImplementedError(type(self).__name__)

    def tangents(self, directions: Tensors) -> list[Tensor]:
        count, lanes = max(x.shape[-2] for x in directions if x is not None), len(self.spectra)
        modes, pairs = self._columns()
        leaves, slopes = self._slopes(modes, pairs)
        rows = []
        for part, k in [(part, k) for part in range(len(slopes)) for k in range(len(pairs))]:
            weights = [torch.zeros_like(y) for y in slopes]
            weights[part][k] = 1.0
            by = zip(_gradients(slopes, weights, leaves), directions, strict=True)
            parts = [(g * x).flatten(0, -3).sum(0) for g, x in by if g is not None and x is not None]
            rows.append(sum(parts, weights[part].new_zeros(count, lanes)))
        blocks = torch.stack(rows).unflatten(0, (len(slopes), -1))  # [parts, pairs, tangents, lanes]
        if not self.symmetric:
            for lane, spectrum in enumerate(self.spectra):
                self._refuse_split(spectrum, pairs, blocks[..., lane])
        single = [k for k, (i, j) in enumerate(pairs) if i == j]
        tangents = self._shared(blocks[:, single], modes)[:, : len(self.modes or ())]
        for lane, spectrum in enumerate(self.spectra):
            faulty = [bool(spectrum.fault[k]) for k in self.modes or ()]
            tangents[:, faulty, :, lane] = torch.nan
        return list(tangents)

    def cotangents(self, outputs: Tensors, needs_grad: Sequence[bool]) -> list[Tensor | None]:
        rows, lanes = max(x.shape[-2] for x in outputs if x is not None), len(self.spectra)
        modes, _ = self._columns()
        bars = torch.zeros(len(outputs), len(modes), rows, lanes, dtype=torch.float64)
        for bar, x in zip(bars, outputs, strict=True):
            if x is not None:
                bar[: len(self.modes or ())] = x
        for lane, spectrum in enumerate(self.spectra):
            for i, mode in enumerate(modes):
                if spectrum.fault[mode] and bool(bars[:, i, :, lane].any()):
                    raise DesignFailure(
                        f"eigenvalue {mode + 1} has no derivative: it is {spectrum.fault[mode]}; {_HELD}"
                    )
            if not self.symmetric:
                self._refuse_unequal(spectrum, modes, bars[..., lane])
        bars = self._shared(bars, modes)
        needed = bars.flatten(2).abs().amax((0, 2)).nonzero()[:, 0].tolist()  # one of many eigenvalues has one column
        leaves, slopes = self._slopes([modes[i] for i in needed], [(i, i) for i in range(len(needed))])
        bars = bars[:, needed]
        by_leaf: list[list[Tensor]] = [[] for _ in leaves]
        for row in range(rows):
            for parts, g, x in zip(by_leaf, _gradients(slopes, list(bars[:, :, row]), leaves), leaves, strict=True):
                parts.append(torch.zeros_like(x) if g is None else g)
        return [torch.cat(parts, -2) if needed else None for parts, needed in zip(by_leaf, needs_grad, strict=True)]

    def _columns(self) -> tuple[list[int], list[tuple[int, int]]]:
        """Numbers of the eigenvalues asked for, then of those that coincide with them; and pairs of positions that coincide."""
        modes = list(self.modes or ())
        for spectrum in self.spectra:
            numbers = spectrum.cluster[modes]
            modes += [k for k in torch.isin(spectrum.cluster, numbers).nonzero()[:, 0].tolist() if k not in modes]
        pairs = [(i, i) for i in range(len(modes))]
        for spectrum in self.spectra:
            same = spectrum.cluster[modes][:, None] == spectrum.cluster[modes]
            pairs += [(i, j) for i, j in same.nonzero().tolist() if (i, j) not in pairs]
        return modes, pairs

    def _shared(self, x: Tensor, modes: Sequence[int]) -> Tensor:
        """Means over eigenvalues that coincide, of x [parts, modes, k, lanes]."""
        numbers = torch.stack([spectrum.cluster[list(modes)] for spectrum in self.spectra], -1)
        same = (numbers[:, None] == numbers).to(x.dtype)
        return torch.einsum("ijl,pjkl->pikl", same / same.sum(1, keepdim=True), x)

    def _refuse_unequal(self, spectrum: Spectrum, modes: Sequence[int], bars: Tensor) -> None:
        """InputError for cotangents [parts, modes, rows] that differ among eigenvalues that coincide."""
        for number in spectrum.cluster[list(modes)].unique():
            members = (spectrum.cluster[list(modes)] == number).nonzero()[:, 0]
            bar = bars[:, members]
            if float((bar - bar[:, :1]).abs().max()) > _UNEQUAL * float(bar.abs().max()):
                raise _coincide(spectrum, [modes[i] for i in members.tolist()])

    def _refuse_split(self, spectrum: Spectrum, pairs: Sequence[tuple[int, int]], blocks: Tensor) -> None:
        """InputError where derivatives [parts, pairs, tangents] of eigenvalues that coincide differ along a direction."""
        modes, _ = self._columns()
        for number in spectrum.cluster[modes].unique():
            members = (spectrum.cluster[modes] == number).nonzero()[:, 0].tolist()
            of = [k for k, (i, j) in enumerate(pairs) if i in members and j in members]
            block = blocks[:, of]
            mean = torch.stack([blocks[:, k] for k, (i, j) in enumerate(pairs) if i == j and i in members]).mean(0)
            unit = torch.tensor([float(pairs[k][0] == pairs[k][1]) for k in of], dtype=block.dtype)[:, None]
            if bool(((block - unit * mean[:, None]).abs() > _UNEQUAL * block.abs().amax((0, 1))).any()):
                raise _coincide(spectrum, [modes[i] for i in members])

    def _vectors(self, rows: Sequence[int], columns: Sequence[int]) -> list[Tensor]:
        """Left vectors and slips of eigenvalues `rows`, right vectors and forces of `columns`, [n, k, lanes]."""
        names = {"left": rows, "slip": rows, "right": columns, "force": columns}
        return [torch.stack([getattr(x, name)[:, k] for x in self.spectra], -1) for name, k in names.items()]


@dataclass(eq=False, kw_only=True)
class _AboutState(_Eigenproblem):
    """Of the equations of motion about a state at rest or in steady rotation; inputs are q and the data."""

    model: Dynamics
    names: tuple[str, ...]
    t: Tensor
    rotation: SteadyRotation | None
    balance: list[Linearization] = field(default_factory=list, init=False)

    def _spectrum(self, inputs: Sequence[Tensor]) -> Spectrum:
        q, data = self._split(inputs)
        rest = Linearization.of(replace(self.model, data=data), q[:, 0, 0], self.t, None, self._observer(data))
        self.balance.append(rest)
        few = None if self.modes is None else 1 + max(self.modes) + _NEIGHBORS
        return Spectrum.natural(rest, few) if self.kind == NATURAL else Spectrum.poles(rest)

    def _size(self, lane: int) -> int:
        return self.balance[lane].N.shape[1] * (1 + (self.kind == POLES))

    def _split(self, inputs: Sequence[Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        return inputs[0], dict(zip(self.names, inputs[1:], strict=True))

    def _observer(self, data: dict[str, Tensor]) -> Observer:
        return ObserverAtRest() if self.rotation is None else self.rotation.of_spin(data[SPIN])

    def _slopes(self, modes: Sequence[int], pairs: Sequence[tuple[int, int]]) -> tuple[list[Tensor], list[Tensor]]:
        T, leaves = self.model.topology, [leaf(x) for x in self.inputs]
        q, data = self._split(leaves)
        observer = self._observer(data)
        columns = [modes[j] for _, j in pairs]
        s = torch.stack([x.roots[columns] for x in self.spectra], -1)
        left, slip, right, force = self._vectors([modes[i] for i, _ in pairs], columns)
        with torch.enable_grad():
            excitation = T.prescribed(self.t, data)
            zero = q.new_zeros(T.n_v, 1, q.shape[-1])
            at, *rates = observer.perturbed(T, q, zero, zero, zero)
            lam = self._multipliers(data, equations.placement(T, data, at, excitation), rates, observer, q)
            x, xd, xdd = (Pair.of(zero, _parts(y)) for y in (right, s * right, s * s * right))
            near, v, a = observer.perturbed(T, q, x, xd, xdd)
            moved = equations.placement(T, data, near, excitation)
            z = equations.dynamic_residual(T, data, moved, v, a, Pair.of(lam, _parts(force)))
            products = _inner(left, observer.rows(T, q, z).tangent)
            if T.rows:
                more = _inner(slip, equations.constraints(T, moved).tangent)
                products = [x + y for x, y in zip(products, more, strict=True)]
            return leaves, [-x for x in (products if self.kind == POLES else products[:1])]

    def _multipliers(self, data: Any, at: Any, rates: Any, observer: Observer, q: Tensor) -> Tensor:
        """Multipliers [rows, 1, lanes] that balance the state: the known ones, by a Newton step that carries derivatives."""
        T, active = self.model.topology, self.balance[0].active
        lam = torch.stack([rest.lam for rest in self.balance], -1)[:, None]
        forces = observer.rows(T, q, equations.dynamic_residual(T, data, at, rates[0], rates[1], lam))[active, 0]
        back = [torch.linalg.pinv(rest.Phi_q[:, active].T, rtol=RELATIVE) for rest in self.balance]
        return lam - torch.einsum("rvl,vl->rl", torch.stack(back, -1), forces)[:, None]


@dataclass(eq=False, kw_only=True)
class _OfMatrices(_Eigenproblem):
    """Of M z'' + C z' + K z = 0; inputs are M, C and K [n, n, 1, lanes]."""

    def _spectrum(self, inputs: Sequence[Tensor]) -> Spectrum:
        return Spectrum.poles(Linearization.of_matrices(*(x[:, :, 0, 0] for x in inputs)))

    def _slopes(self, modes: Sequence[int], pairs: Sequence[tuple[int, int]]) -> tuple[list[Tensor], list[Tensor]]:
        leaves, columns = [leaf(x) for x in self.inputs], [modes[j] for _, j in pairs]
        s = torch.stack([x.roots[columns] for x in self.spectra], -1)
        left, _, right, _ = self._vectors([modes[i] for i, _ in pairs], columns)
        with torch.enable_grad():
            M, C, K = (x[:, :, 0].to(s.dtype) for x in leaves)
            P = [torch.einsum("ijl,jkl->ikl", X, f * right) for X, f in ((M, s * s), (C, s), (K, torch.ones_like(s)))]
            product = -(left.conj() * (P[0] + P[1] + P[2])).sum(0)
            return leaves, [product.real, product.imag]


def _coincide(spectrum: Spectrum, modes: Sequence[int]) -> DesignFailure:
    numbers = ", ".join(str(k + 1) for k in modes)
    value = spectrum.values[modes[0]].item()
    return DesignFailure(
        f"eigenvalues {numbers} coincide at {value:.6g}: a single one has no derivative; allowed: functions symmetric in them, "
        "such as SystemFrequency(cluster=...)"
    )


def _parts(x: Tensor) -> Tensor:
    """Real parts, then imaginary ones [n, 2 k, lanes]."""
    return torch.cat([x.real, x.imag], 1)


def _inner(left: Tensor, z: Tensor) -> list[Tensor]:
    """Real and imaginary part [k, lanes] of l^H z for z [n, 2 k, lanes] as of `_parts`."""
    real, imag = z.chunk(2, 1)
    return [(left.real * real + left.imag * imag).sum(0), (left.real * imag - left.imag * real).sum(0)]


def _gradients(
    slopes: Sequence[Tensor], weights: Sequence[Tensor], leaves: Sequence[Tensor]
) -> Sequence[Tensor | None]:
    """Gradients of sum(weights * slopes); None where there is none."""
    return torch.autograd.grad(slopes, leaves, weights, retain_graph=True, allow_unused=True)
