"""Flexible bodies in a floating frame: a laminated mesh reduced to vibration modes.

    u' = Psi w    (8)      Psi: modes of the body whose reference nodes are fixed to the body frame (reduction/family.py)

The structure stage of a body, once for each design: laminate -> K (linear in the laminate's entries) -> Psi and
Kr = Psi' K Psi -> inertia invariants. What leaves it knows nothing of the mesh (reduction/invariants.py).

Lumped mass, as in eq. (2): nodal mass m_k and isotropic nodal rotary inertia mu_k.
Differentiable, forward and reverse, in every parameter of the laminate (reduction/transport.py).
Assumed: small elastic displacements about the undeformed body.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchmbd.bodies.frame import Frame, identifier, rotation, vector
from torchmbd.elements import PlateMatrices
from torchmbd.errors import InputError, unknown
from torchmbd.materials import Laminate
from torchmbd.mesh import Mesh
from torchmbd.numerics.sparse import SparseMatrix
from torchmbd.reduction import REDUCTIONS, Reduction, inertia_invariants


class FlexibleBody(nn.Module):
    """A flexible body; made by `FlexibleBody.plate`.

    The body frame sits at the reference node (the mean of several) with the axes of the mesh.
    """

    laminate: Laminate

    def __init__(
        self,
        name: str,
        matrices: PlateMatrices,
        laminate: Laminate,
        modes: int,
        reference: Sequence[int],
        position: Tensor,
        axes: Tensor,
        damping: float = 0.0,
        reduction: str = "vibration",
        interface: Sequence[int] = (),
        updated: bool = True,
    ):
        super().__init__()
        self.name = identifier("flexible body", name)
        self.matrices, self.mesh, self.laminate = matrices, matrices.mesh, laminate
        self.reference, self.damping = list(reference), damping
        self.position, self.axes = position, axes
        self.velocity = self.angular_velocity = torch.zeros(3, dtype=torch.float64)
        self.origin = self.mesh.nodes[self.reference].mean(0)
        fixed = torch.zeros(6 * len(self.mesh.nodes), dtype=torch.bool)
        for node in self.reference:
            fixed[6 * node : 6 * node + 6] = True
        self.free = torch.nonzero(~fixed)[:, 0]
        held = self._rows(interface)
        least, most = 0 if held else 1, len(self.free) - len(held)
        if not isinstance(modes, int) or not least <= modes <= most:
            raise InputError(f"modes of {name!r} is {modes!r}; allowed: {least} to {most}, the freedoms of the mesh")
        self.reduction = _reduction(name, reduction, modes, held, updated)
        self.modes = self.reduction.size
        if not 0 <= damping < float("inf"):
            raise InputError(f"damping of {name!r} is {damping!r} s; allowed: zero or positive")
        self._pattern, selected = matrices.pattern.restrict(self.free)
        self._basis = matrices.basis[:, selected].contiguous()

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
        damping: float = 0.0,
        reduction: str = "vibration",
        interface: str | int | Sequence[str | int] = (),
        updated: bool = True,
    ) -> FlexibleBody:
        """A laminated plate or shell.

        mesh            triangles; the plies follow its x axis
        laminate        its `angles` [rad] are the body's design parameters
        modes           retained vibration modes of the body fixed at its reference nodes (and its interface)
        position, axes  approximate initial origin in ground axes [m] and rotation (columns: mesh axes); joints close the rest
        reference       nodes fixed to the body frame: a node or node set; None: the node nearest to the center of mass
        damping         stiffness-proportional damping C = damping * Kr [s]
        reduction       "vibration", or "craig-bampton": `modes` fixed-interface modes and six constraint modes for each node
                        of `interface`; the highest frequencies are then those of these nodes: give `steps` to simulate
        interface       nodes whose motion is kept, those that carry joints or loads
        updated         False: modes are held fixed in derivatives (eq. 36), for comparison only: gradients are wrong
        """
        where = rotation(f"axes of {name!r}", axes)
        at = vector(f"position of {name!r}", position)
        matrices = PlateMatrices(mesh, laminate)
        nodes = _reference(mesh, matrices, reference)
        held = _nodes(mesh, interface)
        return cls(name, matrices, laminate, modes, nodes, at, where, damping, reduction, held, updated)

    def at(self, node: str | int, axes: Sequence | Tensor | None = None) -> Frame:
        """Frame on a mesh node, by its name or index; `axes`: columns of its triad in body axes."""
        index = _node(self.mesh, node)
        return Frame(self, self.mesh.nodes[index] - self.origin, rotation("axes", axes), index)

    def structure(self) -> dict[str, Tensor]:
        """Run the structure stage.

        Returns the inertia invariants, "Kr" [..., m, m] and "psi" [..., nodes, 6, m]; leading axes are those of the
        laminate's parameters (designs).
        """
        n = len(self.mesh.nodes)
        K = SparseMatrix(self._pattern, self.laminate.entries() @ self._basis)
        diagonal = self.matrices.lumped_mass(self.laminate.mass_per_area, self.laminate.rotary_inertia_per_area)
        mass, rotary = diagonal[..., 0::6], diagonal[..., 3::6]
        diagonal = diagonal[..., self.free]
        basis = self.reduction(K, diagonal.expand(*K.values.shape[:-1], -1))
        psi = basis.vectors.new_zeros(*basis.vectors.shape[:-2], 6 * n, self.modes)
        psi = psi.index_copy(-2, self.free, basis.vectors).unflatten(-2, (n, 6))
        result = inertia_invariants(self.mesh.nodes - self.origin, mass, rotary, psi)
        return result | {"Kr": basis.stiffness, "psi": psi}

    def _rows(self, interface: Sequence[int]) -> tuple[int, ...]:
        """Rows of the free freedoms that belong to interface nodes."""
        for node in interface:
            if node in self.reference or list(interface).count(node) > 1:
                allowed = "nodes that are no reference, each once"
                raise InputError(f"interface of {self.name!r} has node {node}; allowed: {allowed}")
        freedoms = [6 * node + i for node in interface for i in range(6)]
        return tuple(torch.searchsorted(self.free, torch.tensor(freedoms, dtype=torch.long)).tolist())


def _reduction(name: str, kind: str, modes: int, interface: tuple[int, ...], updated: bool) -> Reduction:
    if kind not in REDUCTIONS:
        raise unknown(f"reduction of {name!r}:", kind, REDUCTIONS)
    try:
        return REDUCTIONS[kind](modes, interface, updated)
    except InputError as error:
        raise InputError(f"reduction of {name!r}: {error}") from None


def _reference(mesh: Mesh, matrices: PlateMatrices, reference: str | int | Sequence[int] | None) -> list[int]:
    if reference is None:
        center = (matrices.area[:, None] * mesh.nodes).sum(0) / matrices.area.sum()
        return [int(((mesh.nodes - center) ** 2).sum(1).argmin())]
    nodes = _nodes(mesh, reference)
    if not nodes:
        raise InputError(f"reference is {reference!r}; allowed: a node, a node set or a list of at least one node")
    return nodes


def _nodes(mesh: Mesh, given: str | int | Sequence[str | int]) -> list[int]:
    """Indices of a node, of a node set, or of a list of nodes."""
    if isinstance(given, str) and len(mesh.node_sets.get(given, ())) > 1:
        return [int(i) for i in mesh.node_sets[given]]
    return [_node(mesh, node) for node in ([given] if isinstance(given, (str, int)) else given)]


def _node(mesh: Mesh, node: str | int) -> int:
    if isinstance(node, str):
        return mesh.node(node)
    if not hasattr(node, "__index__") or not 0 <= int(node) < len(mesh.nodes):
        raise InputError(f"node is {node!r}; allowed: a node name or 0 to {len(mesh.nodes) - 1}")
    return int(node)
