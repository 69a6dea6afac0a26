"""A flexible body on supports: its unsupported degrees of freedom, and its stiffness, geometric stiffness and mass on these.

Checked in tests/extensions/buckling/test_buckling.py, tests/multibody/statics/test_vibrations.py.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import DesignFailure, InputError
from torchmbd.fem.elements import FREEDOMS, Assembly
from torchmbd.fem.elements.geometric import projected_geometric_stiffness
from torchmbd.fem.reduction.forms import Indefinite
from torchmbd.math.sparse import SparseMatrix
from torchmbd.multibody.bodies import FlexibleBody
from torchmbd.multibody.bodies.interpolation import node_indices
from torchmbd.multibody.bodies.reduced import moving
from torchmbd.multibody.bodies.stiffening import check_stressed

Changes = Sequence[Mapping[str, str]]
Supports = Mapping[Any, str | Sequence[float | None]]


class SupportedBody:
    """A body of elements on supports, arguments as in `buckling`.

    vibrating  False: for buckling, which needs parts whose stress is known. True: for frequencies; supports may be {}, a free
               body, and impose no displacements
    assembly   of the body without its reference
    kept       indices of the unsupported ones among the free degrees of freedom of the assembly [N]
    pattern    of matrices on these
    imposed    imposed displacements of supports, zero elsewhere, on all free degrees of freedom [F, 1] [m, rad]
    Raises InputError if the arguments are wrong.
    """

    def __init__(self, body: FlexibleBody, supports: Supports | None = None, vibrating: bool = False) -> None:
        what = "frequencies" if vibrating else "buckling"
        if not isinstance(body, FlexibleBody):
            raise InputError("body", body, "a FlexibleBody", noun=f"body of {what}")
        if body.given_structure is not None:
            lack = "no degrees of freedom to support" if vibrating else "no stress"
            raise InputError(
                (body.name,),
                allowed="a body of elements",
                noun=f"body {body.name!r}",
                state=f"is made of matrices, which give {lack} for {what}",
            )
        if not vibrating:
            check_stressed(body.name, what, body.parts)
        self.name = body.name
        self.assembly = Assembly(body.mesh, body.assembly.parts, (), body.links)
        held = _held(body, {tuple(body.reference): "all"} if supports is None else supports, free_body=vibrating)
        free, absent = self.assembly.freedoms.free, set(self.assembly.freedoms.absent.tolist())
        row = {int(f): i for i, f in enumerate(free)}
        for f in held:
            if f in absent:  # as rotations of nodes of solids, which "all" names, too
                continue
            if vibrating and held[f] != 0.0:
                raise InputError(
                    (body.name, "supports", int(f // 6)),
                    float(held[f]),
                    "0, or names of degrees of freedom",
                    state=f"displace node {f // 6} by {FREEDOMS[f % 6]} = {held[f]:g}, but frequencies have no "
                    "initial stress",
                    noun=f"supports of {body.name!r}",
                )
            if f not in row:
                raise InputError(
                    "supports",
                    supports,
                    "must hold the node that leads it",
                    state=f"hold node {f // 6} of {body.name!r}, which follows another node by a link",
                )
        self.imposed = torch.zeros(len(free), 1, dtype=torch.float64)
        kept = torch.ones(len(free), dtype=torch.bool)
        for f, value in held.items():
            if f in row:
                self.imposed[row[f], 0], kept[row[f]] = value, False
        if not bool(kept.any()):
            raise InputError(
                "supports",
                supports,
                "must leave at least one free degree of freedom",
                state=f"hold all degrees of freedom of {body.name!r}",
            )
        self.kept = kept.nonzero()[:, 0]
        self.pattern, self._positions = self.assembly.pattern.restrict(self.kept)
        with torch.no_grad():
            self.assembly.stiffness()  # caches index tables now, as torch.func would not allow

    def restricted(self, K: SparseMatrix) -> SparseMatrix:
        """The part of a matrix on the unsupported degrees of freedom."""
        return SparseMatrix(self.pattern, K.values[..., self._positions], symmetric=True)

    def geometric(
        self, displacements: Float[Tensor, "*lanes n 6 k"], changes: Changes = ()
    ) -> Float[Tensor, "*lanes k nnz"]:
        """Values of the geometric stiffness under the stresses of k displacements of all nodes.

        changes   of the last displacements, one for each: these are those of a unit change of temperature or moisture, part
                  -> kind, and the stresses of its free strains are subtracted
        """
        states = _states(displacements, changes)
        values = [self.assembly.geometric(u, change).values for u, change in states]
        return torch.cat(values, -2)[..., self._positions]

    def projected_geometric(
        self, displacements: Float[Tensor, "*lanes n 6 k"], changes: Changes, motions: Float[Tensor, "*lanes n 6 a"]
    ) -> Float[Tensor, "*lanes k a a"]:
        """The geometric stiffness as in `geometric`, between motions of all nodes."""
        cells = (self.assembly.stressed(u, change) for u, change in _states(displacements, changes))
        return torch.cat([projected_geometric_stiffness(part, motions) for part in cells], -3)

    def motion(
        self, u: Float[Tensor, "*lanes N k"], imposed: Float[Tensor, "F 1"] | None = None
    ) -> Float[Tensor, "*lanes n 6 k"]:
        """Displacements of all nodes, out of u of the unsupported degrees of freedom; imposed: of supports, None: zero."""
        of_supports = torch.zeros_like(self.imposed) if imposed is None else imposed
        full = of_supports.expand(*u.shape[:-2], len(of_supports), u.shape[-1]).index_copy(-2, self.kept, u)
        return self.assembly.freedoms.expand(full)

    def shapes(self, vectors: Float[Tensor, "*lanes N k"]) -> Float[Tensor, "*lanes n 6 k"]:
        """Motions of all nodes of which the largest displacement is 1."""
        motion = self.motion(vectors)
        flat = motion[..., :3, :].flatten(-3, -2)
        size = flat.gather(-2, flat.abs().argmax(-2, keepdim=True))[..., None, :]
        return motion / torch.where(size == 0.0, 1.0, size)

    def movable(self, error: InputError) -> DesignFailure:
        """The error for a stiffness on supports that is not positive definite: by the supports, or in one design."""
        return self.free_at(error.fault, error.row) if isinstance(error, Indefinite) else self._free(str(error))

    def free_at(self, fault: str, row: int) -> DesignFailure:
        """The error for supports that leave a rigid-body motion free; row: the free degree of freedom that moves most."""
        return self._free(f"{fault}, and {moving(self.assembly, int(self.kept[row]))}")

    def _free(self, fault: str) -> DesignFailure:
        path, noun = (self.name, "supports"), f"supports of {self.name!r}"
        allowed = "must hold more degrees of freedom"
        return DesignFailure(path, allowed=allowed, noun=noun, state=f"do not hold the body: {fault}")


def _states(displacements: Tensor, changes: Changes) -> Iterator[tuple[Tensor, Mapping[str, str]]]:
    """Displacements without a change together, and those of each change."""
    plain = displacements.shape[-1] - len(changes)
    if plain:
        yield displacements[..., :plain], {}
    for k, change in enumerate(changes, start=plain):
        yield displacements[..., k : k + 1], change


def _held(body: FlexibleBody, supports: Supports, free_body: bool) -> dict[int, float]:
    """Imposed displacements of the supported degrees of freedom 6 * node + i; none of a free body, where it is allowed."""
    if not isinstance(supports, Mapping) or not (supports or free_body):
        allowed = (
            "a mapping node -> degrees of freedom, {} for a free body"
            if free_body
            else "a mapping node -> degrees of freedom, with at least one node"
        )
        raise InputError((body.name, "supports"), supports, f"{allowed}, or None")
    imposed: dict[int, float] = {}
    for where, support in supports.items():
        values = _values(body, where, support)
        for node in node_indices(body.mesh, list(where) if isinstance(where, tuple) else where):
            for i, x in enumerate(values):
                if x is not None and imposed.setdefault(6 * node + i, x) != x:
                    raise InputError(
                        (body.name, "supports"),
                        allowed="must give one value",
                        state=f"give {FREEDOMS[i]} of node {node} two values",
                    )
    return imposed


def _values(body: FlexibleBody, where: Any, support: Any) -> list[float | None]:
    """Six imposed displacements of one support, None for free ones."""
    if isinstance(support, str):
        names = list(FREEDOMS) if support == "all" else support.replace(",", " ").split()
        if names and all(name in FREEDOMS for name in names):
            return [0.0 if name in names else None for name in FREEDOMS]
    elif isinstance(support, Sequence) and len(support) == 6 and all(x is None or _finite(x) for x in support):
        return [None if x is None else float(x) for x in support]
    allowed = f"some of {' '.join(FREEDOMS)}, or 'all', or six numbers with None for a free degree of freedom"
    raise InputError((body.name, "supports", str(where)), support, allowed, noun=f"support {where!r} of {body.name!r}")


def _finite(x: Any) -> bool:
    return isinstance(x, (int, float)) and not isinstance(x, bool) and bool(np.isfinite(x))
