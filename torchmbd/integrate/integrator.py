"""The contract of an integrator: a method with its options, which makes the steps of a motion (phases/loop.py).

    stepper               regular steps of all lanes, from output to output
    step_of_size          a step of every lane whose size and end may depend on the design
    smooth_start          the states from which steps go on at the start, after a switch, or with another size
    estimates             of the errors of the steps
    retry                 the integrator for lanes that failed
    with_defaults         the same integrator, defaults chosen for a system

An integrator is a frozen dataclass: its fields but `name` are its options, with types and defaults; `__post_init__` refuses
values out of range. It keeps nothing of a simulation. Those whose steps have an exact pullback (`adjoint`) serve reverse
mode. registry.py lists all integrators, and says how to add one.
Checked in tests/contracts/test_integrators.py.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Set
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, NamedTuple, get_type_hints

import torch
from torch import Tensor

from torchmbd.integrate.contacts import UnresolvedContact
from torchmbd.integrate.estimates import StepEstimates
from torchmbd.integrate.smooth_start import SmoothStart
from torchmbd.integrate.statistics import Statistics
from torchmbd.multibody.equations.data import Data
from torchmbd.multibody.equations.sizes import Sizes
from torchmbd.multibody.equations.topology import Schedule, Topology
from torchmbd.multibody.system.dynamics import Dynamics, SaddleSolver
from torchmbd.results.history import History, Record
from torchmbd.results.motion_data import Switch
from torchmbd.results.state import State


@dataclass
class IntegrationResult:
    """States and statistics of all lanes.

    sizes      of the numbers of the history (equations/sizes.py)
    failed     lanes that were given up, with the reason; numbers count up to there only
    contacts   of lanes with contacts that the steps do not show, the first
    doubts     of lanes whose events the steps may have missed, the first
    for_good   lanes among those that failed that would with smaller steps as well
    switches   between segments
    data       with the marks of locks; None: those of the problem
    """

    history: History
    statistics: Statistics
    sizes: Sizes
    failed: Mapping[int, str] = field(default_factory=dict)
    contacts: Mapping[int, UnresolvedContact] = field(default_factory=dict)
    doubts: Mapping[int, str] = field(default_factory=dict)
    for_good: Set[int] = frozenset()
    switches: list[Switch] = field(default_factory=list)
    data: Data | None = None


class Steps(NamedTuple):
    """Steps of an integrator, so many of which stand for one that was asked for."""

    integrator: Integrator
    substeps: int


class Stepper(ABC):
    """Regular steps of the lanes of one system.

    failed   lanes that cannot be integrated, with the reason
    counts   mask of the lanes that have a motion; the others come out with any numbers
    steps    number of those that were made last

    Steps that keep nothing from one to the next, and are not iterated or to rounding, need no other methods than the first two.
    """

    steps: int

    def __init__(self, dynamics: Dynamics):
        self.dynamics = dynamics
        self.failed: dict[int, str] = {}
        self.counts = torch.ones(dynamics.lanes, dtype=torch.bool)

    @abstractmethod
    def run(self, x: State, schedule: Schedule, record: Record, first: int = 0, start: int = 1) -> State:
        """The last state of many steps; with tangents, the exact derivative of the steps.

        first      the point of the grid at which the first step begins: step k leads from point k to point k + 1
        schedule   drives and bodies of known motion at the ends of the steps
        record     takes all states, from time `start` on
        """

    @abstractmethod
    def algorithmic(self, a: Any, vd: Tensor) -> Any:
        """The algorithmic acceleration after steps, from a before them and true ones vd [1 + steps, n_v, pair, lanes]."""

    def restart(self, lanes: Tensor | None = None) -> None:
        """Discard what is kept: the state of all lanes, or of those of a mask, has jumped."""
        del lanes  # nothing is

    def take_errors(self, counted: Tensor | None = None) -> Tensor:
        """Estimated sizes [lanes, steps] of what the iterations of the last steps left; they are forgotten.

        counted   the steps of which lanes count [steps, lanes]; None: all
        """
        return torch.zeros(self.dynamics.lanes, self.steps, dtype=torch.float64)

    def statistics(self) -> Statistics:
        """Of all steps: errors of tangents, if there were any, and further corrections."""
        return Statistics()


@dataclass(frozen=True)
class Integrator(ABC):
    """See the module header.

    work            what backends may make for it (backend.py): "step", "rates"
    adjoint         whether its steps have a pullback: reverse mode
    condenses       whether its regular steps are those of the condensed system
    shortest_step   size of the shortest step that it makes, relative to a regular one
    """

    name: str
    work: ClassVar[tuple[str, ...]] = ()
    adjoint: ClassVar[bool]
    condenses: ClassVar[bool] = False
    shortest_step: ClassVar[float] = 0.0

    @classmethod
    def option_types(cls) -> dict[str, Any]:
        """Names of the options, and their types."""
        hints = get_type_hints(cls)
        return {f.name: hints[f.name] for f in fields(cls) if f.name != "name"}

    def with_defaults(self, topology: Topology) -> Integrator:
        """The integrator with the defaults that depend on the system."""
        return self

    @abstractmethod
    def stepper(self, dynamics: Dynamics, h: float) -> Stepper:
        """Regular steps of size h [s]."""

    @abstractmethod
    def step_of_size(self, dynamics: Dynamics, x: State, h: Any, t1: Any, near: State | None = None) -> State:
        """The states of all lanes after steps of sizes h that end at t1; numbers [1 + n, lanes], pairs if x are.

        near   states near those at the end, where some are known: fewer iterations

        Numbers of x and of the result carry total derivatives: times may depend on the design. A lane that cannot make its
        step is nan.
        """

    def smooth_start(
        self, dynamics: Dynamics, x: State, t: Any, h: Any, closed: bool = False, solver: SaddleSolver | None = None
    ) -> SmoothStart:
        """From which states steps go on without transients: at the start, after a switch or with another size.

        dynamics   not condensed;  x: states at times t [1 + n, lanes];  h: sizes of regular steps
        closed     x is the start of a motion, and solver that of its accelerations, where there is one (smooth_start.py)
        """
        return SmoothStart()

    def estimates(self, dynamics: Dynamics, duration: float, steps: int) -> StepEstimates | None:
        """Return estimates of the errors of equal steps of these dynamics; None: the method has none."""
        return None

    def stored_intervals(self, steps: int) -> int:
        """The number of intervals between the states that are kept; InputError if the steps do not suit the options."""
        return steps

    def round_up_steps(self, steps: int) -> int:
        """The least number of steps that suits the options and is not below the given one."""
        return steps

    @property
    def refines(self) -> bool:
        """True if lanes may be integrated by smaller steps than asked for."""
        return False

    def retry(self) -> Steps | None:
        """Steps for lanes that failed; None: they are not integrated again."""
        return None
