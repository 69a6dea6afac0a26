"""A geometrically exact beam on its own: finite displacements and rotations under static loads.

Sections are those of fem/sections or tables of 6 x 6 matrices, lines those of all beams: straight, arcs, chains, nets with
kinks, twisted. Equations in forces.py, the search for equilibrium in continuation.py, its derivatives in solution.py.
Assumed: plane sections that keep their shape; strains are small enough for a linear section.
Checked in tests/fem/exact_beam/, tests/validation/test_exact_beam.py, tests/convergence/test_exact_beam_order.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchmbd.errors import InputError, true_or_false
from torchmbd.fem.elements import BeamLine, BeamMatrices
from torchmbd.fem.elements.beam_line import present_nodes, varying_nodes
from torchmbd.fem.elements.part import CHANGES
from torchmbd.fem.exact_beam.assemble import beam_data
from torchmbd.fem.exact_beam.continuation import STATUS, Continuation
from torchmbd.fem.exact_beam.data import BeamData, Topology
from torchmbd.fem.exact_beam.forces import element_wrenches, residual
from torchmbd.fem.exact_beam.loads import Loads, Supports, supported_freedoms
from torchmbd.fem.exact_beam.sections import ElementProperties, SpanSections, element_properties
from torchmbd.fem.exact_beam.solution import solve
from torchmbd.fem.exact_beam.vibrations import frequencies
from torchmbd.fixed_arguments import FixedArguments
from torchmbd.math.checked_numbers import is_whole, parameter, reals
from torchmbd.math.gradients import untransformed
from torchmbd.math.module_call import outside_transforms

Change = float | Sequence[float] | Tensor
_STATIONS, _TURNING = 2, 8  # of prismatic elements; of those that are twisted, tapered or arcs
_SIDES = torch.tensor([-1.0, 1.0], dtype=torch.float64)  # section forces act on the face whose normal is along the beam
_WHY = {
    "ok": "ok",
    "limit point": "limit point: no equilibrium near the last one beyond {factor:.4f} of the loads",
    "unstable": "unstable: the beam buckles at {factor:.4f} of the loads",
    "not converged": "not converged: Newton's method ends at {factor:.4f} of the loads. "
    "Try: smaller loads, or more elements",
    "turned too far": "an element turns by more than 2.6 rad beyond {factor:.4f} of the loads. Try: more elements",
}


class BeamState(NamedTuple):
    """An equilibrium of an ExactBeam; nan where there is none.

    nodes      places [*lanes, n, 3], m
    rotations  of the nodes, from their axes without load to space [*lanes, n, 3, 3]
    forces     (N, V_y, V_z, T, M_y, M_z) at start and end of each element, about its section's axes [*lanes, m, 2, 6]. Line
               loads act at the nodes, so N and V are constant in an element: the values at its middle
    reactions  forces and moments of the supports on the beam at their nodes, in mesh axes [*lanes, n, 6]
    factor     the part of the loads that was reached: 1 if the status is "ok" [*lanes]
    status     "ok", or the reason why the beam cannot carry the loads (limit point, buckling, no convergence) in the first
               lane that fails
    path       equilibria at smaller loads (of the first lane that fails, else the last): factors [k] and places [k, n, 3]

    >>> rod = mbd.GivenSection.isotropic(E=210e9, nu=0.3, density=7850.0, area=1e-4, Iyy=1e-9, Izz=1e-9, J=2e-9)
    >>> column = mbd.ExactBeam("column", mbd.BeamLine.straight(1.0, 8), rod)
    >>> state = column.equilibrium({"end": (-1000.0, 0.0, 0.0)})  # Euler: pi^2 E I / (4 L^2) = 518 N
    >>> state.status
    'unstable: the beam buckles at 0.5198 of the loads'
    """

    nodes: Float[Tensor, "*lanes n 3"]
    rotations: Float[Tensor, "*lanes n 3 3"]
    forces: Float[Tensor, "*lanes m 2 6"]
    reactions: Float[Tensor, "*lanes n 6"]
    factor: Float[Tensor, "*lanes"]
    status: str
    path: tuple[Float[Tensor, " k"], Float[Tensor, "k n 3"]]


class ExactBeam(FixedArguments, nn.Module):
    """A single beam with finite displacements and rotations (not a body of a System).

    name           for messages
    line           nodes and two-node elements, straight or arcs
    section        a Section or GivenSection (its parameters are "section.angles", ...), a SectionTable along a chain, or a list
                   of one for each element
    orientation    the sections' y-axis in mesh axes, projected across the elements: [3], or one for each [m, 3]
    offset, twist  of the section's axes from the line of the nodes: y, z [m] and angle [rad], or one for each element; twist
                   also at the start and the end of each [m, 2], and as a torch.nn.Parameter, then "twist"

    An element must not turn by more than 2.6 rad, without load and under it.

    >>> steel = mbd.GivenSection.isotropic(E=210e9, nu=0.3, density=7850.0, area=1e-5, Iyy=1e-11, Izz=1e-11, J=2e-11)
    >>> beam = mbd.ExactBeam("rod", mbd.BeamLine.straight(1.0, elements=4), steel)
    >>> state = beam.equilibrium({"end": (0, 0, 0, 0, 0, 2 * torch.pi * 210e9 * 1e-11)})  # rolls up to a circle
    >>> state.status, bool(state.nodes[-1].norm() < 1e-9)
    ('ok', True)
    """

    twist: Tensor
    offset: Tensor

    def __init__(
        self,
        name: str,
        line: BeamLine,
        section: Any,
        orientation: Sequence[float] | Tensor = (0.0, 1.0, 0.0),
        offset: Sequence[float] | Tensor = (0.0, 0.0),
        twist: float | Sequence | Tensor = 0.0,
    ) -> None:
        super().__init__()
        if not isinstance(name, str) or not name:
            raise InputError("name", name, "a string", noun="name of an ExactBeam")
        if not isinstance(line, BeamLine):
            raise InputError((name, "line"), line, "a BeamLine", state=f"is a {type(line).__name__}")
        self.name, self.mesh = name, line
        m = len(line.elements)
        self.sections = SpanSections(name, line, section)
        for key, module in self.sections.modules.items():
            self.add_module(key, module)
        if line.node_module is not None:
            self.line = line.node_module
        if isinstance(twist, nn.Parameter):
            self.twist = parameter((name, "twist"), twist)
        else:
            self.register_buffer("twist", reals((name, "twist"), twist), persistent=False)
        if self.twist.shape not in ((), (m,), (m, 2)):
            allowed = f"one angle, one for each element [{m}], or two, at its start and end [{m}, 2]"
            raise InputError(
                (name, "twist"),
                self.twist,
                allowed,
                state=f"has shape {tuple(self.twist.shape)}",
            )
        self.register_buffer("offset", reals((name, "offset"), offset), persistent=False)
        if self.offset.shape not in ((2,), (m, 2)):
            allowed = f"must have shape [2], or one for each element [{m}, 2]"
            raise InputError(
                (name, "offset"),
                self.offset,
                allowed,
                state=f"has shape {tuple(self.offset.shape)}",
            )
        plain_twist = self.twist.dim() < 2 and not isinstance(self.twist, nn.Parameter)
        simple = line.middles is None and plain_twist and not self.sections.tapered
        self._matrices = BeamMatrices(line, orientation, stations=_STATIONS if simple else _TURNING)
        with torch.no_grad():
            self._elements()

    def equilibrium(
        self,
        loads: Loads | None = None,
        follower_loads: Loads | None = None,
        line_load: Sequence | Tensor | None = None,
        follower_line_load: Sequence | Tensor | None = None,
        supports: Supports | None = None,
        gravity: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
        spin: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
        center: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
        unstable: bool = False,
        temperature: Change = 0.0,
        gradient: Change = 0.0,
        gradient_y: Change = 0.0,
        moisture: Change = 0.0,
    ) -> BeamState:
        """Find the equilibrium that is reached while all loads grow together from zero.

        loads               nodes -> force [N], or force and moment [N, N m], in mesh axes; they keep their directions
        follower_loads      loads in the axes of the section (of the first element at the node), with which they turn
        line_load           force [N/m], or force and moment, per length without load, in mesh axes: 3 or 6 numbers, or
                            as many for each element; it keeps its direction
        follower_line_load  line load in the axes of the elements' sections, with which it turns
        supports            nodes -> degrees of freedom that are held, as "u1 u2 u3", or "all"; or six numbers, displacements
                            and a rotation vector [m, rad], None where it is free. None: all of "start"
        gravity             [m/s2]
        spin, center        angular velocity [rad/s] of the supports about an axis through a point [m]: steady rotation
        unstable            True: also follow equilibria that are not stable
        temperature         change from the temperature at which the beam is free of stress, at the axis of the sections [K]:
                            a number, or one for each element
        gradient, gradient_y  change per meter along the z-axis, and along the y-axis, of the sections [K/m]
        moisture            change of the moisture, a share of the mass [-]

        Differentiable, forward and reverse, by parameters of sections, line and twist, and by loads, changes, gravity, spin
        and center that are tensors. Moments that keep their directions and follower loads have no potential: for these a
        change of the determinant's sign counts as buckling. Raises InputError if arguments are wrong.

        >>> flat = mbd.GivenSection.isotropic(E=70e9, nu=0.3, density=2700.0, area=1e-4, Iyy=1e-9, Izz=1e-10, J=3e-10)
        >>> beam = mbd.ExactBeam("strip", mbd.BeamLine.straight(1.0, 8), flat)
        >>> beam.equilibrium({"end": (0.0, 10.0, 0.0)}).nodes[-1].round(decimals=3).tolist()  # [m]
        [0.9, 0.396, 0.0]
        """
        arguments = {
            "loads": loads,
            "follower_loads": follower_loads,
            "line_load": line_load,
            "follower_line_load": follower_line_load,
            "gravity": gravity,
            "spin": spin,
            "center": center,
            "temperature": temperature,
            "gradient": gradient,
            "gradient_y": gradient_y,
            "moisture": moisture,
        }
        search, data, elements = self._problem(supports, arguments, true_or_false("unstable", unstable), massive=False)
        return self._state(search, data, solve(search, data), elements)

    def frequencies(
        self,
        number: int = 6,
        loads: Loads | None = None,
        line_load: Sequence | Tensor | None = None,
        supports: Supports | None = None,
        gravity: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
        spin: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
        center: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
        temperature: Change = 0.0,
        gradient: Change = 0.0,
        gradient_y: Change = 0.0,
        moisture: Change = 0.0,
    ) -> tuple[Float[Tensor, "*lanes number"], BeamState]:
        """The lowest frequencies [Hz] of small vibrations about an equilibrium, at rest or steadily rotating; and this state.

        number     of frequencies
        loads, line_load, supports, gravity, spin, center   as in `equilibrium`: loads that have a potential, so no moments
        temperature, gradient, gradient_y, moisture         as in `equilibrium`

        The mass of the sections is at the nodes. With a spin there are Coriolis's forces, too; vibrations are those that a
        turning observer sees. nan where there is no stable equilibrium: its status says why. Differentiable like the
        equilibrium, also where frequencies coincide: each has the mean of their derivatives.

        >>> rod = mbd.GivenSection.isotropic(E=70e9, nu=0.3, density=2700.0, area=1e-4, Iyy=1e-9, Izz=4e-9, J=3e-9)
        >>> beam = mbd.ExactBeam("rotor", mbd.BeamLine.straight(1.0, 16), rod)
        >>> rest, _ = beam.frequencies(2)
        >>> spun, state = beam.frequencies(2, spin=(0.0, 0.0, 100.0))
        >>> bool(spun[0] > 1.3 * rest[0]), state.status  # the flapping blade is stiffer
        (True, 'ok')
        """
        arguments = {
            "loads": loads,
            "follower_loads": None,
            "line_load": line_load,
            "follower_line_load": None,
            "gravity": gravity,
            "spin": spin,
            "center": center,
            "temperature": temperature,
            "gradient": gradient,
            "gradient_y": gradient_y,
            "moisture": moisture,
        }
        search, data, elements = self._problem(supports, arguments, False, massive=True)
        count = len(search.topology.free)
        if not is_whole(number) or not 1 <= number <= count:
            raise InputError(
                "number",
                number,
                f"1 to {count}, its degrees of freedom",
                noun=f"number of frequencies of {self.name!r}",
            )
        if not search.topology.symmetric:
            raise InputError(
                "loads",
                allowed="forces, in frequencies",
                state="have moments, which have no potential",
                noun=f"loads of {self.name!r}",
            )
        solution = solve(search, data)
        w = frequencies(search, data, *solution[:2], number)
        return w / (2.0 * torch.pi), self._state(search, data, solution, elements)

    def _problem(
        self, supports: Supports | None, arguments: dict[str, Any], unstable: bool, massive: bool
    ) -> tuple[Continuation, BeamData, ElementProperties]:
        """Return the search for equilibria, the data of the beam under loads, and the properties of its elements."""
        acting = [x for x in CHANGES if isinstance(arguments[x], Tensor) or arguments[x] != 0.0]
        n, elements = len(self.mesh.nodes), self._elements(acting)
        fixed, imposed = supported_freedoms(self.name, self.mesh, supports)
        free = torch.tensor([f for f in range(6 * n) if f not in set(fixed)])
        if not len(free):
            raise InputError(
                (self.name, "supports"),
                supports,
                "must leave at least one free degree of freedom",
                state="hold all degrees of freedom",
            )
        data, symmetric = beam_data(
            self.mesh, self.sections, elements, present_nodes(self.mesh), imposed, arguments, massive
        )
        search = outside_transforms(lambda: Continuation(Topology(self.mesh.elements, free, symmetric), n, unstable))
        return search, data, elements

    def _elements(self, changes: Sequence[str] = ()) -> ElementProperties:
        """Properties of the elements in the present design."""
        nodes, matrices = present_nodes(self.mesh), self._matrices
        if varying_nodes(self.mesh):
            matrices = matrices.with_nodes(nodes)
        return element_properties(self.sections, matrices, self.offset, self.twist, nodes, changes)

    def _state(
        self,
        search: Continuation,
        data: BeamData,
        solution: tuple[Tensor, Tensor, Tensor, Tensor],
        elements: ElementProperties,
    ) -> BeamState:
        x, R, factor, code = solution
        ends = element_wrenches(data, search.topology, x, R)
        forces = (elements.recover @ ends[..., None])[..., 0] * _SIDES[:, None]
        missing = residual(data, search.topology, x, R)
        held = torch.ones(missing.shape[-2] * 6, dtype=torch.bool).index_fill(0, search.topology.free, False)
        reactions = torch.where(held.reshape(-1, 6), -missing, 0.0)
        codes = untransformed(code).flatten()
        worst = next((k for k, c in enumerate(codes.tolist()) if c), len(codes) - 1)
        status = _WHY[STATUS[int(codes[worst])]].format(factor=float(untransformed(factor).flatten()[worst]))
        way = search.paths[worst]
        path = torch.tensor(way.factors, dtype=torch.float64), torch.stack(way.places)
        return BeamState(x, R, forces, reactions, factor, status, path)
