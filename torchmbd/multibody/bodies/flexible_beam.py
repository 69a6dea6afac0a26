"""A geometrically exact beam in a system: rigid bodies at its nodes, elements of finite rotations between them.

The elements are those of ExactBeam (fem/exact_beam/forces.py), in system/beams.py; the mass of each half element belongs to the
rigid body of its node (fem/exact_beam/half_elements.py). So joints, forces and drives act on nodes as on any rigid body.
Rigid motions have their exact momentum and energy and no strain; displacements and frequencies converge with h^2.
Checked in tests/multibody/bodies/test_flexible_beam.py, tests/validation/test_flexible_beam.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.fem.elements import BeamLine
from torchmbd.fem.elements.beam_line import varying_nodes
from torchmbd.fem.exact_beam import ExactBeam
from torchmbd.fem.exact_beam.half_elements import half_element_masses
from torchmbd.fem.exact_beam.sections import ElementProperties
from torchmbd.math.checked_numbers import nonnegative as zero_or_positive
from torchmbd.math.variable import is_variable, number, stacked
from torchmbd.multibody.bodies.frame import Frame, identifier, rotation, set_start, vector
from torchmbd.multibody.bodies.rigid import RigidBody


def _lanes(x: float | Tensor) -> torch.Size:
    return x.shape if isinstance(x, Tensor) else torch.Size()


class BeamNode(RigidBody):
    """Node number `index` of a beam, whose inertia comes from the beam."""

    def __init__(self, beam: FlexibleBeam, index: int):
        nn.Module.__init__(self)
        self._beam, self.index = [beam], index  # in a list, so that the beam is no submodule of its node
        self.name = f"{beam.name}_{index}"
        self.register_buffer("center", torch.zeros(3, dtype=torch.float64))

    @property
    def beam(self) -> FlexibleBeam:
        """The beam."""
        return self._beam[0]

    def invariants(self, about: Tensor | None = None) -> dict[str, Tensor]:
        """Inertia of the node about its origin, as in `FlexibleBeam.structure`."""
        assert about is None
        return self.beam.structure().inertia(self.index)


class Structure(NamedTuple):
    """A beam in the present design.

    mass, first, second   moments of the nodes;   data   of its elements [*lanes, m, ...]
    """

    mass: Float[Tensor, "*lanes n"]
    first: Float[Tensor, "*lanes n 3"]
    second: Float[Tensor, "*lanes n 3 3"]
    data: dict[str, Tensor]
    elements: ElementProperties

    def inertia(self, node: int) -> dict[str, Tensor]:
        """Invariants of a node, keys as in `RigidBody.invariants`."""
        m = self.mass[..., node]
        moments = {"S0": self.first[..., node, :], "P0": self.second[..., node, :, :]}
        return {"mass": m, "mu": torch.zeros_like(m)} | moments


class FlexibleBeam(ExactBeam):
    """A beam of finite displacements and rotations, as a body of a System.

    name, line, section, orientation, offset, twist   as in ExactBeam; the line must not vary with the design
    position, axes    initial origin of the mesh axes in ground axes [m] and their rotation; the beam starts without strain
    velocity          initial velocity of that origin in ground axes [m/s]; None: the smallest that the joints allow
    angular_velocity  initial angular velocity of the beam as a rigid body, in mesh axes [rad/s]; None: the smallest
    damping           time [s]: section forces grow by stiffness x damping x rate of strain; mbd.variable(...): "NAME.damping"

    `at(node)` is a frame for joints and forces. Nodes are bodies of the system, called "NAME_0", "NAME_1", ...: they have
    positions, velocities and all other histories. `motion.body(NAME)` has displacements and section forces of the beam.
    No element may turn by more than 2.6 rad. Parameters are those of ExactBeam: "NAME.section.angles", "NAME.twist".

    >>> rod = mbd.GivenSection.isotropic(E=210e9, nu=0.3, density=7850.0, area=1e-4, Iyy=1e-9, Izz=1e-9, J=2e-9)
    >>> rotor = mbd.FlexibleBeam("rotor", mbd.BeamLine.straight(1.0, elements=4), rod)
    >>> hinge = mbd.Revolute(mbd.Ground().at(), rotor.at("start"), axis="z", name="hinge")
    >>> motion = mbd.simulate(mbd.System([rotor], [hinge], [mbd.Torque(rotor.at("start"), (0, 0, 5.0))]), 0.1, steps=50)
    >>> motion.body("rotor").forces.shape  # lanes, times, elements, ends, (N, V_y, V_z, T, M_y, M_z)
    torch.Size([1, 51, 4, 2, 6])
    """

    nonnegative: ClassVar[tuple[str, ...]] = ("damping",)  # parameters that are, in every design

    def __init__(
        self,
        name: str,
        line: BeamLine,
        section: Any,
        orientation: Sequence[float] | Tensor = (0.0, 1.0, 0.0),
        offset: Sequence[float] | Tensor = (0.0, 0.0),
        twist: float | Sequence | Tensor = 0.0,
        position: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
        axes: Sequence | Tensor | None = None,
        velocity: Sequence[float] | Tensor | None = None,
        angular_velocity: Sequence[float] | Tensor | None = None,
        damping: float | Tensor = 0.0,
    ) -> None:
        super().__init__(identifier("flexible beam", name), line, section, orientation, offset, twist)
        if varying_nodes(line):
            raise InputError(
                (name, "line"),
                allowed="fixed",
                state="varies with the design",
                noun=f"line of the flexible beam {name!r}",
                hint="an ExactBeam on its own",
            )
        time = zero_or_positive((name, "damping"), number(damping), "s")
        self.damping = damping if is_variable(damping) else time
        x0, A = vector((name, "position"), position), rotation((name, "axes"), axes)
        v, om = (
            None if x is None else vector((name, label), x)
            for label, x in (("velocity", velocity), ("angular_velocity", angular_velocity))
        )
        self.node_bodies = [BeamNode(self, k) for k in range(len(line.nodes))]
        with torch.no_grad():
            structure = self.structure()
        for node, x, m, S in zip(self.node_bodies, line.nodes, structure.mass, structure.first, strict=True):
            v0 = None if v is None and om is None else torch.zeros(3, dtype=torch.float64)
            if v0 is not None:
                v0 = (v0 if v is None else v) + A @ torch.linalg.cross(v0 if om is None else om, x)
            set_start(
                node, x0 + A @ x, A, v0, om if om is not None or v is None else torch.zeros(3, dtype=torch.float64)
            )
            node.center = S / m

    def at(self, node: str | int, axes: Sequence | Tensor | None = None) -> Frame:
        """Frame at a node, by name or number; `axes`: columns of its triad in mesh axes (default: these).

        node  of the line, such as "start", "end" of a chain, or 0, 1, ...
        """
        number = self.mesh.node(node) if isinstance(node, str) else node
        if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < len(self.node_bodies):
            raise InputError((self.name, "node"), node, f"a name, or 0 to {len(self.node_bodies) - 1}")
        return self.node_bodies[number].at(axes=axes)

    def structure(self) -> Structure:
        """Inertia of the nodes and data of the elements in the present design.

        >>> rod = mbd.GivenSection.isotropic(E=210e9, nu=0.3, density=7850.0, area=1e-4, Iyy=1e-9, Izz=1e-9, J=2e-9)
        >>> beam = mbd.FlexibleBeam("beam", mbd.BeamLine.straight(1.0, elements=4), rod)
        >>> float(beam.structure().mass.sum())  # [kg]
        0.785
        """
        elements = self._elements()
        nodal = half_element_masses(self.mesh, self.sections, elements)
        data = {
            "beam_stiffness": elements.stiffness,
            "beam_rest": elements.screws,
            "beam_start": elements.axes[..., 0, :, :],
            "beam_end": elements.axes[..., 1, :, :],
        }
        if isinstance(self.damping, Tensor) or self.damping:
            data["beam_damping"] = stacked([self.damping]).expand(*_lanes(self.damping), len(self.mesh.elements))
        return Structure(*nodal, data, elements)
