"""The contract of an integrator: a method with its options, which makes motions out of equations.

    integrate           motion of all lanes over equal output intervals
    integrate_phases    the same through the phases of a simulation (loop.py), by
    stepper               regular steps of all lanes, from output to output
    sized                 a step of one lane whose size and end may depend on the design
    again               what lanes that failed are tried again with
    suited              the same with defaults for a system

An integrator is a frozen dataclass: its fields but `name` are its options, with types and defaults; `__post_init__` refuses
values out of range. It keeps nothing of a simulation. Those whose steps have an exact pullback (`adjoint`) serve reverse
mode. registry.py lists all integrators, and says how to add one.
Checked in tests/contracts/test_integrators.py.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, NamedTuple, Protocol, get_type_hints

from torch import Tensor

from torchmbd.integrate.contacts import Doubt
from torchmbd.integrate.phases.run import MultiphaseRun
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.multibody.system.topology import Prescribed, Topology
from torchmbd.results.history import History
from torchmbd.results.state import State


@dataclass
class Integrated:
    """What an integrator makes: states, statistics, and lanes that it gave up, with the reason; their numbers are nan.

    doubts   of lanes with contacts that the steps do not show
    """

    history: History
    statistics: dict[str, Any]
    failed: Mapping[int, str] = field(default_factory=dict)
    doubts: Mapping[int, Doubt] = field(default_factory=dict)


class Again(NamedTuple):
    """What lanes that failed are tried again with: an integrator, and how many of its steps stand for one."""

    integrator: Any
    steps: int


class Stepper(Protocol):
    """Regular steps of the lanes of one system; keeps what goes on from step to step.

    failed   lanes that cannot be integrated, with the reason
    """

    failed: dict[int, str]

    def step(self, i: int, x: State, given: Prescribed, lanes: Tensor) -> State:
        """The state at time i of the grid; with tangents, the exact derivative of the discrete step, where x has them.

        given   what is known at its end;  lanes: a mask: others have no motion, and come out with any numbers
        """
        ...

    def forget(self) -> None:
        """The state has jumped: what is kept does not suit it."""
        ...

    def errors(self, history: History, duration: float, numbers: list[int] | None = None) -> dict[str, Tensor]:
        """What the steps to the times of these numbers left to be desired, for statistics [lanes]."""
        ...


@dataclass(frozen=True)
class Integrator(ABC):
    """See the module header.

    kind            of native code that makes its steps: "step", "rates"; None: there is none
    adjoint         whether its steps have a pullback: reverse mode
    shortest        step that it bears, of the regular one
    not_in_phases   options that say nothing where there are phases
    """

    name: str
    kind: ClassVar[str | None]
    adjoint: ClassVar[bool]
    shortest: ClassVar[float] = 0.0
    not_in_phases: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def option_types(cls, phases: bool = False) -> dict[str, Any]:
        """Names of the options, and their types."""
        hints = get_type_hints(cls)
        names = [f.name for f in fields(cls) if f.name != "name"]
        return {name: hints[name] for name in names if not (phases and name in cls.not_in_phases)}

    def suited(self, topology: Topology) -> Integrator:
        """The integrator with the defaults that depend on the system."""
        return self

    @abstractmethod
    def integrate(self, dynamics: Dynamics, duration: float, steps: int) -> Integrated:
        """States at steps + 1 equal times, with tangents where the dynamics have any; a lane that fails is nan."""

    @abstractmethod
    def integrate_phases(self, multiphase: MultiphaseRun) -> dict[str, Any]:
        """Integrate all lanes through all phases, into the record of the multiphase run; statistics."""

    @abstractmethod
    def stepper(self, dynamics: Dynamics, h: float) -> Stepper:
        """Regular steps of size h [s]."""

    @abstractmethod
    def sized(self, dynamics: Dynamics, x: State, h: Any, t1: Any) -> State:
        """The state of one lane after a step of size h that ends at t1; numbers [1 + n, 1], pairs if x are.

        Those of x and of the result carry total derivatives: times may depend on the design.
        """

    def kept(self, steps: int) -> int:
        """How many states of so many steps are kept, but the first; InputError if the steps do not suit the options."""
        return steps

    def fitting(self, steps: int) -> int:
        """A number of steps that suits the options, not below the given one."""
        return steps

    def again(self) -> Again | None:
        """What lanes that failed are tried again with; None: nothing more."""
        return None
