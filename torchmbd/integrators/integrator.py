"""The contract of an integrator: a method with its options, which makes motions out of equations.

    integrate           motion of all lanes over equal output intervals
    integrate_phases    the same through the phases of a simulation
    again               what lanes that failed are tried again with

An integrator is a frozen dataclass: its fields but `name` are its options, with types and defaults; `__post_init__` refuses
values out of range. It keeps nothing of a simulation. Those whose steps have an exact pullback (`adjoint`) serve reverse
mode. registry.py lists all integrators, and says how to add one.
Checked in tests/contracts/test_integrators.py.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, NamedTuple, get_type_hints

from torchmbd.integrators.course import Course
from torchmbd.integrators.history import History
from torchmbd.system.dynamics import Dynamics


@dataclass
class Integrated:
    """What an integrator makes: states, statistics, and lanes that it gave up, with the reason; their numbers are nan."""

    history: History
    statistics: dict[str, Any]
    failed: Mapping[int, str] = field(default_factory=dict)


class Again(NamedTuple):
    """What lanes that failed are tried again with: an integrator, and how many of its steps stand for one."""

    integrator: Any
    steps: int


@dataclass(frozen=True)
class Integrator(ABC):
    """See the module header.

    kind            of native code that makes its steps: "step", "rates"; None: there is none
    adjoint         whether its steps have a pullback: reverse mode without phases
    not_in_phases   options that say nothing where there are phases
    """

    name: str
    kind: ClassVar[str | None]
    adjoint: ClassVar[bool]
    not_in_phases: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def option_types(cls, phases: bool = False) -> dict[str, Any]:
        """Names of the options, and their types."""
        hints = get_type_hints(cls)
        names = [f.name for f in fields(cls) if f.name != "name"]
        return {name: hints[name] for name in names if not (phases and name in cls.not_in_phases)}

    @abstractmethod
    def integrate(self, dynamics: Dynamics, duration: float, steps: int) -> Integrated:
        """States at steps + 1 equal times, with tangents where the dynamics have any; a lane that fails is nan."""

    @abstractmethod
    def integrate_phases(self, course: Course) -> dict[str, Any]:
        """Integrate all lanes through all phases, into the record of the course; statistics."""

    def again(self) -> Again | None:
        """What lanes that failed are tried again with; None: nothing more."""
        return None
