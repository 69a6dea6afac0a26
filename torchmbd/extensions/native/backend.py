"""Compiled code as a backend (integrate/backend.py): where there is no library for a part, operators of torch make it.

Checked in tests/extensions/native/test_library.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

from torch import Tensor

from torchmbd.extensions.native import start, steps_of_size
from torchmbd.extensions.native.backward import NativeAdjointSolver
from torchmbd.extensions.native.codegen import build_cache
from torchmbd.extensions.native.codegen.compiler import compilation_wanted
from torchmbd.extensions.native.library import calls_back, library, obstacle, threads_of
from torchmbd.extensions.native.rates import NativeRightHandSide
from torchmbd.extensions.native.steps import NativeStepper
from torchmbd.integrate.adjoint_solver import AdjointSolver, Grid
from torchmbd.integrate.backend import Backend
from torchmbd.integrate.ode import RightHandSide
from torchmbd.integrate.step import Step, Weights
from torchmbd.integrate.stepper import EagerStepper
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.state import State


class NativeBackend(Backend):
    """By one library for a kind of mechanisms and a kind of work (library.py)."""

    #: Measured on the slider-crank (2,000 steps, 1 to 8 variables, 1 to 16 numbers).
    forward_cost: ClassVar[tuple[float, float]] = (2.0, 0.1)
    reverse_cost: ClassVar[tuple[float, float]] = (1.5, 0.12)

    def serves_auto(self) -> bool:
        return compilation_wanted()

    def obstacle(self, dynamics: Dynamics, work: Sequence[str]) -> str | None:
        return obstacle(dynamics, work)

    def stepper(self, dynamics: Dynamics, w: Weights, corrections: tuple[int, int], refresh: int) -> EagerStepper:
        code = library(dynamics, "step")
        if code is None:
            return super().stepper(dynamics, w, corrections, refresh)
        return NativeStepper(code, dynamics, w, corrections, refresh)

    def adjoint_solver(self, grid: Grid) -> AdjointSolver:
        code = library(grid.dynamics, "adjoint")
        return super().adjoint_solver(grid) if code is None else NativeAdjointSolver(code, grid)

    def unknowns(self, dynamics: Dynamics, step: Step) -> tuple[Tensor, Tensor] | None:
        return steps_of_size.unknowns(dynamics, step)

    def accelerations(self, dynamics: Dynamics, q: Any, v: Any) -> Tensor | None:
        return start.accelerations(dynamics, q, v)

    def third_rates(self, dynamics: Dynamics, weights: Weights, x: State, h: Any) -> Tensor | None:
        return start.third_rates(dynamics, weights, x, h)

    def threads(self, dynamics: Dynamics, work: Sequence[str]) -> int:
        if "step" not in work or calls_back(dynamics):
            return 1
        return threads_of(dynamics.lanes)

    def right_hand_side(self, dynamics: Dynamics) -> RightHandSide:
        has_code = not (dynamics.redundant or dynamics.topology.varying_primitives)
        code = library(dynamics, "rates") if has_code else None
        return super().right_hand_side(dynamics) if code is None else NativeRightHandSide(code, dynamics)

    def files(self) -> list[tuple[Path, int, bool]]:
        return build_cache.entries()

    def clear_files(self) -> None:
        build_cache.clear()
