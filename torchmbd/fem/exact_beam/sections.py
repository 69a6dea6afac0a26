"""The sections of an exact beam along its line, and the properties of its elements.

Checked in tests/fem/exact_beam/test_section_table.py.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.fem.elements import BeamLine, BeamMatrices, BeamSection
from torchmbd.fem.elements.beam_section import line_transform
from torchmbd.fem.exact_beam.section_table import SectionTable
from torchmbd.math.gradients import all_true, untransformed
from torchmbd.math.inverse import balanced_inverse
from torchmbd.math.rigid_motion import LARGEST, logarithm


class SpanSections:
    """The sections along a beam: one for all elements, one for each, or a table along a chain.

    modules   the sections by name: "section", or "section0", "section1", ...
    tapered   whether the section varies within an element
    """

    def __init__(self, name: str, line: BeamLine, section: Any) -> None:
        m = len(line.elements)
        self.name, self._table = name, section if isinstance(section, SectionTable) else None
        self.tapered = self._table is not None
        if self._table is not None:
            chain = torch.stack([torch.arange(m), torch.arange(m) + 1], 1)
            if not torch.equal(line.elements, chain):
                raise InputError(
                    f"section of {name!r} is a SectionTable and its line is no chain; allowed: 0-1, 1-2, ..."
                )
            self.modules: dict[str, nn.Module] = {"section": self._table}
            return
        by_element: list[Any] = list(section) if isinstance(section, list | tuple) else [section] * m
        if len(by_element) != m:
            raise InputError(f"{len(by_element)} sections for {m} elements of {name!r}; allowed: one, or one for each")
        for x in by_element:
            if not (isinstance(x, nn.Module) and isinstance(x, BeamSection)):
                raise InputError(f"section of {name!r} is {x!r}; allowed: a Section, a GivenSection, a SectionTable")
        self._sections = list(dict.fromkeys(by_element))
        self._index = torch.tensor([self._sections.index(x) for x in by_element])
        names = ["section"] if len(self._sections) == 1 else [f"section{k}" for k in range(len(self._sections))]
        self.modules = dict(zip(names, self._sections, strict=True))

    def stiffness(self, length: Float[Tensor, "*lanes m"], t: Float[Tensor, " g"]) -> Float[Tensor, "*lanes m g 6 6"]:
        """Stiffness at parts t of the elements; InputError where it is not positive definite."""
        at = positions(length, t)
        matrices = self._at("stiffness", at)
        good = torch.linalg.cholesky_ex(untransformed(matrices))[1] == 0
        if not all_true(good):
            m, g = at.shape[-2:]
            k = int(good.reshape(-1, m * good.shape[-1]).all(0).logical_not().nonzero()[0, 0])
            element, place = (
                k // good.shape[-1],
                float(untransformed(at).reshape(-1, m, g)[0].flatten()[k if good.shape[-1] == g else k * g]),
            )
            raise InputError(
                f"section of {self.name!r} at {place:.3g} of its length (element {element}) is not positive definite; "
                "allowed: a stiffness that does work in every strain"
            )
        return matrices

    def mass(self, length: Float[Tensor, "*lanes m"], t: Float[Tensor, " g"]) -> Float[Tensor, "*lanes m g 6 6"]:
        """Mass per length at parts t of the elements."""
        return self._at("mass", positions(length, t))

    def _at(self, what: str, at: Tensor) -> Tensor:
        if self._table is not None:
            return getattr(self._table, what)(at)
        every = torch.stack(torch.broadcast_tensors(*(getattr(section, what)() for section in self._sections)), -3)
        return every[..., self._index, None, :, :]


def positions(length: Float[Tensor, "*lanes m"], t: Float[Tensor, " g"]) -> Float[Tensor, "*lanes m g"]:
    """Return the positions of parts t of the elements, as parts of the whole length of a chain."""
    end = length.cumsum(-1)
    return ((end - length)[..., None] + t * length[..., None]) / end[..., -1:, None]


class ElementProperties(NamedTuple):
    """Properties of the elements in the present design.

    stiffness  forces by screws (forces.py) [m, 6, 6]
    screws     without load [m, 6]
    axes       of the sections at both ends, in mesh axes, columns [m, 2, 3, 3]
    recover    maps force and moment in the axes of an end to (N, V_y, V_z, T, M_y, M_z) of its section [m, 2, 6, 6]
    matrices   the linear elements
    to_line    W (beam_section.py) of the sections at both ends [m, 2, 6, 6]
    """

    stiffness: Float[Tensor, "*lanes m 6 6"]
    screws: Float[Tensor, "*lanes m 6"]
    axes: Float[Tensor, "*lanes m 2 3 3"]
    recover: Float[Tensor, "*lanes m 2 6 6"]
    matrices: BeamMatrices
    to_line: Float[Tensor, "*lanes m 2 6 6"]


_ENDS = torch.tensor([0.0, 1.0], dtype=torch.float64)


def element_properties(
    sections: SpanSections, matrices: BeamMatrices, offset: Tensor, twist: Tensor, nodes: Tensor
) -> ElementProperties:
    """Return the properties of the elements.

    matrices       the linear elements at the present nodes
    offset, twist  of the sections [2] or [m, 2]; [], [m] or [m, 2]

    Raises InputError where an element turns by more than LARGEST, or a section is not positive definite.
    """
    ends = twist[..., None].expand(*twist.shape, 2) if twist.dim() < 2 else twist
    offset = offset.expand(len(matrices.elements), 2)[:, None]
    t = matrices.stations
    at = ends[..., :1] + t * (ends[..., 1:] - ends[..., :1])
    # Forces of the section about the line, in the section's axes.
    force_map = block(_turn(at)).mT @ line_transform(offset, at)
    stiffness = force_map @ sections.stiffness(matrices.length, t) @ force_map.mT
    compliance = matrices.average(balanced_inverse(stiffness))
    turn = _turn(ends)
    axes = matrices.frames(_ENDS).mT @ turn
    first, second = axes.unbind(-3)
    i, j = matrices.elements.unbind(1)
    relative = first.mT @ second
    good = untransformed(relative).diagonal(dim1=-2, dim2=-1).sum(-1) > 1.0 + 2.0 * math.cos(LARGEST)
    if not all_true(good):
        k = int(good.reshape(-1, len(i)).all(0).logical_not().nonzero()[0, 0])
        raise InputError(f"element {k} of {sections.name!r} turns by more than {LARGEST} rad; allowed: more elements")
    apart = nodes[..., j, :] - nodes[..., i, :]
    screws = logarithm((first.mT @ apart[..., None])[..., 0], relative)
    to_line = line_transform(offset, ends)
    recover = torch.linalg.inv(to_line) @ block(turn)
    return ElementProperties(balanced_inverse(compliance), screws, axes, recover, matrices, to_line)


def _turn(twist: Float[Tensor, "*n"]) -> Float[Tensor, "*n 3 3"]:
    """Axes of sections that are twisted [rad], in the axes of the beam, columns."""
    c, s, o = torch.cos(twist), torch.sin(twist), torch.zeros_like(twist)
    return torch.stack([o + 1.0, o, o, o, c, -s, o, s, c], -1).unflatten(-1, (3, 3))


def block(A: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n 6 6"]:
    """Return diag(A, A), which maps forces and moments."""
    o = torch.zeros_like(A)
    return torch.cat([torch.cat([A, o], -1), torch.cat([o, A], -1)], -2)
