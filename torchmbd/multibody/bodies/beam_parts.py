"""The parts of a beam: elements that share a section are one part of the body.

Checked in tests/multibody/bodies/test_beam_body.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.elements import BeamLine, Beams, BeamSection, Part


def beam_parts(
    name: str,
    line: BeamLine,
    section: BeamSection | Sequence[BeamSection],
    orientation: Sequence[float] | Tensor,
    offset: Sequence[float] | Tensor,
    twist: float | Sequence | Tensor,
    mass: str,
) -> dict[str, Part]:
    """Parts "section0", "section1", ... of the distinct sections; arguments as of `FlexibleBody.beam`.

    Raises InputError if the line is none, or has another number of elements than there are sections.
    """
    if not isinstance(line, BeamLine):
        raise InputError(f"line of {name!r} is a {type(line).__name__}; allowed: a BeamLine")
    sections: list[Any] = list(section) if isinstance(section, list | tuple) else [section] * len(line.elements)
    if len(sections) != len(line.elements):
        wrong = f"{len(sections)} sections for {len(line.elements)} elements of {name!r}"
        raise InputError(f"{wrong}; allowed: one, or one for each")
    parts: dict[str, Part] = {}
    for k, cross_section in enumerate(dict.fromkeys(sections)):
        members = [e for e, s in enumerate(sections) if s is cross_section]
        parts[f"section{k}"] = Beams(line, cross_section, orientation, offset, twist, members, mass)
    return parts
