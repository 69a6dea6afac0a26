"""Likeness of the shapes of vibrations, by which one is followed over speeds and designs.

    MAC = |a^H M b|^2 / (a^H M a)(b^H M b)         at most 1; of one shape with orthogonal others the sum is at most 1

Modal coordinates of a body belong to the modes of a design: those of another have the displacements of the nodes in common, to
least squares.
Source: Allemang and Brown, Proc. 1st Int. Modal Analysis Conf. (1982) 110-116.
Checked in tests/extensions/vibrations/test_campbell_diagram.py,
tests/extensions/vibrations/measures/test_followed_vibrations.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchmbd.errors import DesignFailure
from torchmbd.extensions.vibrations.spectrum import Spectrum
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.equilibrium.linearized import Linearization

SURE = 0.55  # MAC: above 0.5 no other of orthogonal shapes is as like; the rest is a margin


class Shapes(NamedTuple):
    """Values [n], shapes [n_v, n] of unit size in the mass M [n_v, n_v]."""

    poles: Tensor
    shapes: Tensor
    M: Tensor

    @classmethod
    def of(cls, spectrum: Spectrum, rest: Linearization) -> Shapes:
        M = 0.5 * (rest.M + rest.M.T).to(torch.complex128)
        return cls(spectrum.values, _unit(M, spectrum.right), M)

    def likeness(self, others: Tensor) -> Tensor:
        """MAC [others, n] with shapes [n_v, others]."""
        return (_unit(self.M, others).mH @ (self.M @ self.shapes)).abs().square()


class NodalShape(NamedTuple):
    """A shape [n_v] in the rates of a topology, of a design with modes [nodes, 6, modes] of its bodies by their names."""

    shape: Tensor
    topology: Topology
    modes: Mapping[str, Tensor]

    def in_modes(self, T: Topology, modes: Mapping[str, Tensor]) -> Tensor:
        """The same displacements [n_v] in the modes of another design."""
        x = self.shape.new_zeros(T.n_v)
        x[: 6 * T.bodies] = self.shape[: 6 * T.bodies]
        for body in range(T.flexible):
            rows, rows_before = ([row - T.bodies for row in at.w_slice(body)] for at in (T, self.topology))
            before, after = (y[T.names[body]].flatten(0, 1).to(x.dtype) for y in (self.modes, modes))
            w = self.shape[rows_before][:, None]
            x[rows] = torch.linalg.lstsq(after, before @ w).solution[:, 0]  # zero for modes that are padding
        return x


class MostAlike:
    """A `Choice` of the vibration most like a shape, in each lane; DesignFailure if none is sure.

    shapes   [n_v, lanes or 1], in the coordinates of each lane
    name     of the vibration, for messages
    numbers  those that are chosen [lanes]; chosen: all of them, ascending
    """

    def __init__(self, shapes: Tensor, name: str):
        self.shapes, self.name = shapes, name
        self.numbers = self.chosen = torch.zeros(0, dtype=torch.long)

    def __call__(self, spectra: Sequence[Spectrum], states: Sequence[Linearization]) -> list[int]:
        shapes = self.shapes.expand(-1, len(spectra)).T
        numbers = []
        for lane, (spectrum, rest) in enumerate(zip(spectra, states, strict=True)):
            where = f" (lane {lane})" * (len(spectra) > 1)
            numbers.append(self._of_lane(Shapes.of(spectrum, rest), shapes[lane], where))
        self.numbers = torch.tensor(numbers)
        self.chosen = self.numbers.unique()
        return self.chosen.tolist()

    def _of_lane(self, here: Shapes, shape: Tensor, where: str) -> int:
        likeness = here.likeness(shape[:, None])[0]
        # A pole and its conjugate at rest are as like: the later one has the positive imaginary part.
        best = len(likeness) - 1 - int((likeness > 0.99 * likeness.max()).flip(0).to(torch.int8).argmax())
        if not float(likeness[best]) > SURE:
            raise DesignFailure(
                self.name,
                allowed="like one vibration of every design",
                state=f"cannot be followed{where}, because its shape has mixed with others: the most similar vibration "
                f"has a MAC of {float(likeness[best]):.2f}",
                hint="follow=False, a cluster, or designs nearer to the start",
            )
        return best


def _unit(M: Tensor, shapes: Tensor) -> Tensor:
    """Shapes [n_v, k] of unit size in the mass."""
    size = (shapes.conj() * (M @ shapes)).sum(0).real.clamp_min(0.0).sqrt()
    return shapes / torch.where(size > 0.0, size, 1.0)
