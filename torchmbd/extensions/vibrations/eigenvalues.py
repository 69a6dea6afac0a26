"""Eigenvalues of small vibrations about states of a motion, differentiable: an `Integration` of `Motion`.

    ds = -l^H dP r          dP by the state, the data and the multipliers that balance them; l, r constant (spectrum.py)

The gradient of l^H P r (inner_products.py) is that of the eigenvalue. Each eigenvalue is a lane of its own: one pass backwards
gives the gradients of all, which are multiplied by the cotangents or, in forward mode, by the directions.
Eigenvalues that coincide have the mean of their derivatives. It is the derivative of every function that is symmetric in them;
others are refused, in reverse mode by unequal cotangents, in forward mode where the derivatives along the direction differ.
Checked in tests/extensions/vibrations/test_eigenvalues.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.errors import DesignFailure, InputError
from torchmbd.extensions.vibrations.inner_products import Vectors, inner_products
from torchmbd.extensions.vibrations.spectrum import NOT_RETAINED, Spectrum
from torchmbd.integrate.motion import Motion, Tensors
from torchmbd.integrate.pullback import leaf
from torchmbd.multibody.equilibrium.equilibrium import SPIN
from torchmbd.multibody.equilibrium.linearized import Linearization
from torchmbd.multibody.equilibrium.steady_rotation import Observer, ObserverAtRest, SteadyRotation
from torchmbd.multibody.system import Dynamics

NATURAL, POLES = "natural", "poles"
#: Chooses numbers by the spectra and the states of all lanes, such as those of vibrations that are followed by their shapes.
Choice = Callable[[Sequence[Spectrum], Sequence[Linearization]], Sequence[int]]
_NEIGHBORS = 6  # vibrations above those asked for that are looked at, as they may coincide with these
_LANES = 64  # states, or terms, whose equations are evaluated at once: fewer take longer, more leave the cache
_UNEQUAL = 1e-6  # of derivatives of eigenvalues that coincide: more than rounding
_HELD = "functions of other eigenvalues, or drives, joints and springs that hold the mechanism"


def eigenvalues(
    dynamics: Dynamics,
    q: Tensor,
    t: Tensor,
    rotation: SteadyRotation | None,
    kind: str,
    modes: Sequence[int] | Choice | None = None,
    symmetric: bool = False,
    mean: bool = False,
) -> Tensor:
    """Eigenvalues [k, lanes] of small vibrations about q [n_q, 1, lanes], at rest or in steady rotation; differentiable with
    respect to q and the data of the dynamics.

    kind        "natural": angular frequencies [rad/s]; "poles" [1/s], complex
    modes       their numbers from 0, in the order of spectrum.py; None: all, and in lanes that retain fewer modes than others
                infinite ones at the end; or a function that chooses them
    symmetric   the caller makes a symmetric function of these numbers: derivatives are refused only where another eigenvalue,
                which is not among the numbers, coincides with one of them
    mean        the derivative of each is the mean of those that coincide, and none is refused: for a search
    """
    model, names = replace(dynamics, data={}), tuple(dynamics.data)
    options: dict[str, Any] = {"kind": kind, "modes": modes, "symmetric": symmetric, "mean": mean}
    problem = AboutState(**options, model=model, names=names, t=t, rotation=rotation)
    parts: Any = Motion.apply(problem, q, *dynamics.data.values())
    parts = [x[:, 0] for x in parts]
    return torch.complex(*parts) if kind == POLES else parts[0]


def _infinite(values: Tensor, missing: Tensor) -> Tensor:
    """Values with infinite ones where modes are missing: of a body that is rigid to their shapes; poles decay at once."""
    if not values.is_complex():
        return torch.where(missing, torch.inf, values)
    endless = torch.full_like(values.real, torch.inf)
    endless[::2] *= -1.0  # pairs -, +
    return torch.where(missing, torch.complex(-endless.abs(), endless), values)


class Term(NamedTuple):
    """A product l^H dP r: numbers of the two vectors in the spectrum of a lane."""

    left: int
    right: int
    lane: int


class _Slope(NamedTuple):
    """Gradients [..., m] of a part of the terms with these numbers [m], all of one lane, by an input."""

    part: int
    input: int
    lane: int
    numbers: list[int]
    by: Tensor


def poles_of_matrices(M: Tensor, C: Tensor, K: Tensor) -> Tensor:
    """Poles [2 n, lanes] of M z'' + C z' + K z = 0, matrices [n, n, lanes] by which they are differentiable."""
    problem = _OfMatrices(kind=POLES, modes=None, symmetric=False)
    real, imag = Motion.apply(problem, *(x[:, :, None] for x in (M, C, K)))  # pyright: ignore[reportGeneralTypeIssues]
    return torch.complex(real[:, 0], imag[:, 0])


@dataclass(eq=False, kw_only=True)
class _Eigenproblem:
    """`Integration`; inputs [..., lanes], outputs the real and, of poles, the imaginary parts [k, 1, lanes]."""

    kind: str
    modes: Sequence[int] | Choice | None
    symmetric: bool
    mean: bool = False
    numbers: Sequence[int] = field(default=(), init=False)
    inputs: list[Tensor] = field(default_factory=list, init=False)
    spectra: list[Spectrum] = field(default_factory=list, init=False)

    def values(self, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        lanes = max(x.shape[-1] for x in inputs)
        self.inputs = [x.expand(*x.shape[:-1], lanes) for x in inputs]
        self.spectra = self._spectra()
        sizes = [self._size(lane) for lane in range(lanes)]
        self.numbers = range(max(sizes)) if self.modes is None else self._chosen()
        if isinstance(self.modes, Sequence):
            self._require(sizes)
        parts = torch.stack([x.values[list(self.numbers)] for x in self.spectra], -1)[:, None]
        if self.modes is None:
            parts = _infinite(parts, torch.tensor(self.numbers)[:, None, None] >= torch.tensor(sizes))
        return (parts.real, parts.imag) if parts.is_complex() else (parts,)

    def _require(self, sizes: Sequence[int]) -> None:
        """InputError if no lane has a number of `modes`, DesignFailure if some have it; sizes: how many each has."""
        if wrong := [k for k in self.numbers if not 0 <= k < min(sizes)]:
            known = 0 <= wrong[0] < max(sizes)
            where = f" of lane {sizes.index(min(sizes))}" if known else ""
            allowed = f"1 to {min(sizes) if known else max(sizes)}, the vibrations{where}"
            raise (DesignFailure if known else InputError)("number", wrong[0] + 1, allowed, shown=f"{wrong[0] + 1}")

    def _spectra(self) -> list[Spectrum]:
        """Of all lanes."""
        raise NotImplementedError(type(self).__name__)

    def _chosen(self) -> Sequence[int]:
        """The numbers that `modes` has or chooses."""
        raise NotImplementedError(type(self).__name__)

    def _size(self, lane: int) -> int:
        """How many eigenvalues there are."""
        return len(self.spectra[lane].values)

    def _slopes(self, terms: Sequence[Term]) -> tuple[list[Tensor], list[Tensor]]:
        """Inputs as leaves, a lane for each term, and -l^H P r [1, terms]: its real and, of poles, its imaginary part."""
        raise NotImplementedError(type(self).__name__)

    def tangents(self, directions: Tensors) -> list[Tensor]:
        count, lanes = max(x.shape[-2] for x in directions if x is not None), len(self.spectra)
        modes, pairs = self._columns()
        blocks = torch.zeros(self._parts, len(pairs), count, lanes, dtype=torch.float64)
        terms = [Term(modes[i], modes[j], lane) for lane in range(lanes) for i, j in pairs]
        for slope in self._gradients(terms):
            x = directions[slope.input]
            if x is not None:
                along = x.expand(*x.shape[:-1], lanes)[..., slope.lane].flatten(0, -2)
                places = [k % len(pairs) for k in slope.numbers]
                blocks[slope.part, places, :, slope.lane] += slope.by.flatten(0, -2).T @ along
        for lane in range(lanes):
            self._refuse_split(lane, pairs, blocks[..., lane])
        single = [k for k, (i, j) in enumerate(pairs) if i == j]
        tangents = self._shared(blocks[:, single], modes)[:, : len(self.numbers)]
        for lane, spectrum in enumerate(self.spectra):
            faulty = [spectrum.fault[k] not in ("", NOT_RETAINED) for k in self.numbers]
            tangents[:, faulty, :, lane] = torch.nan
        return list(tangents)

    def cotangents(self, outputs: Tensors, needs_grad: Sequence[bool]) -> list[Tensor | None]:
        rows, lanes = max(x.shape[-2] for x in outputs if x is not None), len(self.spectra)
        modes, _ = self._columns()
        bars = torch.zeros(len(outputs), len(modes), rows, lanes, dtype=torch.float64)
        for bar, x in zip(bars, outputs, strict=True):
            if x is not None:
                bar[: len(self.numbers)] = x
        for lane, spectrum in enumerate(self.spectra):
            for i, mode in enumerate(modes):
                if spectrum.fault[mode] and bool(bars[:, i, :, lane].any()):
                    where = self._where(lane)
                    raise DesignFailure(
                        "number",
                        mode + 1,
                        hint=_HELD,
                        noun=f"eigenvalue {mode + 1}{where}",
                        state=f"has no derivative, because it is {spectrum.fault[mode]}",
                    )
            self._refuse_unequal(lane, modes, bars[..., lane])
        bars = self._shared(bars, modes)
        needed = bars.abs().amax((0, 2)).T.nonzero().flip(1).tolist()  # of many eigenvalues and lanes few may count
        terms = [Term(modes[i], modes[i], lane) for i, lane in needed]
        result = [
            x.new_zeros(*x.shape[:-2], rows, lanes) if y else None for x, y in zip(self.inputs, needs_grad, strict=True)
        ]
        for slope in self._gradients(terms):
            total = result[slope.input]
            if total is not None:
                places = [needed[k][0] for k in slope.numbers]
                total[..., slope.lane] += slope.by @ bars[slope.part, places, :, slope.lane]
        return result

    def _columns(self) -> tuple[list[int], list[tuple[int, int]]]:
        """Numbers of the eigenvalues asked for, then of those that coincide with them; and pairs of positions that coincide."""
        modes = list(self.numbers)
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

    def _where(self, lane: int) -> str:
        """Which lane, for messages, where there are several."""
        return f" of lane {lane}" if len(self.spectra) > 1 else ""

    def _refuse_unequal(self, lane: int, modes: Sequence[int], bars: Tensor) -> None:
        """DesignFailure for cotangents [parts, modes, rows] that differ among eigenvalues that coincide."""
        for members in self._told_apart(lane, modes):
            bar = bars[:, members]
            if float((bar - bar[:, :1]).abs().max()) > _UNEQUAL * float(bar.abs().max()):
                raise self._coincide(lane, [modes[i] for i in members])

    def _refuse_split(self, lane: int, pairs: Sequence[tuple[int, int]], blocks: Tensor) -> None:
        """DesignFailure if derivatives [parts, pairs, tangents] of eigenvalues that coincide differ along a direction."""
        modes, _ = self._columns()
        for members in self._told_apart(lane, modes):
            of = [k for k, (i, j) in enumerate(pairs) if i in members and j in members]
            block = blocks[:, of]
            mean = torch.stack([blocks[:, k] for k, (i, j) in enumerate(pairs) if i == j and i in members]).mean(0)
            unit = torch.tensor([float(pairs[k][0] == pairs[k][1]) for k in of], dtype=block.dtype)[:, None]
            if bool(((block - unit * mean[:, None]).abs() > _UNEQUAL * block.abs().amax((0, 1))).any()):
                raise self._coincide(lane, [modes[i] for i in members])

    def _told_apart(self, lane: int, modes: Sequence[int]) -> Iterator[list[int]]:
        """Positions of eigenvalues that coincide, for each group in which a function may tell one from another."""
        cluster = self.spectra[lane].cluster[list(modes)]
        for number in cluster.unique() if not self.mean else ():
            members = (cluster == number).nonzero()[:, 0].tolist()
            if not self.symmetric or members[-1] >= len(self.numbers):
                yield members

    def _coincide(self, lane: int, modes: Sequence[int]) -> DesignFailure:
        numbers, value = ", ".join(str(k + 1) for k in sorted(modes)), self.spectra[lane].values[modes[0]].item()
        return DesignFailure(
            "number",
            [k + 1 for k in sorted(modes)],
            "apart for a derivative of a single one",
            noun=f"eigenvalues {numbers}{self._where(lane)}",
            state=f"coincide at {value:.6g}",
            hint="functions symmetric in them, such as SystemFrequency(cluster=...)",
        )

    @property
    def _parts(self) -> int:
        return 1 + (self.kind == POLES)

    def _gradients(self, terms: Sequence[Term]) -> Iterator[_Slope]:
        """Gradients of the terms, sorted by lanes, by the inputs."""
        for start in range(0, len(terms), _LANES):
            some = terms[start : start + _LANES]
            leaves, slopes = self._slopes(some)
            for part, y in enumerate(slopes):
                by = torch.autograd.grad(y, leaves, torch.ones_like(y), retain_graph=True, allow_unused=True)
                for k, g in [(k, g) for k, g in enumerate(by) if g is not None]:
                    for lane, of_lane in groupby(enumerate(some), lambda numbered: numbered[1].lane):
                        places = [i for i, _ in of_lane]
                        yield _Slope(part, k, lane, [start + i for i in places], g[..., 0, places])

    def _vectors(self, terms: Sequence[Term], side: str, *names: str) -> list[Tensor]:
        """Columns [n, 1, terms] of the named tensors of the spectra."""
        of = [(self.spectra[term.lane], getattr(term, side)) for term in terms]
        return [torch.stack([getattr(x, name)[..., k] for x, k in of], -1).reshape(-1, 1, len(of)) for name in names]


@dataclass(eq=False, kw_only=True)
class AboutState(_Eigenproblem):
    """Of the equations of motion about a state at rest or in steady rotation; inputs are q and the data."""

    model: Dynamics
    names: tuple[str, ...]
    t: Tensor
    rotation: SteadyRotation | None
    balance: list[Linearization] = field(default_factory=list, init=False)

    def _spectra(self) -> list[Spectrum]:
        for some in torch.arange(self.inputs[0].shape[-1]).split(_LANES):
            q, data = self._split([x[..., some] for x in self.inputs])
            self.balance += Linearization.each(replace(self.model, data=data), q, self.t, None, self._observer(data))
        few = 1 + max(self.modes) + _NEIGHBORS if isinstance(self.modes, Sequence) else None
        spectra = [Spectrum.natural(x, few) if self.kind == NATURAL else Spectrum.poles(x) for x in self.balance]
        most = max(len(x.values) for x in spectra)
        return [x.padded(most) for x in spectra]

    def _chosen(self) -> Sequence[int]:
        assert self.modes is not None
        return self.modes if isinstance(self.modes, Sequence) else self.modes(self.spectra, self.balance)

    def _size(self, lane: int) -> int:
        return self.balance[lane].N.shape[1] * (1 + (self.kind == POLES))

    def _split(self, inputs: Sequence[Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        return inputs[0], dict(zip(self.names, inputs[1:], strict=True))

    def _observer(self, data: dict[str, Tensor]) -> Observer:
        return ObserverAtRest() if self.rotation is None else self.rotation.of_spin(data[SPIN])

    def _slopes(self, terms: Sequence[Term]) -> tuple[list[Tensor], list[Tensor]]:
        """Inputs as leaves, a lane for each term, and -l^H P r [terms]: its real and, of poles, its imaginary part."""
        lanes = [term.lane for term in terms]
        leaves = [leaf(x[..., lanes]) for x in self.inputs]
        q, data = self._split(leaves)
        s, right, force = self._vectors(terms, "right", "roots", "right", "force")
        left, slip = self._vectors(terms, "left", "left", "slip")
        vectors = Vectors(left, slip, right, force)
        balance = [self.balance[lane] for lane in lanes]
        with torch.enable_grad():
            products = inner_products(self.model.topology, data, q, self.t, self._observer(data), balance, s, vectors)
            return leaves, [-x for x in products[: self._parts]]


@dataclass(eq=False, kw_only=True)
class _OfMatrices(_Eigenproblem):
    """Of M z'' + C z' + K z = 0; inputs are M, C and K [n, n, 1, lanes]."""

    def _spectra(self) -> list[Spectrum]:
        lanes = range(self.inputs[0].shape[-1])
        return [Spectrum.poles(Linearization.of_matrices(*(x[:, :, 0, i] for x in self.inputs))) for i in lanes]

    def _slopes(self, terms: Sequence[Term]) -> tuple[list[Tensor], list[Tensor]]:
        leaves = [leaf(x[..., [term.lane for term in terms]]) for x in self.inputs]
        s, right = self._vectors(terms, "right", "roots", "right")
        [left] = self._vectors(terms, "left", "left")
        with torch.enable_grad():
            M, C, K = (x[:, :, 0].to(s.dtype) for x in leaves)
            P = sum(torch.einsum("ijl,jkl->ikl", X, f * right) for X, f in ((M, s * s), (C, s), (K, s**0)))
            product = -(left.conj() * P).sum(0)
            return leaves, [product.real, product.imag]
