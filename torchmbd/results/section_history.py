"""Section forces, stresses and failure of a flexible body's beams along a motion.

    f(t) = forces w(t)              (N, V_y, V_z, T, M_y, M_z) at both ends of every element, its own axes   [N, N m]
    stress(t) = unit f(t)           in ply axes at the integration points of the section's elements          [Pa]

forces   section forces of the body's modes (fem/elements/beams.py)
unit     stresses of the section under unit forces (fem/sections/section.py)

A change of temperature or moisture (forces/temperature.py) subtracts the forces of its free strains, and adds the stresses that
remain in a free section.

Forces vary linearly along an element, so its ends are where a stress is largest. The failure index of a body is the
largest over ends and points; its derivative is that of the point of this largest index, exact wherever this point is unique.
The criteria are those of plies (fem/materials/strength.py): the stress through the ply, 33, is in `stress`, but not judged.
Differentiable with respect to the design along `Trajectory.moved`: through w, the modes and the section itself.
Assumed: Saint-Venant's stresses; where a beam is held or its section changes the true ones differ.
Checked in tests/results/test_section_history.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmbd.errors import InputError, one_of, unknown
from torchmbd.fem.elements import Beams
from torchmbd.fem.materials import CRITERIA, FailureForms
from torchmbd.fem.materials.strength import required_strength
from torchmbd.fem.sections import Section
from torchmbd.multibody.forces.temperature import Temperature
from torchmbd.results.ply_history import amounts, changes_of, of_plies, require_plies

if TYPE_CHECKING:
    from torchmbd.results.trajectory import Trajectory

_CHUNK = 500_000  # indices in memory at once

#: Where the five stresses of a ply, PLY_COMPONENTS, stand among the six of a solid.
_OF_PLY = [0, 1, 5, 4, 3]


class _Part(NamedTuple):
    """Recovery of one part. Changes of temperature are coordinates after the modes, and loads after the six forces.

    forces   loads at the ends by coordinates
    unit     stresses by loads; those of changes are the stresses of the free section
    """

    forces: Float[Tensor, "lanes ends loads coordinates"]
    unit: Float[Tensor, "lanes points 6 loads"]
    strength: Float[Tensor, "lanes points 8"] | None
    length: Float[Tensor, "lanes elements"]


class SectionHistory:
    """The beams of one body along a motion, one part for each section: "section0", "section1", ... of FlexibleBody.beam.

    motion  a Trajectory
    name    of the body

    Its methods return forces [N], moments [N m] and stresses [Pa], lanes first, then times.

    >>> tube = mbd.sections.tube(0.02, mbd.examples.carbon(), mbd.deg([45, -45]), thickness=1e-3, cells=(12, 1))
    >>> rod = mbd.FlexibleBody.beam("rod", mbd.BeamLine.straight(0.5, 2), tube, modes=2, reference="start")
    >>> push = mbd.Force(rod.at("end"), (0, 0, 10.0))
    >>> motion = mbd.simulate(mbd.System([rod], [mbd.Fixed(mbd.Ground().at(), rod.at("start"))], [push]), 0.01, steps=80)
    >>> beams = mbd.SectionHistory(motion, "rod")
    >>> beams.parts, beams.forces().shape  # lanes, times, ends, (N, V_y, V_z, T, M_y, M_z)
    (('section0',), torch.Size([1, 81, 4, 6]))
    """

    def __init__(self, motion: Trajectory, name: str):
        if not hasattr(motion, "body"):
            raise InputError("motion", motion, "a motion, the result of mbd.simulate(...)")
        view = motion.body(name)
        self.name = name
        self._body = motion.system.body(name)
        self._beams = beams_of(self._body)
        changes = changes_of(motion, self._body)
        self._recovered, coordinates = motion.of_designs(lambda: _recovered(self._beams, view.psi, changes, motion.t))
        self.w = torch.cat([view.w, coordinates], -1) if changes else view.w

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the parts, one for each section."""
        return tuple(self._beams)

    def ends(self, part: str | None = None) -> Int[Tensor, "ends 2"]:
        """Element and end (0 start, 1 end) of the section forces of a part; None: of the only one."""
        return self._beams[self._key(part)].ends

    def lengths(self, part: str | None = None) -> Float[Tensor, "lanes elements"]:
        """Lengths of the elements of a part [m], for each design."""
        return self._recovered[self._key(part)].length

    def forces(self, part: str | None = None, times: slice = slice(None)) -> Float[Tensor, "lanes times ends 6"]:
        """(N, V_y, V_z, T, M_y, M_z) at the chosen output times."""
        return torch.einsum("lesm,ltm->ltes", self._recovered[self._key(part)].forces[:, :, :6], self.w[:, times])

    def points(self, part: str | None = None) -> Float[Tensor, "points 2"]:
        """Points y, z of the stresses in the axes of the section [m]."""
        section = self._section(self._key(part))
        element, point = section.stress_points.unbind(1)
        return section.geometry.points[element, point]

    def stress(self, part: str | None = None, times: slice = slice(None)) -> Float[Tensor, "lanes times ends points 6"]:
        """Stresses (11, 22, 33, 23, 13, 12) [Pa] in ply axes at the chosen output times: few, if the section is large."""
        key = self._key(part)
        self._section(key)
        loads = torch.einsum("lesm,ltm->ltes", self._recovered[key].forces, self.w[:, times])
        return torch.einsum("lpcs,ltes->ltepc", self._recovered[key].unit, loads)

    def basis(self, part: str | None = None) -> tuple[Float[Tensor, "lanes points 5 coordinates"], Tensor | None]:
        """Ply stresses at all ends and points of a part [Pa], and strengths there [lanes, points, 8].

        Coordinates are those of `w`: modes, and unit changes of temperature or moisture behind them.
        """
        key = self._key(part)
        self._section(key)
        made = self._recovered[key]
        stress = torch.einsum("lpcs,lesm->lepcm", made.unit[:, :, _OF_PLY], made.forces)
        strength = made.strength
        if strength is not None:
            strength = strength[:, None].expand(-1, stress.shape[1], -1, -1).flatten(1, 2)
        return stress.flatten(1, 2), strength

    def critical(self, criterion: str = "tsai_wu", part: str | None = None) -> Int[Tensor, "lanes times 2"]:
        """The end and the point of a part that are nearest to failure, at each time."""
        key = self._key(part)
        _rule(criterion)
        made, rows, strength = self._recovered[key], [], self._strength(key, criterion)
        ends, points = made.forces.shape[1], made.unit.shape[1]
        for forces, unit, w, numbers in zip(
            *(x.detach() for x in (made.forces, made.unit, self.w, strength)), strict=True
        ):
            index = FailureForms(criterion, unit[:, _OF_PLY], numbers)
            for some in w.split(max(1, _CHUNK // (ends * points))):
                loads = torch.einsum("esm,tm->tes", forces, some).flatten(0, 1)
                rows.append(index(loads).unflatten(0, (-1, ends)).flatten(1).argmax(-1))
        largest = torch.cat(rows).unflatten(0, (len(self.w), -1))
        return torch.stack([torch.div(largest, points, rounding_mode="floor"), largest % points], dim=-1)

    def failure(self, criterion: str = "tsai_wu") -> Float[Tensor, "lanes times"]:
        """Index of the point nearest to failure of all parts at each time: below one nothing fails."""
        lane = torch.arange(len(self.w))[:, None]
        largest: list[Tensor] = []
        for key in laminated(self._body):
            end, point = self.critical(criterion, key).unbind(-1)
            made = self._recovered[key]
            force = torch.einsum("ltsm,ltm->lts", made.forces[lane, end], self.w)
            stress = torch.einsum("ltcs,lts->ltc", made.unit[lane, point][:, :, _OF_PLY], force)
            largest.append(_rule(criterion)(stress, self._strength(key, criterion)[lane, point]))
        if not largest:
            raise InputError(
                "body",
                self.name,
                "made of a Section, such as sections.strip(...)",
                state="have no plies",
                noun=f"the sections of {self.name!r}",
            )
        return torch.stack(largest).amax(0)

    def _key(self, part: str | None) -> str:
        if part is None and len(self._beams) > 1:
            raise InputError((self.name, "part"), part, self._beams, state="is None")
        key = self.parts[0] if part is None else part
        if key not in self._beams:
            raise unknown((self.name, "part"), key, self._beams)
        return key

    def _section(self, key: str) -> Section:
        section = self._beams[key].section
        if not isinstance(section, Section):
            raise InputError(
                (self.name, key), allowed="a Section", state=f"is a {type(section).__name__}, which has no stresses"
            )
        return section

    def _strength(self, key: str, criterion: str) -> Float[Tensor, "lanes points 8"]:
        self._section(key)
        return required_strength(self.name, self._recovered[key].strength, criterion)


def beams_of(body: object) -> dict[str, Beams]:
    """The beams of a body; InputError if it has none."""
    beams = getattr(body, "beams", None)
    if not beams:
        name = getattr(body, "name", body)
        raise InputError(
            "body",
            name,
            allowed="must have beams",
            state="has no beams",
            noun=f"body {name!r}",
            hint="FlexibleBody.beam(...), or a model with beams",
        )
    return beams


def laminated(body: object) -> dict[str, Section]:
    """The meshed sections of a body's beams by the names of the parts; none for a body without."""
    beams: dict[str, Beams] = getattr(body, "beams", {})
    return {key: part.section for key, part in beams.items() if isinstance(part.section, Section)}


def plies_of(body: object) -> list[Any]:
    """The plies of a body's plates and laminated beams; InputError if it has none."""
    sections = laminated(body)
    if not sections:
        require_plies(body)
    plies = [ply for part in getattr(body, "plates", {}).values() for ply in part.laminate.layer_plies]
    return plies + [ply for section in sections.values() for ply in section.plies]


def _rule(criterion: str) -> Any:
    return CRITERIA[one_of("criterion", criterion, CRITERIA)]


def _recovered(
    beams: dict[str, Beams], psi: Tensor, changes: Sequence[Temperature], times: Tensor
) -> tuple[dict[str, _Part], Tensor]:
    """Recovery of all parts, and the changes [lanes, times, k], in the present design."""
    named = [(change, force.zone) for force in changes for change in force.laws]
    parts = {}
    for key, part in beams.items():
        parts[key] = _part(part, psi, [(change, zone in (None, key)) for change, zone in named])
    return parts, amounts(changes, times, len(psi))


def _part(beams: Beams, psi: Tensor, changes: Sequence[tuple[str, bool]]) -> _Part:
    """Recovery of modes, and of changes with whether they act on this part, in the present design."""
    lanes, section, length = len(psi), beams.section, beams.lengths
    unit, strength = psi.new_zeros(0, 6, 6), None
    if isinstance(section, Section):
        unit, numbers = section.unit_stress(), of_plies(section.plies)
        if numbers is not None:  # at the points of stress
            points = section.problem.geometry.layer[section.stress_points[:, 0]]
            strength = numbers[..., points, :].expand(lanes, -1, -1)
    forces = beams.section_forces(psi).flatten(1, 2)
    if changes:
        forces, unit = _with_changes(beams, forces, unit.expand(lanes, *unit.shape[-3:]), changes)
    return _Part(forces, unit.expand(lanes, *unit.shape[-3:]), strength, length.expand(lanes, length.shape[-1]))


def _with_changes(
    beams: Beams, forces: Tensor, unit: Tensor, changes: Sequence[tuple[str, bool]]
) -> tuple[Float[Tensor, "lanes ends loads coordinates"], Float[Tensor, "lanes points 6 loads"]]:
    """Loads by coordinates and stresses by loads with the changes; those of parts on which they do not act are zero."""
    lanes, ends = forces.shape[:2]
    section = beams.section
    for change, acts in changes:
        held, stress = forces.new_zeros(lanes, ends, 6), unit.new_zeros(*unit.shape[:-1])
        if acts:
            held = beams.held_forces(change).flatten(-3, -2).expand(lanes, -1, -1)
        if acts and isinstance(section, Section):
            element, point = section.stress_points.unbind(1)
            stress = section.expansion(change).stress[..., element, point, :].expand(lanes, -1, -1)
        unit = torch.cat([unit, stress[..., None]], -1)
        column = torch.nn.functional.pad(-held, (0, forces.shape[2] - 6))[..., None]
        row = torch.nn.functional.one_hot(torch.tensor(forces.shape[3]), forces.shape[3] + 1).to(forces)
        forces = torch.cat([torch.cat([forces, column], 3), row.expand(lanes, ends, 1, -1)], 2)
    return forces, unit
