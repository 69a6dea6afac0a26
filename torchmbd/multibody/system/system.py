"""A system: bodies, joints and forces. Calling it returns its equations of motion dy/dt = f(t, y), a torch module.

The design variables are the parameters of the module by their names, for example `rod.laminate.angles`. Bodies that
share a laminate share its angles. A batch of designs is the same module with leading lane axes on its parameters:

    dynamics = system.dynamics({"rod.laminate.angles": angles}, tangents=True)     angles [lanes, layers]
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from torchmbd.errors import InputError, keyword_hints, one_of, unknown
from torchmbd.fixed_arguments import FixedArguments
from torchmbd.math.checked_numbers import list_of, positive
from torchmbd.math.gradients import refuse_derivatives
from torchmbd.math.module_call import call_module, exclusive, outside_transforms
from torchmbd.math.plausible_units import warn_gravity
from torchmbd.math.variable import law_key
from torchmbd.multibody.bodies import FlexibleBody, RigidBody
from torchmbd.multibody.bodies.flexible_beam import BeamNode, FlexibleBeam
from torchmbd.multibody.bodies.frame import MODAL, VELOCITIES, has_modal_start, register, vector_or_parameter
from torchmbd.multibody.equations import arrangement
from torchmbd.multibody.equations.beams import beam_data
from torchmbd.multibody.equations.data import INERTIA
from torchmbd.multibody.equations.modal_data import (
    frame_nodes,
    modal_data,
    second_order_data,
    stack_bodies,
    vector_modes,
)
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.forces.beam_chain import BeamChain
from torchmbd.multibody.forces.force import ForceElement
from torchmbd.multibody.joints.joint import AttachmentTable, Joint
from torchmbd.multibody.saddle.matrix import Saddle
from torchmbd.multibody.start.initial import start_of_bodies
from torchmbd.multibody.start.modal_start import in_moving_basis
from torchmbd.multibody.start.start import POSE, Start
from torchmbd.multibody.system.description import Description, check_connected, describe
from torchmbd.multibody.system.design_variables import refuse_lost_constants, refuse_lost_laws, tangents_of
from torchmbd.multibody.system.diagram import html
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.multibody.system.state_equation import StateEquation, unchanged, with_copies

_START_VARIABLES = ("position", *VELOCITIES, *MODAL)  # numbers of the initial state that can be design variables
_START = (*POSE, *VELOCITIES, *MODAL)  # all numbers of the initial state


@keyword_hints
class System(FixedArguments, nn.Module):
    """Bodies joined by joints.

    bodies         rigid and flexible bodies and flexible beams; their names are unique
    joints         between frames of these bodies and the ground
    forces         force elements between frames of these bodies and the ground
    gravity        acceleration of gravity in ground axes [m/s2]; a torch.nn.Parameter is a design variable, "gravity"
    stabilization  time constant of the constraint stabilization of ODE methods [s]
    free           names of bodies that are meant to be without joints
    truncation     the first motion warns if the retained modes are too stiff at joints and forces by more than this share, 0
                   to 1 (`mbd.static_truncation`); None: no check

    >>> ground, bob = mbd.Ground(), mbd.RigidBody("bob", 1.0, (0.01, 0.01, 0.01), position=(0, -1, 0))
    >>> hinge = mbd.Revolute(ground.at(), bob.at(0, 1, 0), axis="z", name="hinge")
    >>> system = mbd.System([bob], [hinge], gravity=(0, -9.81, 0))
    >>> found = system.describe()  # print(found) shows it as tables
    >>> found.rank, found.freedoms
    (5, 1)
    """

    joints: tuple[Joint, ...]
    gravity: Tensor | None
    free_arguments: ClassVar = ("stabilization", "truncation")
    #: Attributes that follow from bodies, joints, forces and start (math/digest.py); the last three fill while they are used.
    derived_state: ClassVar = (
        "topology",
        "_saddle",
        "_initial",
        "_joined_with",
        "_topology_tensors",
        "_of_modes",
        "segments_of_phases",
        "diagnosed",
    )

    def __init__(
        self,
        bodies: Sequence[Any],
        joints: Sequence[Joint] = (),
        forces: Sequence[ForceElement] = (),
        gravity: Sequence[float] | Tensor | None = None,
        stabilization: float = 5e-3,
        free: Sequence[str] = (),
        truncation: float | None = 0.1,
    ):
        super().__init__()
        self._start = Start()
        self._mode_counts: tuple[int, ...] | None = None  # of each flexible body; None: those of the first design
        self.diagnosed: dict[
            str, Any
        ] = {}  # what diagnosis/ knows of it, also of copies with the same joints and forces
        bodies, joints, forces, free = (
            list_of(name, items, kinds, allowed)
            for name, items, kinds, allowed in (
                ("bodies", bodies, (RigidBody, FlexibleBody, FlexibleBeam), "bodies, such as mbd.RigidBody(...)"),
                ("joints", joints, Joint, "joints, such as mbd.Revolute(...)"),
                ("forces", forces, ForceElement, "force elements, such as mbd.SpringDamper(...)"),
                ("free", free, str, "names of bodies"),
            )
        )
        if not bodies:
            raise InputError("bodies", bodies, "must contain at least one body", state="is empty")
        # Bodies and forces of another system may be given, with the nodes and elements of its beams: a first node is its beam.
        bodies = [
            body.beam if isinstance(body, BeamNode) else body
            for body in bodies
            if not (isinstance(body, BeamNode) and body.index)
        ]
        forces = [force for force in forces if not (isinstance(force, BeamChain) and force.beam in bodies)]
        self.beams = tuple(body for body in bodies if isinstance(body, FlexibleBeam))
        check_connected(bodies, joints, forces, free)
        bodies = [part for body in bodies for part in (body.node_bodies if isinstance(body, FlexibleBeam) else [body])]
        forces = [*forces, *map(BeamChain, self.beams)]
        names = [body.name for body in (*bodies, *self.beams)]
        for name in names:
            if names.count(name) > 1:
                raise InputError(
                    "bodies", name, "unique", state=f"is used {names.count(name)} times", noun=f"body name {name!r}"
                )
        self.bodies = tuple(bodies)
        register(self, "gravity", None if gravity is None else vector_or_parameter("gravity", gravity))
        if self.gravity is not None:
            warn_gravity(self.gravity)
        self.stabilization = positive("stabilization", stabilization, "s")
        self.truncation = None if truncation is None else positive("truncation", truncation, "")
        self.forces = tuple(forces)
        self._join(joints)
        for body in (*self.bodies, *self.beams):
            if hasattr(self, body.name) or hasattr(StateEquation, body.name) or body.name == "data":
                raise InputError(
                    "bodies",
                    body.name,
                    "any other identifier",
                    state="is taken by torchmbd",
                    noun=f"body name {body.name!r}",
                )
        for body in self.bodies:
            self.add_module(body.name, body)
        self._add_laws()
        self._topology_tensors = self._tensors()
        self.register_load_state_dict_post_hook(_rebuild_topology)

    def _add_laws(self) -> None:
        """Register the modules with the design variables of joints and forces, by the names of these and of their frames."""
        elements = [*self.joints, *self.forces]
        names = [element.name for element in elements]
        axes_in_use = [attached.varying for attached in self.topology.attached if not attached.is_point]
        for element in elements:
            frames = () if getattr(element, "joints", ()) else element.frames  # those of a coupling are of its joints
            for side, frame in zip("ab", frames, strict=False):
                if frame.varying is not None and frame.varying.record.turns and frame.varying not in axes_in_use:
                    raise InputError(
                        (element.name, "turn"),
                        allowed="the turn of the other frame, or numbers",
                        state="is a design variable, but no axis of this frame is used, because joints take the axes of their "
                        "first frame",
                        noun=f"turn of frame {side} of {element.name!r}",
                    )
            modules = {f"{element.name}_{side}": frame.varying for side, frame in zip("ab", frames, strict=False)}
            modules |= {element.name: None if element.variables is None else element.variables.module}
            for name, module in modules.items():
                if module is None:
                    continue
                taken = names.count(element.name) > 1 or hasattr(self, name) or hasattr(StateEquation, name)
                if taken or "." in name:
                    raise InputError(
                        (element.name,),
                        allowed="must have an explicit name without a point, because its design variables get this name",
                        noun=repr(element.name),
                        state="has design variables",
                    )
                self.add_module(name, module)

    def _join(self, joints: Sequence[Joint]) -> None:
        vars(self)["joints"] = tuple(joints)
        topology = arrangement.build(self.bodies, self.joints, self.forces)
        self._take(topology if self._mode_counts is None else topology.with_modes(self._mode_counts))
        self._joined_with = with_copies(self._constants_of_start())

    def _take(self, topology: Topology) -> None:
        """Have a topology of these bodies, joints and forces, and what follows from it."""
        self.topology = topology
        ordered = [self.body(name) for name in self.topology.names]
        self._saddle = Saddle(self.topology)
        self._initial = self._start.conditions(self.topology, ordered)
        self._of_modes: dict[tuple[int, ...], Self] = {}  # the same system for designs with other numbers of modes
        self.segments_of_phases: list[tuple[tuple, Any]] = []  # kept by integrate/phases/segment.py

    def _constants_of_start(self) -> list[Tensor]:
        """Positions, axes, rates and modal coordinates of the bodies that are not design variables."""
        return [body._buffers[name] for body in self.bodies for name in _START if name in body._buffers]

    @exclusive
    def join_again(self) -> None:
        """Join the bodies again if the constants of their start have changed, on which joints and the initial state depend."""
        if not unchanged(self._joined_with, self._constants_of_start()):
            refuse_lost_constants(self)
            self._join(self.joints)

    def with_joints(self, joints: Sequence[Joint]) -> Self:
        """The same bodies, forces and parameters under other joints; bodies and parameters are shared."""
        other = copy.copy(self)
        other.diagnosed = {}
        other._join(list_of("joints", joints, Joint, "joints, such as mbd.Revolute(...)"))
        return other

    def starting(self, start: Start) -> Self:
        """The same system with another initial state of its motions; bodies and parameters are shared."""
        other = copy.copy(self)
        other._start = start
        other._join(self.joints)
        return other

    def with_modes(self, mode_counts: tuple[int, ...]) -> Self:
        """The same system for designs whose flexible bodies retain other numbers of modes; bodies and parameters are shared."""
        if mode_counts == self.topology.mode_counts:
            return self
        if mode_counts not in self._of_modes:
            other = copy.copy(self)
            other._mode_counts = mode_counts
            outside_transforms(lambda: other._take(self.topology.with_modes(mode_counts)))
            self._of_modes[mode_counts] = other
        return self._of_modes[mode_counts]

    @exclusive
    def describe(self) -> Description:
        """Bodies, joints, rank, degrees of freedom, mass and first frequencies: print it, or use its numbers.

        >>> print(mbd.examples.pendulum().describe())
        body  kind   mass [kg]  modes
        bob   rigid  1          0
        ...
        rows        5, rank 5
        redundant   none
        freedoms    1 (1 of rigid bodies)
        ...
        """
        return describe(self)

    def _repr_html_(self) -> str:
        return html(self)

    def body(self, name: str) -> Any:
        """The body, or the flexible beam, of that name; InputError names the nearest."""
        named = {body.name: body for body in (*self.bodies, *self.beams)}
        return named[one_of("body", name, named)]

    @exclusive
    def forward(self, part: str | None = None) -> Any:
        """The equations of motion as a module (state_equation.py).

        For module_call.call_module, which calls the system with given parameters, also results of the structure stage:
        part="data": the data of the motion; "stages": these, and the structures of all flexible bodies by name; the name of a
        flexible body or beam: its structure.
        """
        if part is None:
            system = self._with_present_numbers()
            equation = StateEquation(dict(system.named_children()), system._parameters, system._present_dynamics)
            equation.register_load_state_dict_post_hook(functools.partial(_rebuild_topology_of, system))
            return equation
        if part not in ("data", "stages"):
            return self.body(part).structure()
        T = self.topology
        structures = {
            name: self.body(name).structure(frame_nodes(T, i)) for i, name in enumerate(T.names[: T.flexible])
        }
        data = self._data(list(structures.values()))
        return data if part == "data" else (data, structures)

    def _with_present_numbers(self) -> Self:
        """Itself, or a copy that keeps the tensors that torch.func.functional_call puts in the place of others for one call."""
        present = self._tensors()
        if present.keys() == self._topology_tensors.keys() and all(
            x is self._topology_tensors[name] for name, x in present.items()
        ):
            return self
        return outside_transforms(lambda: copy.deepcopy(self, {id(x): x for x in present.values()}))

    def _tensors(self) -> dict[str, Tensor]:
        """Parameters and buffers by name."""
        return dict(self.named_parameters()) | dict(self.named_buffers())

    @exclusive
    def _present_dynamics(self, numbers: Mapping[str, Tensor]) -> Dynamics:
        """Structure stage of the present parameters, one design; numbers: in the place of parameters of the system itself."""
        self._check()
        data, structures = call_module(self, numbers, "stages")
        return self._dynamics(data, _mode_counts(structures.values()))

    @exclusive
    def reduced(self, parameters: Mapping[str, Tensor]) -> Dynamics:
        """Structure stage of a batch of designs, name -> values [lanes, ...], differentiable by torch in every mode."""
        return self.stages(parameters)[0]

    @exclusive
    def stages(self, parameters: Mapping[str, Tensor]) -> tuple[Dynamics, dict[str, Tensor]]:
        """The dynamics of `reduced`, and the mode shapes [lanes, nodes, 6, modes] of the flexible bodies by their names."""
        self._check()
        data, structures = call_module(self, parameters, "stages")
        shapes = {name: structure["psi"] for name, structure in structures.items()}
        return self._dynamics(_for_all_lanes(data, parameters), _mode_counts(structures.values())), shapes

    def equations(self) -> Dynamics:
        """The equations of motion without data of a design."""
        return Dynamics(self.topology, self._saddle, {}, self._initial, self.stabilization)

    def _dynamics(self, data: dict[str, Any], mode_counts: tuple[int, ...]) -> Dynamics:
        """The equations of motion with the data of designs whose flexible bodies have so many modes."""
        return replace(self.with_modes(mode_counts).equations(), data=data)

    @exclusive
    def dynamics(self, parameters: Mapping[str, Tensor] | None = None, tangents: Sequence[str] = ()) -> Dynamics:
        """Structure stage of a batch of designs.

        parameters  name -> values [lanes, ...]; others keep their present values
        tangents    names among them: the data carry derivatives with respect to all entries of these, flattened in this order
        """
        self._check()
        module_parameters = dict(self.named_parameters())
        batch = dict(parameters or {})
        for name, x in module_parameters.items():
            if x.dtype != torch.float64:
                raise InputError(
                    name,
                    x.dtype,
                    "torch.float64, the type of the system",
                    noun=f"parameter {name!r}",
                    shown=f"{x.dtype}",
                )
        for name, x in batch.items():
            if name not in module_parameters:
                raise unknown("parameter", name, module_parameters)
            if x.shape[1:] != module_parameters[name].shape:
                sizes = ", ".join(map(str, module_parameters[name].shape))
                raise InputError(
                    name,
                    x,
                    f"must have shape [lanes, {sizes}]",
                    noun=f"parameter {name!r}",
                    state=f"has shape {tuple(x.shape)}",
                )
            refuse_derivatives(f"parameter {name!r}", x, f"tangents=[{name!r}], or system() in reverse mode")
        lanes = {name: x.shape[0] for name, x in batch.items()}
        if len(set(lanes.values())) > 1:
            raise InputError(
                "lanes", lanes, "the same number for all", noun="lanes of the parameters", state=f"are {lanes}"
            )
        for name in tangents:
            if name not in batch:
                raise InputError(
                    "tangents", name, f"must name some of the given parameters, {list(batch)}", state=f"names {name!r}"
                )

        mode_counts: list[tuple[int, ...]] = []  # of the calls of the stage, one number for each body

        def stage(values: dict[str, Tensor]) -> dict[str, Tensor]:
            of_designs, structures = call_module(self, values, "stages")
            mode_counts.append(_mode_counts(structures.values()))
            return _for_all_lanes(of_designs, values)

        with torch.no_grad():
            if tangents:
                fixed = {name: x for name, x in batch.items() if name not in tangents}
                data = tangents_of(lambda moving: stage(fixed | moving), {name: batch[name] for name in tangents})
            else:
                data = stage(batch)
        return self._dynamics(data, mode_counts[-1])

    def _check(self) -> None:
        """Join again where that is due; InputError for what is differentiated and cannot be (design_variables.py)."""
        refuse_lost_constants(self)
        self.join_again()
        refuse_lost_laws(self)

    def _data(self, stages: list[dict[str, Tensor]]) -> dict[str, Tensor]:
        """Data of the motion (`Dynamics.data`), out of the structures of the flexible bodies."""
        T = self.topology.with_modes(_mode_counts(stages))
        flexible = [self.body(name) for name in T.names[: T.flexible]]
        rigid = [self.body(name) for name in T.names[T.flexible :]]
        beams = {beam.name: beam.structure() for beam in self.beams}
        inertia = [
            *stages,
            *(
                beams[b.beam.name].inertia(b.index) if isinstance(b, BeamNode) else b.invariants(T.base_point(i))
                for i, b in enumerate(rigid, T.flexible)
            ),
        ]
        data = {key: stack_bodies([stage[key] for stage in inertia], rank) for key, rank in INERTIA.items()}
        if flexible:
            data |= modal_data(
                stages,
                [b.damping.matrix(s["Kr"], s.get("loss")) for b, s in zip(flexible, stages, strict=True)],
                T.modes,
            )
            data["Y"] = vector_modes(T, stages)
            if any("F1" in stage for stage in stages):
                data |= second_order_data(T, stages)
        x = T.vectors_in_design()
        data["x"] = stack_bodies(x, 1) if x else torch.zeros(3, 0, 1, 1, dtype=torch.float64)
        for element in (*self.joints, *self.forces):
            if element.variables is not None and getattr(element, "variables_in_laws", True):
                data[law_key(element.name)] = element.variables.flat()
        if (
            any(map(has_modal_start, flexible))
            or any(name in body._parameters for body in self.bodies for name in _START_VARIABLES)
            or self._start.tensors
        ):
            start = start_of_bodies(T, [*flexible, *rigid])
            start |= self._start.data(T, [*flexible, *rigid], start)
            if not self._start.is_guess:
                stiffness = {body.name: stage["Kr"] for body, stage in zip(flexible, stages, strict=True)}
                start = in_moving_basis(T, stiffness, self._start.stiffness, start)
            data |= start
        if T.beams is not None:
            forces = [force for force in self.forces if force.beams(AttachmentTable())]
            data |= beam_data([beams[f.name].data if isinstance(f, BeamChain) else f.beam_data() for f in forces])
        if self.gravity is not None:
            data["gravity"] = stack_bodies([self.gravity], 1)
        return data


def _mode_counts(structures: Iterable[dict[str, Tensor]]) -> tuple[int, ...]:
    """The numbers of modes in the structures of the flexible bodies, of the design that retains most."""
    return tuple(structure["Kr"].shape[-1] for structure in structures)


def _rebuild_topology(system: System, _: Any) -> None:
    """Hook after loading a state dict: positions may have changed. No method, as a hook must be picklable."""
    system._topology_tensors = system._tensors()
    system._join(system.joints)


def _rebuild_topology_of(system: System, *_: Any) -> None:
    """The same for the StateEquation of a system."""
    _rebuild_topology(system, None)


def _for_all_lanes(data: dict[str, Tensor], designs: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Data with as many lanes as there are designs, even where no data depend on the design, as with strengths of plies."""
    lanes = max((x.shape[0] for x in designs.values()), default=1)
    mass = data["mass"]
    return data if mass.shape[-1] == lanes else data | {"mass": mass.expand(*mass.shape[:-1], lanes)}
