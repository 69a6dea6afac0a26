"""Changes of temperature and moisture of a flexible body as loads, and their static shapes in its basis.

    F = sum over cells of integrals of E' (N, M)        loads on nodes that cause the free expansion by a unit change
    Q = T Psi' F                                        generalized forces on the modal coordinates, for a change T

E, N, M   strains of a cell; forces and moments of the free strains of its laminate (fem/materials/expansion.py)

A zone is the whole body or one of its parts. Few vibration modes have the stretching of a body that becomes warmer, so a
body with `expansion` retains U = K^-1 F of each change as well (fem/reduction/static_shapes.py). Then the deformation under
a steady change is exact for the mesh of a body that is held at its reference alone. A reference of several nodes is a
clamp, so a body that is free to expand has one node as reference. A body that joints hold elsewhere needs these nodes as
interface of the reduction "craig-bampton".
Shapes that coincide or vanish in one design, and not in its neighbors, are a warning: there a gradient lacks the part that
the lost shape would have.
Differentiable, forward and reverse, in everything that the laminates depend on, with lanes.
Checked in tests/multibody/forces/test_temperature.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchmbd.errors import InputError, one_of, unknown, warn, within
from torchmbd.fem.elements import Assembly, ExpandingPart, Part
from torchmbd.fem.elements.geometric import projected_geometric_stiffness
from torchmbd.fem.reduction import StaticLoads, StaticShapes
from torchmbd.fem.reduction.static_shapes import INDEPENDENT
from torchmbd.math.gradients import is_differentiated, untransformed
from torchmbd.math.module_call import outside_transforms, run_with_parameters

_NEAR = 1e-2  # relative change of parameters, and of angles [rad], to a design near by
Load = tuple[str | None, str]  # zone, None for the whole body, and kind of change
Zones = bool | str | Sequence[str | bool]


def zone_list(zones: Zones) -> list[str | bool]:
    """The argument `expansion` of a body as a list, in which True is the whole body."""
    return [zones] * bool(zones) if isinstance(zones, (bool, str)) else [*zones]


class Expansion:
    """Loads on the nodes of one body by unit changes."""

    def __init__(self, name: str, parts: Mapping[str, Part], assembly: Assembly) -> None:
        self.name, self.parts, self.assembly = name, dict(parts), assembly
        self.loads: list[Load] = []  # of the static shapes
        self._independent = torch.zeros(
            0, dtype=torch.bool
        )  # of each, whether it differs from those before in designs nearby

    def expanding(self, zone: str | None) -> dict[str, ExpandingPart]:
        """The parts of a zone that can expand; InputError for a zone that is not there, or does not expand."""
        if zone is not None:
            one_of((self.name, "zone"), zone, self.parts)
        members = {
            key: part for key, part in self.parts.items() if zone in (None, key) and isinstance(part, ExpandingPart)
        }
        if not members:
            where = f"body {self.name!r}" if zone is None else f"zone {zone!r} of body {self.name!r}"
            state = "has no parts that expand"
            raise InputError((self.name, "zone"), zone, "a body or zone with plates or beams", noun=where, state=state)
        return members

    def warn_of_other_parts(self, zone: str | None) -> None:
        """Warn of parts that have stiffness and do not expand with the whole body."""
        members = self.expanding(zone)
        still = (
            [key for key, part in self.parts.items() if key not in members and part.pattern.nnz] if zone is None else []
        )
        if still:
            names = ", ".join(map(repr, still))
            warn(
                f"body {self.name!r} has a change of temperature or moisture, but its parts {names} ignore it: only plates and "
                "beams expand"
            )

    def changes(self, zone: str | None) -> tuple[str, ...]:
        """Kinds of change that a part of the zone knows."""
        return tuple(dict.fromkeys(x for part in self.expanding(zone).values() for x in part.changes))

    def forces(self, zone: str | None, change: str) -> Float[Tensor, "*lanes n 6"]:
        """Forces and moments on all nodes by a unit change; InputError names the ply without a coefficient."""
        total: Tensor | None = None
        for key, part in self.expanding(zone).items():
            if change not in part.changes:
                continue
            try:
                forces = part.expansion_forces(change)
            except InputError as error:
                raise within(f"part {key!r} of body {self.name!r}", error, self.name, key) from None
            total = forces if total is None else total + forces
        if total is None:
            raise unknown((self.name, "change"), change, self.changes(zone))
        return total

    def changing(self, zone: str | None, change: str) -> dict[str, str]:
        """Parts of a zone that know a kind of change, as `Assembly.stressed` takes them: part -> kind."""
        return {key: change for key, part in self.expanding(zone).items() if change in part.changes}

    def second_order(
        self, zone: str | None, change: str, psi: Float[Tensor, "*lanes n 6 m"]
    ) -> Float[Tensor, "*lanes m m"]:
        """Second derivative of the work of a unit change on the modes: minus their geometric stiffness under the stress of the
        body that is held at its reference (stiffening.py)."""
        freedoms = self.assembly.freedoms
        F = freedoms.gathered(self.forces(zone, change)[..., None])
        u = freedoms.expand(self._static(self.assembly.stiffness(), F))
        cells = self.assembly.stressed(u, self.changing(zone, change))
        return -projected_geometric_stiffness(cells, psi)[..., 0, :, :]

    @cached_property
    def _static(self) -> StaticLoads:
        return outside_transforms(lambda: StaticLoads(self.assembly.pattern))

    def free_forces(self) -> Float[Tensor, "*lanes N loads"]:
        """Loads on the free degrees of freedom of all static shapes; a warning where shapes coincide in one design alone."""
        F = self._load_columns()
        if is_differentiated(F):
            self._warn_of_lost_shapes(_independent(untransformed(F)))
        return F

    def _load_columns(self) -> Float[Tensor, "*lanes N loads"]:
        columns = [self.forces(*load)[..., None] for load in self.loads]
        lanes = torch.broadcast_shapes(*(x.shape for x in columns))
        return self.assembly.freedoms.gathered(torch.cat([x.expand(lanes) for x in columns], -1))

    def _warn_of_lost_shapes(self, independent: Bool[Tensor, "*lanes loads"]) -> None:
        """Warn of designs in which a shape vanishes or is that of others, if it is not so in designs near by."""
        lost = (self._independent & ~independent).reshape(-1, len(self.loads))
        lanes = lost.any(-1).nonzero()[:, 0].tolist()
        if lanes:
            where = f"in design {lanes[0]} " if len(lost) > 1 else ""
            loads = ", ".join(
                change + (f" of {zone!r}" if zone else "")
                for (zone, change), x in zip(self.loads, lost[lanes[0]].tolist(), strict=True)
                if x
            )
            warn(
                f"body {self.name!r} has no static shape of its own {where}for a change of {loads}: this shape vanishes or "
                "depends on the shapes of other changes, but in neighboring designs it does not. Gradients of displacements "
                "due to this change are incomplete there. Try: slightly different angles or coefficients"
            )

    def _independent_nearby(self) -> Bool[Tensor, " loads"]:
        """Return True for each load that is independent of those before it when all parameters of the parts change a little."""
        owners = nn.ModuleDict(
            {f"{key}_{name}": module for key, part in self.parts.items() for name, module in part.modules().items()}
        )
        near = {}
        for name, x in owners.named_parameters():
            steps = torch.linspace(1.0, 2.0, x.numel(), dtype=x.dtype).reshape(x.shape)
            near[name] = x.detach() + _NEAR * steps * (1.0 if name.endswith("angles") else x.detach())
        with torch.no_grad():
            F = run_with_parameters(owners, near, self._load_columns)
        return _independent(F)

    def shapes(self, zones: Zones) -> StaticShapes | None:
        """The static shapes of zones: True: the whole body as one; False: none. Changes without coefficients have none."""
        wanted: list[str | bool] = zone_list(zones) if isinstance(zones, (bool, str, list, tuple)) else [False]
        if any(x is False or not isinstance(x, (bool, str)) or wanted.count(x) > 1 for x in wanted):
            allowed = "True, False, or names of parts of the body, each once; True among them is the whole body"
            raise InputError((self.name, "expansion"), zones, allowed)
        chosen = [x if isinstance(x, str) else None for x in wanted]
        if not chosen:
            return None
        self.loads, refused = [], []
        for zone in chosen:
            for change in self.changes(zone):
                try:
                    self.forces(zone, change)
                except InputError as error:
                    refused.append(error)
                else:
                    self.loads.append((zone, change))
        if not self.loads:
            raise within(f"expansion of {self.name!r}", refused[0], self.name, "expansion")
        self._independent = self._independent_nearby()
        return StaticShapes(self.assembly.pattern, self.free_forces, len(self.loads))


def _independent(F: Float[Tensor, "*lanes N loads"]) -> Bool[Tensor, "*lanes loads"]:
    """Return True for each column that is no combination of those before it."""
    sizes = F.norm(dim=-2, keepdim=True)
    unit = torch.linalg.qr(F / torch.where(sizes > 0.0, sizes, 1.0), mode="r").R
    first = [torch.zeros_like(sizes[..., 0, 0], dtype=torch.long)]
    ranks = [(torch.linalg.svdvals(unit[..., : k + 1]) > INDEPENDENT).sum(-1) for k in range(F.shape[-1])]
    return torch.stack([*first, *ranks], -1).diff(dim=-1) > 0
