"""Natural frequencies of a flexible body on supports, and the shapes of its vibrations.

    K shape = (2 pi frequency)^2 M shape

K, M   stiffness and mass on the degrees of freedom without supports; the body is unstressed and undamped

A free body has six rigid motions of frequency zero, which are left out: it starts with its first vibration.
Frequencies are differentiable, forward and reverse, in every parameter of the body. Where some coincide each has the mean of
their derivatives (fem/reduction/spectral.py). Shapes are numbers without a derivative; `eigenpairs` has those that exist.
Checked in tests/multibody/statics/test_vibrations.py, tests/validation/test_vibrations.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.reduction import CutCluster, Matrix, ModalBasis, eigenvalues, modal_basis
from torchmbd.fem.reduction.forms import lane_name
from torchmbd.math.checked_numbers import is_whole
from torchmbd.math.gradients import untransformed
from torchmbd.math.module_call import outside_transforms
from torchmbd.math.sparse import SparseMatrix
from torchmbd.multibody.bodies import FlexibleBody
from torchmbd.multibody.bodies.reduced import matrices
from torchmbd.multibody.statics.supported_body import SupportedBody, Supports
from torchmbd.summary import Summary, few

RIGID_MOTIONS = 6  # of a free body
ZERO = 1e-12  # stiffness of a shape over the sum of the sizes of its terms; rounding leaves 1e-16 to 5e-13, as was measured


@dataclass(frozen=True, eq=False, repr=False)
class NaturalModes(Summary):
    """The result of `natural_frequencies`.

    frequencies  [*lanes, number] [Hz], ascending
    shapes       of the vibrations [*lanes, nodes, 6, number], largest displacement 1
    status       "ok", or which rigid motions are left out

    >>> steel = mbd.Ply.isotropic(E=210e9, nu=0.3, density=7850.0)
    >>> sheet = mbd.FlexibleBody.plate("sheet", mbd.mesh.rectangle(0.4, 0.2, (8, 4)), mbd.Laminate(steel, [0.0], 2e-3))
    >>> free = mbd.natural_frequencies(sheet, {})
    >>> free.shapes.shape, free.status
    (torch.Size([45, 6, 1]), 'six rigid motions of the free body are left out')
    """

    frequencies: Float[Tensor, "*lanes number"]
    shapes: Float[Tensor, "*lanes nodes 6 number"]
    status: str

    def _summary(self) -> list[tuple[str, str]]:
        first = self.frequencies.reshape(-1, self.frequencies.shape[-1])[0].tolist()
        *lanes, _, _, _ = self.shapes.shape
        of = "of the first lane " if lanes else ""
        listed = f"{of}{few([f'{f:.4g}' for f in first])} Hz"
        return [("status", self.status), ("frequencies", listed), ("shapes", f"tensor {list(self.shapes.shape)}")]


def natural_frequencies(body: FlexibleBody, supports: Supports | None = None, number: int = 1) -> NaturalModes:
    """Find the lowest natural frequencies of a body on supports; differentiable with respect to its parameters.

    body      a FlexibleBody of elements
    supports  nodes -> supported degrees of freedom, as "u1 u3 phi2", or "all"; or six numbers, 0 for a supported degree of
              freedom, None for a free one. Nodes: a node, a set, or a tuple of these. None: the reference nodes of the body
              are clamped; {}: it is free
    number    of frequencies
    Raises InputError if arguments are wrong, or if the supports leave a rigid-body motion free.

    >>> steel = mbd.Ply.isotropic(E=210e9, nu=0.3, density=7850.0)
    >>> tube = mbd.sections.tube(0.02, steel, [0.0], 1e-3)
    >>> beam = mbd.FlexibleBody.beam("beam", mbd.BeamLine.straight(2.0, 16), tube, reference="start")
    >>> found = mbd.natural_frequencies(beam, {"start": "u1 u2 u3 phi1", "end": "u2 u3"})
    >>> EI, m = tube.stiffness()[4, 4], tube.mass()[0, 0]
    >>> round((found.frequencies[0] / (torch.pi / 2 / 2.0**2 * (EI / m).sqrt())).item(), 2)  # pi / (2 l^2) sqrt(EI / m)
    1.0
    """
    return outside_transforms(lambda: VibrationCase(body, supports))(number)


class VibrationCase:
    """A body on supports, ready to find its frequencies in any design: `case(number)`.

    body, supports as in `natural_frequencies`. Raises InputError if these are wrong.
    """

    def __init__(self, body: FlexibleBody, supports: Supports | None = None) -> None:
        self.supported = supported = SupportedBody(body, supports, vibrating=True)
        self.rigid = 0 if supports is None or len(supports) else RIGID_MOTIONS
        if not supported.assembly.diagonal:
            self._mass_pattern, self._mass_positions = supported.assembly.mass_pattern.restrict(supported.kept)

    @property
    def most(self) -> int:
        """Number of frequencies."""
        return self.supported.pattern.size - self.rigid

    def __call__(self, number: int = 1) -> NaturalModes:
        """The lowest frequencies, and shapes, of the present design.

        Raises InputError if the supports leave the body movable, or number is not possible.
        """
        supported = self.supported
        if not is_whole(number) or not 1 <= number <= self.most:
            allowed = f"1 to {self.most}, the degrees of freedom that {supported.name!r} has on its supports"
            raise InputError("number", number, allowed)
        K, M = self._matrices()
        first, end = self.rigid, self.rigid + int(number)
        basis = _whole_clusters(K, M, end)
        squares = eigenvalues(basis.stiffness)[..., first:end]
        vectors = basis.vectors.detach()[..., first:end]
        terms = (vectors.abs() * (_sizes(K) @ vectors.abs())).sum(-2)
        known = untransformed(squares.detach() > ZERO * terms)
        zero = ~known.reshape(-1, known.shape[-1])
        if bool(zero.any()):
            lane, mode = zero.nonzero()[0].tolist()
            row = int(untransformed(vectors).reshape(-1, *vectors.shape[-2:])[lane, :, mode].abs().argmax())
            fault = f"a frequency{lane_name(lane, len(zero))} is zero, so the supports leave a rigid-body motion free"
            raise supported.free_at(fault, row)
        status = "six rigid motions of the free body are left out" if self.rigid else "ok"
        return NaturalModes(squares.sqrt() / (2.0 * math.pi), supported.shapes(vectors), status)

    def _matrices(self) -> tuple[SparseMatrix, Matrix]:
        """Stiffness and mass of the degrees of freedom without supports."""
        K, M = matrices(self.supported.assembly)
        if isinstance(M, Tensor):
            return self.supported.restricted(K), M[..., self.supported.kept]
        values = M.values[..., self._mass_positions]
        return self.supported.restricted(K), SparseMatrix(self._mass_pattern, values, M.symmetric)


def _whole_clusters(K: SparseMatrix, M: Matrix, n: int) -> ModalBasis:
    """The n lowest modes, and the further ones of a cluster in any lane: frequencies that are equal share their derivatives."""
    while True:
        try:
            return modal_basis(K, M, n)
        except CutCluster as error:
            n = error.beyond


def _sizes(K: SparseMatrix) -> SparseMatrix:
    """The sizes of the entries, without derivatives."""
    return replace(K, values=K.values.detach().abs())
