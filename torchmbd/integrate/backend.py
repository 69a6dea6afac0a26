"""What makes the steps of a motion: operators of torch, or a backend of an extension, which makes the same steps faster.

    obstacle          why a backend cannot serve a system; what it needs is made ready before the first step
    stepper           equal steps of one-step methods, with tangents
    adjoint_solver    the same steps backwards
    unknowns          of a step whose size differs from lane to lane
    accelerations, third_rates    of the start of a motion
    right_hand_side   of the index-1 equations

`Backend` itself is "eager", the reference. Another one is a subclass with those of these parts that it makes, and a line of the
table "backends" (torchmbd/registry.py). `with_backend` chooses before the first step; dynamics carry the name from then on.
Checked in tests/integrate/test_backend.py, tests/extensions/native/test_library.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

from torch import Tensor

from torchmbd.errors import InputError, warn
from torchmbd.integrate.adjoint_solver import AdjointSolver, Grid
from torchmbd.integrate.ode import RightHandSide
from torchmbd.integrate.step import Model, Step, Weights
from torchmbd.integrate.stepper import EagerStepper
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.registry import Registry
from torchmbd.results.state import State

_warned: set[str] = set()


class Backend:
    """See the module header. Results of another backend agree with these within the tolerance of iterations."""

    #: Processor time of a motion with gradients, in times of one without: a + b variables forward, a + b numbers in reverse.
    #: Measured on the slider-crank and the arm of the examples (2, 8 and 24 variables, 1 to 16 numbers). An operator of
    #: torch costs its call here, so tangents are nearly free.
    forward_cost: ClassVar[tuple[float, float]] = (1.35, 0.01)
    reverse_cost: ClassVar[tuple[float, float]] = (1.6, 0.7)

    def serves_auto(self) -> bool:
        """True if "auto" tries it first."""
        return False

    def obstacle(self, dynamics: Dynamics, work: Sequence[str]) -> str | None:
        """Why it cannot serve a system, None if it can; what it needs for the first kind of work is there then.

        work   "step", "adjoint", "rates"; empty: what is needed is not known yet (phases)
        """
        return None

    def stepper(self, dynamics: Dynamics, w: Weights, corrections: tuple[int, int], refresh: int) -> EagerStepper:
        """Steps with weights w; corrections of values and tangents, and steps between two inverses, as in `OneStep`."""
        return EagerStepper(dynamics, Model.of(dynamics, w), corrections, refresh)

    def adjoint_solver(self, grid: Grid) -> AdjointSolver:
        """The adjoint through the steps of a grid."""
        return AdjointSolver(grid)

    def unknowns(self, dynamics: Dynamics, step: Step) -> tuple[Tensor, Tensor] | None:
        """Unknowns [n, 1, lanes] of a step, and the sizes of its last two corrections [2, lanes]; None: variable_step.py."""
        return None

    def accelerations(self, dynamics: Dynamics, q: Any, v: Any) -> Tensor | None:
        """Accelerations at the start of a motion, above their multipliers [n_v + rows, 1, lanes].

        Differentiable in reverse mode. If the coordinates have tangents, these are the values alone, `known` of
        `Dynamics.accelerations`, which adds the tangents. None: `Dynamics.accelerations` computes them.
        """
        return None

    def third_rates(self, dynamics: Dynamics, weights: Weights, x: State, h: Any) -> Tensor | None:
        """Values of jerk and d at the start of a motion by steps of sizes h, which are `known` of `smooth_start`.

        [n_v + rows, 2, lanes]; None: `smooth_start` computes them.
        """
        return None

    def threads(self, dynamics: Dynamics, work: Sequence[str]) -> int:
        """The number of threads that do this work for all lanes."""
        return 1

    def right_hand_side(self, dynamics: Dynamics) -> RightHandSide:
        """dy/dt of augmented states (ode.py)."""
        return RightHandSide(dynamics)

    def files(self) -> list[tuple[Path, int, bool]]:
        """What it keeps in the cache folder: path, bytes, and whether it is complete."""
        return []

    def clear_files(self) -> None:
        """Remove these."""


#: Name -> class; `backend="auto"` takes the first that serves.
BACKENDS: Registry[type[Backend]] = Registry("backends", {"eager": Backend})


def likely_backend(backend: str) -> type[Backend]:
    """Return the class that `backend` names; for "auto" the one that is tried first."""
    if backend != "auto":
        return BACKENDS[backend]
    return next((kind for kind in map(BACKENDS.__getitem__, BACKENDS) if kind().serves_auto()), Backend)


def backend_of(dynamics: Dynamics) -> Backend:
    """The backend whose name dynamics carry; InputError if it is not installed, as on another machine."""
    if dynamics.backend not in BACKENDS:
        raise InputError(
            "backend",
            dynamics.backend,
            "made by a backend that is installed",
            noun="steps",
            state=f"were made by the backend {dynamics.backend!r}, and {BACKENDS.missing(dynamics.backend)}",
        )
    return BACKENDS[dynamics.backend]()


def with_backend(dynamics: Dynamics, backend: str, work: Sequence[str] = ("step",)) -> Dynamics:
    """The dynamics with the name of the backend that makes their steps.

    backend   name, whose obstacle is an InputError; or "auto": the first without an obstacle, which is a warning, once
    work      as in `Backend.obstacle`
    """
    for name in [k for k in BACKENDS if BACKENDS[k]().serves_auto()] if backend == "auto" else [backend]:
        why = BACKENDS[name]().obstacle(dynamics, work)
        if why is None:
            return replace(dynamics, backend=name)
        if backend != "auto":
            raise InputError("backend", name, "'eager' or 'auto'", shown=f"{name!r}, but {why}")
        if why not in _warned:
            _warned.add(why)
            warn(f"simulate uses the slower backend 'eager' (torch operators), because {why}")
    return replace(dynamics, backend="eager")
