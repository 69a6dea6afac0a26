"""The sections of an exact beam along its line, and the properties of its elements.

Stiffness and mass of a table are integrated over every piece between two positions of the table and two ends of elements:

    compliance   int J' (W S W')^-1 J ds               over an element, J: from forces about its middle to those at s
    mass         int m ds, int s m ds, int s^2 m ds    over half an element, s from its node

So nothing between two nodes is lost, however few the elements: the mass is exact, the compliance to the order of Gauss's rule.
A soft piece bends under the moment where it lies, wherever that is in its element. A section that is the same along an element
has J = 1: the element's strain is constant (MacNeal's residual bending flexibility, int (J' C J - C) ds, is left out).
Source: MacNeal, A simple quadrilateral shell element, Comput. Struct. 8 (1978) 175-183.
Checked in tests/fem/exact_beam/test_section_table.py.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.fem.elements import BeamLine, BeamMatrices, BeamSection
from torchmbd.fem.elements.beam_section import free_strain_of, line_transform
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
                    (name, "section"),
                    section,
                    "must have a line with the elements 0-1, 1-2, ...",
                    state="is a SectionTable, but its line is not a chain",
                )
            self.modules: dict[str, nn.Module] = {"section": self._table}
            return
        by_element: list[Any] = list(section) if isinstance(section, list | tuple) else [section] * m
        if len(by_element) != m:
            raise InputError(
                (name, "section"),
                allowed="must have one, or one for each element",
                state=f"has {len(by_element)} sections for {m} elements",
            )
        for x in by_element:
            if not (isinstance(x, nn.Module) and isinstance(x, BeamSection)):
                raise InputError((name, "section"), x, "a Section, a GivenSection, a SectionTable")
        self._sections = list(dict.fromkeys(by_element))
        self._index = torch.tensor([self._sections.index(x) for x in by_element])
        names = ["section"] if len(self._sections) == 1 else [f"section{k}" for k in range(len(self._sections))]
        self.modules = dict(zip(names, self._sections, strict=True))

    def compliance_rule(self, matrices: BeamMatrices) -> Rule:
        """Points at which the compliance of the elements is taken."""
        start, end = _ends_of_elements(matrices.length)
        rule = self._rule(start, end, matrices.stations, matrices.weights)
        return rule._replace(weight=rule.weight * matrices.length.sum(-1)[..., None, None])

    def stiffness(self, rule: Rule) -> Float[Tensor, "*lanes p g 6 6"]:
        """Stiffness at the points of a rule (g is 1 where it is the same); InputError if it is not positive definite."""
        matrices = self._at("stiffness", rule)
        good = torch.linalg.cholesky_ex(untransformed(matrices))[1] == 0
        if not all_true(good):
            count = good.shape[-1]
            k = int(good.reshape(-1, len(rule.span) * count).all(0).logical_not().nonzero()[0, 0])
            places = untransformed(rule.at).reshape(-1, *rule.at.shape[-2:])[0]
            element, place = int(rule.span[k // count]), float(places[k // count, k % count])
            raise InputError(
                (self.name, "section"),
                allowed="must have a positive definite stiffness",
                state=f"at {place:.3g} of its length (element {element}) is not positive definite",
            )
        return matrices

    def free_strain(self, change: str, rule: Rule) -> Float[Tensor, "*lanes p g 6"]:
        """Strains of the free sections by a unit change at the points of a rule (g is 1 where they are the same)."""
        if self._table is not None:
            return self._table.free_strain(change, rule.at)
        strains = [free_strain_of(section, change) for section in self._sections]
        every = torch.stack(torch.broadcast_tensors(*strains), -2)
        return every[..., self._index[rule.span], None, :]

    def mass_moments(self, length: Float[Tensor, "*lanes m"]) -> list[Float[Tensor, "*lanes m 2 6 6"]]:
        """Integrals of m, s m, s^2 m over both halves of the elements; m: the mass per length, s from the node of the half."""
        start, end = _ends_of_elements(length)
        middle, whole = 0.5 * (start + end), length.sum(-1)[..., None, None]
        halves = torch.stack([start, middle], -1).flatten(-2), torch.stack([middle, end], -1).flatten(-2)
        rule = self._rule(*halves, *_CUBIC)
        node = torch.stack([start, end], -1).flatten(-2)[..., rule.span]
        s = whole * (rule.at - node[..., None]).abs()
        element = rule.span // 2
        mass = self._at("mass", rule._replace(span=element))
        weights = (whole * rule.weight * s**k for k in range(3))
        sums = (rule.sum(weight[..., None, None] * mass, 2 * length.shape[-1]) for weight in weights)
        return [x.unflatten(-3, (-1, 2)) for x in sums]

    def _rule(self, start: Tensor, end: Tensor, points: Tensor, weights: Tensor) -> Rule:
        """Points [g] of a rule in each linear piece of the spans from `start` to `end` [*lanes, spans]."""
        if self._table is None:
            span, low, high = torch.arange(start.shape[-1]), start, end
        else:
            table = self._table.positions
            low, high = torch.maximum(start[..., None], table[:-1]), torch.minimum(end[..., None], table[1:])
            inside = (untransformed(high - low) > 0.0).reshape(-1, *low.shape[-2:]).any(0)
            span, interval = inside.nonzero(as_tuple=True)
            low, high = low[..., span, interval], torch.maximum(low, high)[..., span, interval]
        at = low[..., None] + points * (high - low)[..., None]
        first, last = start[..., span, None], end[..., span, None]
        return Rule(span, at, (at - first) / (last - first), weights * (high - low)[..., None])

    def _at(self, what: str, rule: Rule) -> Tensor:
        if self._table is not None:
            return getattr(self._table, what)(rule.at)
        every = torch.stack(torch.broadcast_tensors(*(getattr(section, what)() for section in self._sections)), -3)
        return every[..., self._index[rule.span], None, :, :]


class Rule(NamedTuple):
    """Points of integration along a beam, g in each of p pieces.

    span     number of the element that a piece belongs to [p]
    at, part of the whole length;  t, part of the element [*lanes, p, g]
    weight   share of the whole length
    """

    span: Int[Tensor, " p"]
    at: Float[Tensor, "*lanes p g"]
    t: Float[Tensor, "*lanes p g"]
    weight: Float[Tensor, "*lanes p g"]

    def sum(self, x: Float[Tensor, "*lanes p g 6 k"], spans: int) -> Float[Tensor, "*lanes spans 6 k"]:
        """Sum numbers at the points over each span."""
        pieces = x.sum(-3)
        return pieces.new_zeros(*pieces.shape[:-3], spans, *pieces.shape[-2:]).index_add(-3, self.span, pieces)


def _gauss(count: int) -> tuple[Tensor, Tensor]:
    points, weights = (torch.from_numpy(x) / 2.0 for x in np.polynomial.legendre.leggauss(count))
    return 0.5 + points, weights


_CUBIC = _gauss(2)  # exact for s^2 times a linear mass


def _ends_of_elements(length: Float[Tensor, "*lanes m"]) -> tuple[Tensor, Tensor]:
    """Return the starts and ends of the elements of a chain, as parts of the whole length [*lanes, m]."""
    end = length.cumsum(-1)
    return (end - length) / end[..., -1:], end / end[..., -1:]


class ElementProperties(NamedTuple):
    """Properties of the elements in the present design.

    stiffness  forces by screws (forces.py) [m, 6, 6]
    screws     without load [m, 6]
    axes       of the sections at both ends, in mesh axes, columns [m, 2, 3, 3]
    recover    maps force and moment in the axes of an end to (N, V_y, V_z, T, M_y, M_z) of its section [m, 2, 6, 6]
    matrices   the linear elements
    to_line    W (beam_section.py) of the sections at both ends [m, 2, 6, 6]
    free       changes of the screws without load by unit changes of temperature and moisture: kind of change -> [m, 6]
    """

    stiffness: Float[Tensor, "*lanes m 6 6"]
    screws: Float[Tensor, "*lanes m 6"]
    axes: Float[Tensor, "*lanes m 2 3 3"]
    recover: Float[Tensor, "*lanes m 2 6 6"]
    matrices: BeamMatrices
    to_line: Float[Tensor, "*lanes m 2 6 6"]
    free: dict[str, Float[Tensor, "*lanes m 6"]]


_ENDS = torch.tensor([0.0, 1.0], dtype=torch.float64)


def element_properties(
    sections: SpanSections,
    matrices: BeamMatrices,
    offset: Tensor,
    twist: Tensor,
    nodes: Tensor,
    changes: Iterable[str] = (),
) -> ElementProperties:
    """Return the properties of the elements.

    matrices       the linear elements at the present nodes
    offset, twist  of the sections [2] or [m, 2]; [], [m] or [m, 2]
    changes        kinds of change whose free strains are computed

    Raises InputError if an element turns by more than LARGEST, or a section is not positive definite.
    """
    ends = twist[..., None].expand(*twist.shape, 2) if twist.dim() < 2 else twist
    m = len(matrices.elements)
    offset = offset.expand(m, 2)[:, None]
    rule = sections.compliance_rule(matrices)
    first, last = ends.expand(torch.broadcast_shapes(ends.shape, (m, 2)))[..., rule.span, :].unbind(-1)
    at = first[..., None] + rule.t * (last - first)[..., None]
    # Forces of the section about the line, in the section's axes.
    force_map = block(_turn(at)).mT @ line_transform(offset[rule.span], at)
    stiffness = force_map @ sections.stiffness(rule) @ force_map.mT
    softness = balanced_inverse(stiffness)
    strains = {change: _line_strain(sections.free_strain(change, rule), force_map) for change in changes}
    if sections.tapered:
        arm = _arm((rule.t - 0.5) * matrices.length[..., rule.span, None])
        softness = arm.mT @ softness @ arm
        strains = {change: arm.mT @ strain for change, strain in strains.items()}
    weight = rule.weight[..., None, None]
    compliance = rule.sum(weight * softness, m)
    free = {change: rule.sum(weight * strain, m)[..., 0] for change, strain in strains.items()}
    turn = _turn(ends)
    axes = matrices.frames(_ENDS).mT @ turn
    first, second = axes.unbind(-3)
    i, j = matrices.elements.unbind(1)
    relative = first.mT @ second
    good = untransformed(relative).diagonal(dim1=-2, dim2=-1).sum(-1) > 1.0 + 2.0 * math.cos(LARGEST)
    if not all_true(good):
        k = int(good.reshape(-1, len(i)).all(0).logical_not().nonzero()[0, 0])
        raise InputError(
            (sections.name, "line"),
            allowed="must turn by less",
            noun=f"element {k} of {sections.name!r}",
            state=f"turns by more than {LARGEST} rad",
            hint="more elements",
        )
    apart = nodes[..., j, :] - nodes[..., i, :]
    screws = logarithm((first.mT @ apart[..., None])[..., 0], relative)
    to_line = line_transform(offset, ends)
    recover = torch.linalg.inv(to_line) @ block(turn)
    return ElementProperties(balanced_inverse(compliance), screws, axes, recover, matrices, to_line, free)


def _line_strain(strain: Float[Tensor, "*n 6"], force_map: Float[Tensor, "*n 6 6"]) -> Float[Tensor, "*n 6 1"]:
    """Strains on which forces about the line do the work that those of the section do on its strains."""
    return torch.linalg.inv(force_map).mT @ strain[..., None]


def _turn(twist: Float[Tensor, "*n"]) -> Float[Tensor, "*n 3 3"]:
    """Axes of sections that are twisted [rad], in the axes of the beam, columns."""
    c, s, o = torch.cos(twist), torch.sin(twist), torch.zeros_like(twist)
    return torch.stack([o + 1.0, o, o, o, c, -s, o, s, c], -1).unflatten(-1, (3, 3))


def _arm(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n 6 6"]:
    """Return the map from force and moment about a point to those about one that is x [m] farther along the beam."""
    lever = torch.zeros(6, 6, dtype=torch.float64)
    lever[4, 2], lever[5, 1] = 1.0, -1.0
    return torch.eye(6, dtype=torch.float64) + x[..., None, None] * lever


def block(A: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n 6 6"]:
    """Return diag(A, A), which maps forces and moments."""
    o = torch.zeros_like(A)
    return torch.cat([torch.cat([A, o], -1), torch.cat([o, A], -1)], -2)
