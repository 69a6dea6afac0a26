"""Interfaces of a flexible body: the motions that a Craig-Bampton reduction keeps, six degrees of freedom each.

    node       the motion of one node
    averaged   the mean motion of several nodes, that of a frame on them (interpolation.py): the set stays flexible   (RBE3)
    rigid      the motion of nodes that are one rigid body                                                            (RBE2)

A mean motion y = B u of nodes becomes a degree of freedom of the body, and six degrees of freedom of these nodes are
eliminated,

    u_d = B_d^-1 (y - B_r u_r)

with the six columns B_d that are best conditioned (fem/elements/freedoms.py). So constraint modes are static shapes under loads
on the frame that leave the set flexible, and fixed-interface modes are those of the body with this mean motion fixed.
Checked in tests/multibody/bodies/test_interfaces.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError, true_or_false
from torchmbd.fem.elements import MeanMotion, RigidLink
from torchmbd.fem.elements.beam_line import varying_nodes
from torchmbd.multibody.bodies.interpolation import InterpolationConstraint, node_indices


@dataclass(frozen=True)
class Interface:
    """Nodes whose common motion a Craig-Bampton reduction keeps, six degrees of freedom; see the module header.

    nodes     a node set, `mesh.edge(x=...)`, or a list of nodes
    rigid     True: they are one rigid body; False: their mean motion, the set stays flexible
    weights   of the nodes in the mean; None: equal

    >>> plate = mbd.mesh.rectangle(length=0.5, width=0.05, cells=(4, 2))
    >>> laminate = mbd.Laminate(mbd.examples.carbon(), mbd.deg([45, -45]), thickness=1e-3)
    >>> options = {"reference": "center", "reduction": "craig-bampton", "modes": 2}
    >>> ends = {"root": plate.edge(x=-0.25), "tip": mbd.Interface("right_edge", rigid=True)}
    >>> body = mbd.FlexibleBody.plate("plate", plate, laminate, interface=ends, **options)
    >>> body.modes, body.at("root")  # six for each interface, and two modes
    (14, plate.at('root'))
    """

    nodes: Any
    rigid: bool = False
    weights: Sequence[float] | None = None

    def __post_init__(self) -> None:
        true_or_false("rigid", self.rigid)
        if self.rigid and self.weights is not None:
            raise InputError(
                "weights",
                allowed="left out with rigid=True",
                noun="weights of an Interface",
                state="are given, but the interface is rigid",
            )


@dataclass
class Interfaces:
    """The interfaces of an argument `interface`.

    kept    nodes whose degrees of freedom are kept; mean motions are counted after the nodes of the mesh
    links   of rigid interfaces
    means   of averaged interfaces
    frames  name of an interface -> its nodes with weights
    """

    kept: list[int] = field(default_factory=list)
    links: list[RigidLink] = field(default_factory=list)
    means: list[MeanMotion] = field(default_factory=list)
    frames: dict[str, InterpolationConstraint] = field(default_factory=dict)

    @classmethod
    def of(cls, name: str, mesh: Any, interface: Any) -> Interfaces:
        """Read the argument `interface` of the body `name`; InputError names what is wrong."""
        interfaces = cls()
        if isinstance(interface, Mapping):
            for key, item in interface.items():
                interfaces._add_named(name, mesh, key, item)
            return interfaces
        items = [interface] if isinstance(interface, Interface) else interface
        if isinstance(items, (list, tuple)) and any(isinstance(item, Interface) for item in items):
            for item in items:
                interfaces._add(name, mesh, item) if isinstance(item, Interface) else interfaces._keep(mesh, item)
        else:
            interfaces._keep(mesh, items)
        return interfaces

    def _keep(self, mesh: Any, nodes: Any) -> None:
        self.kept += node_indices(mesh, nodes)

    def _add_named(self, name: str, mesh: Any, key: Any, item: Any) -> None:
        if not isinstance(key, str) or not key:
            raise InputError((name, "interface"), allowed="must have a word as its name", state=f"has the name {key!r}")
        mount = self._add(name, mesh, item if isinstance(item, Interface) else Interface(item))
        if key in mesh.node_sets and sorted(node_indices(mesh, key)) != sorted(mount.nodes):
            raise InputError(
                (name, "interface"),
                key,
                "must have another name",
                state="has the name of other nodes of its mesh",
                noun=f"interface {key!r} of {name!r}",
            )
        self.frames[key] = mount

    def _add(self, name: str, mesh: Any, item: Interface) -> InterpolationConstraint:
        nodes = node_indices(mesh, item.nodes)
        mount = InterpolationConstraint.on(nodes, item.weights)
        if len(set(nodes)) != len(nodes):
            raise InputError(
                (name, "interface"), allowed="must have each node once", state=f"has a node twice, {nodes}"
            )
        if len(nodes) == 1:
            self.kept += nodes
        elif varying_nodes(mesh):
            raise InputError(
                (name, "interface"), allowed="must have single nodes", state="has several nodes, and nodes vary"
            )
        elif item.rigid:
            self.kept.append(nodes[0])
            self.links += [RigidLink(node, nodes[0]) for node in nodes[1:]]
        else:
            self.kept.append(len(mesh.nodes) + len(self.means))
            self.means.append(MeanMotion(mount.nodes, _matrix(mesh.nodes, mount)))
        return mount


def _matrix(x: Tensor, mount: InterpolationConstraint) -> Tensor:
    """B [6, 6 nodes]: the mean motion out of the degrees of freedom of the nodes."""
    columns = 6 * len(mount.nodes)
    psi = torch.zeros(len(x), 6, columns, dtype=x.dtype)
    psi[list(mount.nodes)] = torch.eye(columns, dtype=x.dtype).reshape(-1, 6, columns)
    return mount.motion(x, psi)
