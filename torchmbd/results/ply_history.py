"""Ply strains, stresses and failure of a flexible plate along a motion.

    stress(t) = basis w(t) - sum Q e T(t),      basis = ply values of the body's modes (fem/elements/plate.py)

Q e T   stress of the free strain e T of a ply by a change T of temperature or moisture (forces/temperature.py)

Points of a body run over its laminates, their cells, layers from the bottom, and the two faces of each layer;
`points` names them.
The index of a body is the largest over all points; its derivative is that of the point of this largest index, exact wherever
this point is unique.
Differentiable with respect to the design along `Trajectory.moved`: through w, the modes and the laminate itself.
Checked in tests/results/test_ply_history.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmbd.errors import InputError, one_of
from torchmbd.fem.elements import PlyBasis, held_ply_stress, ply_basis, ply_points
from torchmbd.fem.materials import CRITERIA, MODES, PLY_COMPONENTS, FailureForms
from torchmbd.fem.materials.strength import required_strength
from torchmbd.fem.sections import Section
from torchmbd.multibody.forces.temperature import Temperature

if TYPE_CHECKING:
    from torchmbd.results.motion_data import MotionData
    from torchmbd.results.trajectory import Trajectory

_CHUNK = 500_000  # indices in memory at once


class PlyHistory:
    """The plies of one body along a motion.

    motion    a Trajectory
    name      of the body
    basis     ply strains and stresses of the modes, and of unit changes of temperature or moisture behind them
              [lanes, points, 5, coordinates], components as in PLY_COMPONENTS
    w         modal coordinates, and these changes [lanes, times, coordinates]
    points    cell, layer and face (0 bottom, 1 top) of each point [points, 3]
    strength  numbers of the ply's Strength at each point [lanes, points, 8]; None where a ply has none

    >>> motion = mbd.simulate(mbd.examples.arm(), 0.1, steps=40)
    >>> plies = mbd.PlyHistory(motion, "arm")
    >>> plies.failure("tsai_wu").shape  # index of the critical point, at each time
    torch.Size([1, 41])
    >>> plies.modes("hashin")[-1]  # at the end
    'matrix compression'
    >>> plies.stress(times=slice(-1, None)).shape  # lanes, times, points, components [Pa]
    torch.Size([1, 1, 32, 5])
    """

    basis: PlyBasis
    points: Int[Tensor, "points 3"]
    strength: Float[Tensor, "lanes points 8"] | None

    def __init__(self, motion: Trajectory, name: str):
        if not hasattr(motion, "body"):
            raise InputError("motion", motion, "a motion, the result of mbd.simulate(...)")
        view = motion.body(name)
        self.name = name
        body = motion.system.body(name)
        require_plies(body)
        changes = changes_of(motion, body)
        self.basis, self.strength, coordinates = motion.of_designs(
            lambda: _recovered(body, view.psi, changes, motion.t)
        )
        self.w = torch.cat([view.w, coordinates], -1) if changes else view.w
        points = (ply_points(part.matrices, part.laminate) for part in body.plates.values())
        self.points = torch.cat(list(points))

    def stress(self, times: slice = slice(None)) -> Float[Tensor, "lanes times points 5"]:
        """Ply stresses [Pa] at the chosen output times."""
        return _at(self.basis.stress, self.w[:, times])

    def strain(self, times: slice = slice(None)) -> Float[Tensor, "lanes times points 5"]:
        """Ply strains at the chosen output times."""
        return _at(self.basis.strain, self.w[:, times])

    def indices(self, criterion: str = "tsai_wu", times: slice = slice(None)) -> Float[Tensor, "lanes times points"]:
        """Failure index of every point at the chosen output times."""
        rule, strength = self._rule(criterion)
        return rule(self.stress(times), strength[:, None])

    def critical(self, criterion: str = "tsai_wu") -> Int[Tensor, "lanes times"]:
        """The point that is nearest to failure, at each time."""
        _, strength = self._rule(criterion)
        size = max(1, _CHUNK // len(self.points))
        rows = []
        for basis, w, numbers in zip(self.basis.stress.detach(), self.w.detach(), strength.detach(), strict=True):
            index = FailureForms(criterion, basis, numbers)
            rows.append(torch.cat([index(part).argmax(-1) for part in w.split(size)]))
        return torch.stack(rows)

    def failure(self, criterion: str = "tsai_wu") -> Float[Tensor, "lanes times"]:
        """Index of the point nearest to failure at each time: below one nothing fails."""
        rule, strength = self._rule(criterion)
        point = self.critical(criterion)
        lane = torch.arange(len(point))[:, None]
        stress = torch.einsum("ltcm,ltm->ltc", self.basis.stress[lane, point], self.w)
        return rule(stress, strength[lane, point])

    def modes(self, criterion: str = "hashin", lane: int = 0) -> list[str]:
        """The failure mode with the largest index at each time, at the critical point; criterion: one with modes ("puck")."""
        criterion = one_of("criterion", criterion, MODES)
        if lane not in range(len(self.w)):
            raise InputError("lane", lane, f"0 to {len(self.w) - 1}")
        point = self.critical(criterion)[lane]
        _, strength = self._rule(criterion)
        stress = torch.einsum("tcm,tm->tc", self.basis.stress[lane, point], self.w[lane])
        largest = MODES[criterion].indices(stress, strength[lane, point]).argmax(-1)
        return [MODES[criterion].names[k] for k in largest.tolist()]

    def extreme(self, component: int, layer: int | None = None, sign: float = 1.0) -> Float[Tensor, "lanes times"]:
        """Largest value of `sign` times a stress component [Pa] over all points, or those of one layer, at each time."""
        layers = int(self.points[:, 1].max()) + 1
        for name, x, count in (("component", component, len(PLY_COMPONENTS)), ("layer", layer or 0, layers)):
            if x not in range(count):
                raise InputError(name, x, f"0 to {count - 1}")
        basis = sign * self.basis.stress[:, :, component]
        if layer is not None:
            basis = basis[:, self.points[:, 1] == layer]
        rows = zip(basis.detach(), self.w.detach(), strict=True)
        point = torch.stack([(w @ stress.mT).argmax(-1) for stress, w in rows])
        lane = torch.arange(len(point))[:, None]
        return (basis[lane, point] * self.w).sum(-1)

    def _rule(self, criterion: str) -> tuple[Callable[[Tensor, Tensor], Tensor], Tensor]:
        criterion = one_of("criterion", criterion, CRITERIA)
        return CRITERIA[criterion], required_strength(self.name, self.strength, criterion)


def _strength(body: Any, lanes: int) -> Tensor | None:
    rows = []
    for part in body.plates.values():
        numbers = of_plies(part.laminate.layer_plies)
        if numbers is None:
            return None
        points = ply_points(part.matrices, part.laminate)
        rows.append(numbers[..., points[:, 1], :].expand(lanes, -1, -1))
    return torch.cat(rows, 1)


def of_plies(plies: Sequence[Any]) -> Float[Tensor, "*lanes layers 8"] | None:
    """Strength numbers of plies; None where one has none."""
    strengths = [ply.strength.numbers() for ply in plies if ply.strength is not None]
    return torch.stack(torch.broadcast_tensors(*strengths), -2) if len(strengths) == len(plies) else None


def require_plies(body: object) -> None:
    """Raise InputError for a body without plates of plies."""
    if getattr(body, "plates", None):
        return
    name, hint, state = getattr(body, "name", body), "FlexibleBody.plate(...)", "has no plies"
    if any(isinstance(part.section, Section) for part in getattr(body, "beams", {}).values()):
        hint, state = "mbd.SectionHistory and mbd.PlyFailure for the plies of beams", "has plies in beams only"
    raise InputError("body", name, "a plate", hint, state=state, noun=f"body {name!r}")


def changes_of(motion: MotionData, body: Any) -> list[Temperature]:
    """The changes of temperature and moisture of a body; InputError if a phase of the motion has other laws for them."""
    forces = [force for force in motion.system.forces if isinstance(force, Temperature)]
    changes = [force for force in forces if force.body is body and force.laws]
    for actions in motion.actions:  # of each phase
        laws = {id(law) for action in actions for law in action.laws}
        for force in changes:
            if any(id(law) not in laws for law in force.laws.values()):
                raise InputError(
                    ("phases", "laws"),
                    force.name,
                    "must have one law, such as a function of time, for the whole motion",
                    noun=f"stresses of body {body.name!r} under {force.name!r}",
                    state="are not computed, because a phase of this motion has another law for this load",
                )
    return changes


def amounts(changes: Sequence[Temperature], times: Tensor, lanes: int) -> Float[Tensor, "lanes times changes"]:
    """All changes at times [n] in the present design."""
    rows = [x for force in changes for x in force.histories(times).values()]
    none = torch.zeros(lanes, len(times), 0, dtype=torch.float64)
    return torch.cat([none, *(x.expand(lanes, -1)[..., None] for x in rows)], -1)


def _recovered(
    body: Any, psi: Tensor, changes: Sequence[Temperature], times: Tensor
) -> tuple[PlyBasis, Tensor | None, Tensor]:
    """Ply values of modes and of held unit changes, strengths, and the changes [lanes, times, k], of the present design."""
    lanes = len(psi)
    parts = [ply_basis(part.matrices, part.laminate, psi) for part in body.plates.values()]
    strain, stress = (torch.cat([x.expand(lanes, -1, -1, -1) for x in kind], 1) for kind in zip(*parts, strict=True))
    held = []
    for force in changes:
        for change in force.laws:
            plates = [_held(force, key, part, change).expand(lanes, -1, -1) for key, part in body.plates.items()]
            held.append(torch.cat(plates, 1))
    if held:
        columns = -torch.stack(held, -1)
        strain, stress = torch.cat([strain, torch.zeros_like(columns)], -1), torch.cat([stress, columns], -1)
    return PlyBasis(strain, stress), _strength(body, lanes), amounts(changes, times, lanes)


def _held(force: Temperature, key: str, part: Any, change: str) -> Tensor:
    """Stresses that would cause the free strains of the plies of a part by a unit change [*lanes, points, 5]."""
    if force.zone in (None, key):
        return held_ply_stress(part.matrices, part.laminate, change)
    return torch.zeros(len(ply_points(part.matrices, part.laminate)), 5, dtype=torch.float64)


def _at(basis: Tensor, w: Tensor) -> Tensor:
    """Basis [..., points, 5, modes] times w [..., times, modes]: one product."""
    return (w @ basis.flatten(-3, -2).mT).unflatten(-1, basis.shape[-3:-1])
