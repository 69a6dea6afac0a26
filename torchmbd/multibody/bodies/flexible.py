"""Flexible bodies in a floating frame: an assembly of finite elements reduced to vibration modes.

    u' = Psi w    (8)      Psi: modes of the body whose reference nodes are fixed to the body frame (fem/reduction/registry.py)

The structure stage of a body, once for each design: parts (fem/elements/assembly.py) -> K and M -> Psi and Kr = Psi' K Psi
-> inertia invariants, with which the motion does not depend on the mesh (fem/reduction/invariants.py).

Mass points, by default lumped as in eq. (2): nodal mass m_k and isotropic nodal rotary inertia mu_k; on arms along the
normal where the center of mass of a laminate is not on its middle surface (fem/elements/plates.py).
Differentiable, forward and reverse, in every parameter of the parts (fem/reduction/transport.py).
Assumed: small elastic displacements about the undeformed body.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchmbd.errors import InputError, keyword_hints, true_or_false
from torchmbd.fem.elements import (
    Assembly,
    BeamLine,
    Beams,
    BeamSection,
    Follower,
    Part,
    PlateMatrices,
    Plates,
    merge_plates,
)
from torchmbd.fem.elements.beam_line import present_nodes, varying_nodes
from torchmbd.fem.elements.links import RigidLink
from torchmbd.fem.materials import Laminate
from torchmbd.fem.mesh import MaterialAxes, Mesh
from torchmbd.fem.reduction import CutCluster
from torchmbd.fem.reduction.invariants import all_invariants, modal_invariants
from torchmbd.fixed_arguments import FixedArguments
from torchmbd.math.lane_groups import by_groups
from torchmbd.math.sparse import SparseMatrix
from torchmbd.multibody.bodies.body_memory import require_memory
from torchmbd.multibody.bodies.expansion import Expansion
from torchmbd.multibody.bodies.fitted_rotations import FittedRotations
from torchmbd.multibody.bodies.flexible_beam import FlexibleBeam
from torchmbd.multibody.bodies.frame import (
    Frame,
    identifier,
    rotation,
    set_modal_start,
    set_start,
    set_velocities,
    vector,
)
from torchmbd.multibody.bodies.interfaces import Interface, Interfaces
from torchmbd.multibody.bodies.interpolation import InterpolationConstraint, node_indices, reference_nodes, rigid_links
from torchmbd.multibody.bodies.matrix_methods import MatrixMethods
from torchmbd.multibody.bodies.mesh_quality import warn_mesh
from torchmbd.multibody.bodies.modal_damping import ModalDamping
from torchmbd.multibody.bodies.reduced import matrices, reduced
from torchmbd.multibody.bodies.stiffening import Stiffening
from torchmbd.multibody.bodies.unit_checks import warn_slender

Node = str | int
InterfaceArgument = Node | Interface | Sequence[Node | Interface] | Mapping[str, Any]


@keyword_hints
class FlexibleBody(FixedArguments, MatrixMethods, nn.Module):
    """A flexible body; made by `FlexibleBody.plate`, `.beam`, `.from_matrices` or `.from_reduced`, or by readers of files.

    The body frame sits at the reference node (the mean of several) with the axes of the mesh. Modules of parts, such as
    a laminate, are registered by their own names; where several parts have modules, by the names of the parts.

    parts   name -> part of the assembly
    links   dependent nodes, whose displacements follow from other nodes
    rigid   sets of nodes that move as one rigid body each; frames and interfaces may be on the first node, which leads the set
    name, mesh, modes, position [m], axes, reference, damping [s], reduction, interface   as in `plate`
    updated, stiffening, expansion   as in `plate`

    >>> laminate = mbd.Laminate(mbd.examples.carbon(), mbd.deg([45, -45]), thickness=1e-3)
    >>> plate = mbd.mesh.rectangle(length=0.5, width=0.05, cells=(4, 2))
    >>> body = mbd.FlexibleBody.plate("plate", plate, laminate, modes=2, reference="left_edge")
    >>> Kr = body.structure()["Kr"].detach()
    >>> (torch.linalg.eigvalsh(Kr).sqrt() / (2 * torch.pi)).round().tolist()  # natural frequencies [Hz]
    [4.0, 27.0]
    >>> [name for name, _ in body.named_parameters()]
    ['laminate.angles', 'laminate.thickness']
    """

    position: Tensor
    axes: Tensor
    velocity: Tensor
    angular_velocity: Tensor
    modal: Tensor
    modal_velocity: Tensor
    mesh: Any

    def __init__(
        self,
        name: str,
        mesh: Mesh | BeamLine,
        parts: Mapping[str, Part],
        modes: int,
        position: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
        axes: Sequence | Tensor | None = None,
        reference: str | int | Sequence[int] | None = None,
        damping: float | Tensor = 0.0,
        reduction: str = "vibration",
        interface: InterfaceArgument = (),
        updated: bool = True,
        links: Sequence[Follower] = (),
        rigid: Sequence[str | Sequence[int]] = (),
        stiffening: bool = False,
        expansion: bool | str | Sequence[str | bool] = False,
    ):
        super().__init__()
        self.name = identifier("flexible body", name)
        self.mesh = mesh
        if not isinstance(mesh, (Mesh, BeamLine)):
            raise InputError((name, "mesh"), mesh, "a Mesh or a BeamLine")
        if not isinstance(parts, Mapping) or not parts or not all(isinstance(x, Part) for x in parts.values()):
            raise InputError(
                (name, "parts"), parts, "a mapping name -> part, such as Plates or Beams, with at least one part"
            )
        set_start(self, position, axes)
        interfaces = Interfaces.of(self.name, mesh, interface)
        self.arguments = reduction, interface, links, rigid  # for refinement.py
        self.links = links = [*links, *rigid_links(mesh, rigid), *interfaces.links]
        self.parts = dict(parts)
        joined = merge_plates(self.parts)
        self.reference = reference_nodes(mesh, joined, reference, links)
        self.origin = mesh.nodes[self.reference].mean(0)
        if varying_nodes(mesh):
            if links:
                raise InputError(
                    (name, "nodes"),
                    allowed="constant, or without links",
                    state="are design variables, but some of them are linked",
                )
            self.add_module("line", mesh.node_module)  # pyright: ignore[reportAttributeAccessIssue]
        require_memory(name, len(mesh.nodes), joined.values(), modes, len(interfaces.kept))
        self._register(parts)
        self.assembly = Assembly(mesh, joined, self.reference, links, interfaces.means)
        self.free = self.assembly.freedoms.free
        self._rotations = FittedRotations.of(self.assembly)
        self.interfaces = interfaces.frames
        kept = interfaces.kept
        self.expansion, self.expansion_zones = Expansion(name, self.parts, self.assembly), expansion
        shapes = self.expansion.shapes(expansion)
        self.reduction, self.modes = reduced(
            name, self.assembly, reduction, modes, kept, self.reference, updated, shapes
        )
        stiffens = true_or_false((name, "stiffening"), stiffening)
        self.stiffening = Stiffening(name, self.assembly) if stiffens else None
        self.damping = ModalDamping(name, damping)
        set_modal_start(self, None, None)
        warn_mesh(name, self.assembly.parts.values())

    def _register(self, parts: Mapping[str, Part]) -> None:
        """Register the modules of the parts by the names that the class docstring describes."""
        owners = [key for key, part in parts.items() if part.modules()]
        for key in owners:
            modules = parts[key].modules()
            for child, module in modules.items():
                name = child if len(owners) == 1 else key if len(modules) == 1 else f"{key}_{child}"
                if hasattr(self, name):
                    raise InputError(
                        (self.name, "parts", name),
                        allowed="must have another one",
                        noun=f"part {name!r}",
                        state=f"of {self.name!r} has a name that is taken",
                    )
                self.add_module(name, module)

    @property
    def mode_counts(self) -> range:
        """The numbers of modes that designs may retain; `modes` is that of the first design."""
        reduction = getattr(self.given_structure, "reduction", None) or getattr(self, "reduction", None)
        if reduction is None:
            return range(self.modes, self.modes + 1)
        return reduction.counts

    @property
    def is_held_at_a_point(self) -> bool:
        """True if the body is held at one node of a shell: it becomes softer with each refinement and does not converge."""
        node, *others = self.reference
        leads = any(isinstance(link, RigidLink) and link.leader == node for link in self.links)
        on_beam = any(bool((part.masses().ends == node).any()) for part in self.beams.values())
        return bool(self.plates) and not (others or leads or on_beam)

    @property
    def plates(self) -> dict[str, Plates]:
        """The laminated parts by name."""
        return {key: part for key, part in self.parts.items() if isinstance(part, Plates)}

    @property
    def beams(self) -> dict[str, Beams]:
        """The parts that are beams, one for each section, by name."""
        return {key: part for key, part in self.parts.items() if isinstance(part, Beams)}

    @property
    def matrices(self) -> PlateMatrices:
        """The element matrices of a body of one laminate."""
        if len(self.plates) != 1:
            raise InputError(
                (self.name,),
                allowed="must have one",
                noun=repr(self.name),
                state=f"has {len(self.plates)} laminated parts",
                hint="plates[name].matrices",
            )
        return next(iter(self.plates.values())).matrices

    @classmethod
    def plate(
        cls,
        name: str,
        mesh: Mesh,
        laminate: Laminate,
        modes: int = 8,
        position: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
        axes: Sequence | Tensor | None = None,
        reference: str | int | Sequence[int] | None = None,
        damping: float | Tensor = 0.0,
        reduction: str = "vibration",
        interface: InterfaceArgument = (),
        updated: bool = True,
        mass: str = "lumped",
        rigid: Sequence[str | Sequence[int]] = (),
        stiffening: bool = False,
        expansion: bool | str | Sequence[str | bool] = False,
        direction: Sequence[float] | Tensor | MaterialAxes | Mapping[str, Any] = (1.0, 0.0, 0.0),
    ) -> FlexibleBody:
        """A laminated plate or shell.

        mesh            triangles or quadrilaterals
        laminate        its `angles` [rad] are parameters of the body
        modes           least number of vibration modes of the body fixed at its reference nodes (and its interface). A design
                        retains up to four more modes if their frequencies are close to the last one, such as bending of a tube
                        in two directions; `body.modes` is the number of the first design
        position, axes  approximate initial position of the reference node (of the mean of several), which is the origin of the
                        body, in ground axes [m], and rotation (columns: mesh axes); `simulate` corrects both so that the
                        joints are closed
        reference       fixed to the body frame: node, set, `mesh.within(...)`; None: the one nearest to the center of mass
        damping         stiffness-proportional damping C = damping * Kr [s]; mbd.variable(...): "rod.damping.time"
        reduction       "vibration", or "craig-bampton": `modes` fixed-interface modes and six constraint modes for each node
                        (or Interface) of `interface`; these constraint modes cause the highest frequencies of the body
        interface       nodes where joints and loads act, or `mbd.Interface` of several nodes with six degrees of freedom in
                        common, or {"root": nodes} with names for `body.at("root")`, the mean motion of several
                        (interfaces.py)
        updated         False: modes are held fixed in derivatives (eq. 36), for comparison only: gradients are wrong
        mass            "lumped" (eq. 2), or "consistent", for comparison
        rigid           node sets that move as one rigid body each
        stiffening      True: displacements of second order, so that spin and forces of joints stiffen it (stiffening.py)
        expansion       True: static shapes of changes of temperature and moisture beside the modes, for mbd.Temperature; names
                        of parts: the shapes of each part that changes alone, [True, "skin"] of both (expansion.py)
        direction       the laminate's x-axis in mesh axes, projected into each cell: [3], one for each [m, 3], or a rule for
                        curved shells: mbd.mesh.around, mbd.mesh.along, mbd.mesh.in_system, or {"around": {"axis": [0, 0, 1]}}
        """
        parts = {"plate": Plates(mesh, laminate, direction, mass=mass)}
        options = (position, axes, reference, damping, reduction, interface, updated, (), rigid, stiffening, expansion)
        body = cls(name, mesh, parts, modes, *options)
        warn_slender(name, mesh, body.plates.values())
        return body

    @classmethod
    def beam(
        cls,
        name: str,
        line: BeamLine,
        section: BeamSection | Sequence[BeamSection],
        modes: int = 8,
        position: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
        axes: Sequence | Tensor | None = None,
        reference: str | int | Sequence[int] | None = None,
        damping: float | Tensor = 0.0,
        reduction: str = "vibration",
        interface: InterfaceArgument = (),
        updated: bool = True,
        orientation: Sequence[float] | Tensor = (0.0, 1.0, 0.0),
        offset: Sequence[float] | Tensor = (0.0, 0.0),
        twist: float | Sequence | Tensor = 0.0,
        mass: str = "lumped",
        stiffening: bool = False,
        expansion: bool | str | Sequence[str | bool] = False,
    ) -> FlexibleBody:
        """A beam of straight elements or arcs; it may have branches.

        line            nodes and two-node elements
        section         a Section (its `angles` [rad] are the body's design parameters) or a GivenSection; or one for each
                        element, several of which may be the same: "section", else "section0", "section1", ...
        orientation     the section's y-axis in mesh axes, projected across the elements: [3], or one for each [m, 3]
        offset, twist   of the section's axes from the line of the nodes: y, z [m] and angle [rad], or one for each element;
                        twist also at the start and the end of each element [m, 2]
        Others as in `plate`. The inertia of the sections is on rigid arms at the nodes (and middles, if consistent).
        """
        if not isinstance(line, BeamLine):
            raise InputError((name, "line"), line, "a BeamLine", state=f"is a {type(line).__name__}")
        sections: list[Any] = list(section) if isinstance(section, list | tuple) else [section] * len(line.elements)
        if len(sections) != len(line.elements):
            wrong = f"has {len(sections)} sections for {len(line.elements)} elements"
            raise InputError((name, "section"), allowed="must have one, or one for each element", state=wrong)
        parts: dict[str, Part] = {}  # elements that share a section are one part
        for k, cross_section in enumerate(dict.fromkeys(sections)):
            members = [e for e, s in enumerate(sections) if s is cross_section]
            parts[f"section{k}"] = Beams(line, cross_section, orientation, offset, twist, members, mass)
        options = (position, axes, reference, damping, reduction, interface, updated, (), (), stiffening, expansion)
        return cls(name, line, parts, modes, *options)

    exact_beam = FlexibleBeam  # of finite displacements and rotations, without modes

    def at(
        self,
        node: str | int | Sequence[str | int],
        axes: Sequence | Tensor | None = None,
        offset: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
        weights: Sequence[float] | None = None,
    ) -> Frame:
        """Frame on a mesh node, or on the mean motion of several (interpolation.py).

        node           name or index of a node, name of a node set or of an interface, or a list of nodes
        axes, offset   columns of its triad, and the rigid arm from the center of the nodes [m], in body axes
        weights        of the nodes of a list in the mean; None: equal
        """
        x = self.mesh.nodes - self.origin
        named = self.interfaces.get(node) if isinstance(node, str) and weights is None else None
        interpolation = named or InterpolationConstraint.on(node_indices(self.mesh, node), weights)
        if varying_nodes(self.mesh) and len(interpolation.nodes) > 1:
            raise InputError(
                (self.name, "node"),
                allowed="on one node, because the nodes of this body are design variables",
                state=f"is on the nodes {list(interpolation.nodes)}",
                noun=f"frame of {self.name!r}",
            )
        return Frame(self, interpolation.center(x) + vector("offset", offset), rotation("axes", axes), interpolation)

    def places(self) -> Float[Tensor, "*lanes n 3"]:
        """Positions of the nodes of the undeformed body from its origin, in the present design [m]."""
        if not varying_nodes(self.mesh):
            return self.mesh.nodes - self.origin
        nodes = present_nodes(self.mesh)
        return nodes - nodes[..., self.reference, :].mean(-2, keepdim=True)

    def moving(
        self,
        velocity: Sequence[float] | Tensor | None = None,
        angular_velocity: Sequence[float] | Tensor | None = None,
    ) -> Self:
        """Set the initial velocity of the origin, in ground axes [m/s], and the angular velocity, in body axes [rad/s]; joints
        may change them. None: the smallest possible. Returns the body."""
        set_velocities(self, velocity, angular_velocity)
        return self

    def bent(self, modal: Sequence[float] | Tensor | None = None, rate: Sequence[float] | Tensor | None = None) -> Self:
        """Set initial modal coordinates and velocities of the lowest mode_counts[0] modes of each design, the number that
        every design retains. None: zero.
        Gradients include the rotation of individual modes within the retained subspace (multibody/start/modal_start.py).
        Raises InputError if modes of equal frequency would rotate.
        A torch.nn.Parameter is a design variable, "rod.modal", "rod.modal_velocity". Returns the body."""
        set_modal_start(self, modal, rate)
        return self

    def damped(self, ratio: float | Sequence[float] | Tensor = 0.0, rate: float | Tensor = 0.0) -> Self:
        """Set damping of the modes, in addition to `damping`. Returns the body.

        ratio  damping ratio, one for all modes, or one for each, lowest frequency first [-]; further modes of a design have the
               last one; mbd.variable(...) of one for all, or a torch.nn.Parameter with one for each, is the design variable
               "rod.damping.ratios"
        rate   mass-proportional part of Rayleigh's damping [1/s]; mbd.variable(...): "rod.damping.rate"
        """
        self.damping.with_ratios(ratio, self.mode_counts, rate)
        return self

    def flexibility(self) -> tuple[SparseMatrix, Callable[[Tensor], Tensor]] | None:
        """Stiffness matrix of the free degrees of freedom of the first design, without gradients, and a function that maps
        their displacements [N, k] to the motion of all nodes [nodes, 6, k]. None for bodies of `from_reduced`."""
        if self.given_structure is not None:
            return self.given_structure.flexibility()
        with torch.no_grad():
            K = self.assembly.stiffness()

        def expand(u: Tensor) -> Tensor:
            psi = self.assembly.freedoms.expand(u)
            return psi if self._rotations is None else self._rotations(psi)

        return SparseMatrix(K.pattern, K.values.reshape(-1, K.pattern.nnz)[0].detach(), symmetric=True), expand

    def structure(self, nodes: Sequence[int] = (), second_order: bool = False) -> dict[str, Tensor]:
        """Run the structure stage.

        Returns the inertia invariants, "Kr" [..., m, m] and "psi" [..., nodes, 6, m]. If plies have loss factors, also "loss"
        [..., m, m]: like Kr, but the part of each ply is multiplied by its loss factor. With stiffening, or with
        `second_order`, also F1, F2 and "psi2" of `nodes` (stiffening.py). Leading axes are those of the laminate's parameters
        (designs).
        """
        if self.given_structure is not None:
            return self.given_structure.structure()
        points = self.assembly.masses()
        K, M = matrices(self.assembly, points)
        try:
            basis = self.reduction(K, M)
        except CutCluster as error:
            raise error.of_body(self.name) from None
        _, mass, rotary, arm = points
        x = self.assembly.mass_positions(self.places(), arm)
        psi, *modal = self._with_modes(basis.vectors, x, mass, rotary, arm)
        result = all_invariants(x, mass, rotary, modal) | {"Kr": basis.stiffness, "psi": psi}
        if (lost := self.assembly.loss_stiffness()) is not None:
            result["loss"] = basis.vectors.mT @ (lost @ basis.vectors)
        stiffening = self.stiffening or (Stiffening(self.name, self.assembly) if second_order else None)
        return result if stiffening is None else result | stiffening(K, points, x, psi, nodes)

    def _with_modes(
        self, vectors: Tensor, x: Tensor, mass: Tensor, rotary: Tensor, arm: Tensor | None
    ) -> tuple[Tensor, ...]:
        """Mode shapes at the nodes, and the invariants that depend on them, of vectors [..., N, m]."""

        def of_lanes(vectors: Tensor, x: Tensor, mass: Tensor, rotary: Tensor, *arm: Tensor) -> tuple[Tensor, ...]:
            psi = self.assembly.freedoms.expand(vectors)
            psi = psi if self._rotations is None else self._rotations(psi)
            return psi, *modal_invariants(x, mass, rotary, self.assembly.mass_motion(psi, *(arm or [None])))

        points = [(x, 2), (mass, 1), (rotary, 1), *([] if arm is None else [(arm, 2)])]
        if vectors.dim() != 3:
            return of_lanes(vectors, *(y for y, _ in points))
        return by_groups(of_lanes, vectors, *(y.expand(len(vectors), *y.shape[-n:]) for y, n in points))
