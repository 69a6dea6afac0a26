"""Linear buckling of a flexible body: factors of its loads at which it has a second equilibrium, and the shapes.

    K u = f,      (K + factor Kg(u)) shape = 0

K, Kg     stiffness and geometric stiffness (fem/elements/geometric.py) on the degrees of freedom without supports
u         displacements under the loads and the displacements of supports; supports do not move in buckling. A change of
          temperature or moisture adds the loads of its free strains, whose stress Kg does not have (expansion_loads.py)
1/factor  are eigenvalues of -Kg shape = (1/factor) K shape, so the factors of loads that only stiffen are infinite

Factors are differentiable, forward and reverse, in every parameter of the body, through K, u and Kg. Where factors coincide
each has the mean of their derivatives (fem/reduction/spectral.py). Shapes are numbers without a derivative.
Assumed: u is small; the loads grow together, forces keep their directions, moments on beams turn by half of the rotation of
their node (semitangential: J. H. Argyris and others, Comput. Methods Appl. Mech. Eng. 14 (1978) 401-451).
Source: O. C. Zienkiewicz and R. L. Taylor, The Finite Element Method, vol. 2.
Checked in tests/extensions/buckling/test_buckling.py, tests/extensions/buckling/test_closed_forms.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.extensions.buckling.eigenproblem import eigenproblem
from torchmbd.extensions.buckling.expansion_loads import Changes, ExpansionLoads
from torchmbd.extensions.buckling.nodal_loads import Loads, NodalLoads
from torchmbd.fem.reduction import StaticLoads
from torchmbd.math.checked_numbers import is_whole
from torchmbd.math.gradients import all_true
from torchmbd.math.module_call import outside_transforms
from torchmbd.multibody.bodies import FlexibleBody
from torchmbd.multibody.statics.supported_body import SupportedBody, Supports
from torchmbd.summary import Summary, few


@dataclass(frozen=True, eq=False, repr=False)
class BucklingModes(Summary):
    """The result of `linear_buckling`.

    factors        buckling factors of the loads [*lanes, number] [-], ascending; inf if the body does not have another
                   buckling shape
    shapes         buckling shapes [*lanes, nodes, 6, number], largest displacement 1; zero where there is none
    displacements  static displacements under the loads [*lanes, nodes, 6] [m, rad]
    status         "ok", or why factors are infinite

    >>> steel = mbd.Ply.isotropic(E=210e9, nu=0.3, density=7850.0)
    >>> tube = mbd.sections.tube(0.02, steel, [0.0], 1e-3)
    >>> column = mbd.FlexibleBody.beam("column", mbd.BeamLine.straight(2.0, 4), tube, reference="start")
    >>> found = mbd.buckling.linear_buckling(column, {"end": (1.0, 0.0, 0.0)})  # a pull
    >>> found.factors.item(), found.status
    (inf, 'no buckling: the loads stiffen the body in all further shapes')
    """

    factors: Float[Tensor, "*lanes number"]
    shapes: Float[Tensor, "*lanes nodes 6 number"]
    displacements: Float[Tensor, "*lanes nodes 6"]
    status: str

    def _summary(self) -> list[tuple[str, str]]:
        first = self.factors.reshape(-1, self.factors.shape[-1])[0].tolist()
        *lanes, _, _ = self.displacements.shape
        of = "of the first lane " if lanes else ""
        sizes = [(name, f"tensor {list(getattr(self, name).shape)}") for name in ("shapes", "displacements")]
        return [("status", self.status), ("factors", f"{of}{few([f'{x:.4g}' for x in first])}"), *sizes]


def linear_buckling(
    body: FlexibleBody,
    loads: Loads,
    supports: Supports | None = None,
    number: int = 1,
    changes: Changes | None = None,
) -> BucklingModes:
    """Find the lowest positive factors of loads at which a body buckles; differentiable with respect to its parameters.

    body      a FlexibleBody
    loads     nodes -> force [N], or force and moment [N, N m], in mesh axes, in total: 3 or 6 numbers, spread over the areas
              or lengths of the cells and sides of a node set. Nodes: a node, a set, or a tuple of these
    supports  nodes -> supported degrees of freedom, as "u1 u3 phi2", or "all"; or six numbers, imposed displacements and
              rotations [m, rad], None for a free one. None: the reference nodes of the body are clamped
    number    of factors
    changes   of temperature or moisture that grow with the loads: kind -> amount, or kind -> zone -> amount. Kinds:
              "temperature" [K], "gradient", "gradient_y" [K/m], "moisture" [-], as in mbd.Temperature. Zones: parts of the body
    Raises InputError if arguments are wrong, or if the supports leave a rigid-body motion free.

    >>> steel = mbd.Ply.isotropic(E=210e9, nu=0.3, density=7850.0)
    >>> tube = mbd.sections.tube(0.02, steel, [0.0], 1e-3)
    >>> column = mbd.FlexibleBody.beam("column", mbd.BeamLine.straight(2.0, 8), tube, reference="start")
    >>> found = mbd.buckling.linear_buckling(column, {"end": (-1000.0, 0.0, 0.0)})
    >>> euler = torch.pi**2 * tube.stiffness()[4, 4] / (2 * 2.0)**2
    >>> round((1000.0 * found.factors[0] / euler).item(), 2)  # shear
    1.0
    """
    return outside_transforms(lambda: BucklingCase(body, loads, supports, changes))(number)


class BucklingCase:
    """A body with loads and supports, ready to find its buckling factors in any design: `case(number)`.

    body, loads, supports, changes as in `linear_buckling`. Raises InputError if these are wrong.
    """

    def __init__(
        self, body: FlexibleBody, loads: Loads, supports: Supports | None = None, changes: Changes | None = None
    ) -> None:
        self.body = body
        self.supported = supported = SupportedBody(body, supports)
        self.loads = NodalLoads(body.mesh, body.name, loads)
        self.changes = ExpansionLoads(body, changes or {})
        self._imposed = supported.imposed
        self._has_imposed = bool(self._imposed.any())
        if not (self.loads.any or self._has_imposed or len(self.changes.amounts)):
            raise InputError(
                (body.name, "loads"),
                loads,
                "must have at least one force, or an imposed displacement, or a change of temperature or moisture",
                state="are zero",
            )
        self._static = StaticLoads(supported.pattern)

    def __call__(self, number: int = 1) -> BucklingModes:
        """The lowest positive factors, and shapes, of the present design.

        Raises InputError if the supports leave the body movable, or number is not possible.
        """
        supported, assembly = self.supported, self.supported.assembly
        if not is_whole(number) or not 1 <= number <= supported.pattern.size:
            allowed = (
                f"1 to {supported.pattern.size}, the degrees of freedom that {self.body.name!r} has on its supports"
            )
            raise InputError("number", number, allowed)
        K = assembly.stiffness()
        inner = supported.restricted(K)
        forces = assembly.freedoms.gathered(self.loads()[..., None])
        forces = forces - K @ self._imposed if self._has_imposed else forces
        free = assembly.freedoms.gathered(self.changes.forces())
        lanes = np.broadcast_shapes(forces.shape[:-2], free.shape[:-2])
        forces = torch.cat([x.expand(*lanes, *x.shape[-2:]) for x in (forces, free)], -1)
        try:
            u = self._static(inner, forces[..., supported.kept, :])
        except InputError as error:
            raise supported.movable(error) from None
        imposed = torch.nn.functional.pad(self._imposed, (0, len(self.changes.amounts)))
        states, share = supported.motion(u, imposed), torch.tensor([1.0, *self.changes.amounts], dtype=u.dtype)
        Kg = share @ supported.geometric(states, self.changes.parts)
        lanes = np.broadcast_shapes(inner.values.shape[:-1], Kg.shape[:-1])
        inverse, vectors = eigenproblem(
            supported.pattern, inner.values.expand(*lanes, -1), Kg.expand(*lanes, -1), number
        )
        factors, shapes = reciprocal(inverse), supported.shapes(vectors.detach())
        buckles = torch.isfinite(factors)
        status = "ok" if all_true(buckles) else "no buckling: the loads stiffen the body in all further shapes"
        return BucklingModes(factors, shapes * buckles[..., None, None, :], states @ share, status)


def reciprocal(inverse: Float[Tensor, "*lanes"]) -> Float[Tensor, "*lanes"]:
    """Factors out of their inverses; infinite where an inverse is not positive."""
    none = inverse.detach() <= 0.0
    return torch.where(none, torch.inf, 1.0 / torch.where(none, 1.0, inverse))
