"""What is known of the steps of a motion: `motion.stats` shows it by name.

Checked in tests/integrate/test_statistics.py, tests/integrate/phases/test_retries.py.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

# A motion is accepted when the iteration of every step left less than this share of the largest acceleration.
ITERATION_ERROR = 1e-2
TURN = 1.0  # [rad] of a body in one step
ROUNDING = 1e-10  # of coordinates, with what equations and factors add to it


@dataclass
class Statistics:
    """Of the steps of all lanes; None: the method does not know it.

    steps, step_size     their number, and their size [s]
    evaluations          of the right-hand side
    iteration_error      estimated relative error of the iteration in the accelerations [lanes]
    tangent_error        and in their design tangents
    further_corrections  that one step made at most
    step_error           estimated error of a step;  suggested_steps: the number of steps that would make it 1 %
    turn                 largest rotation of a body in one step [rad]
    alternation          share of accelerations that changes its sign from step to step, with elements of beams
    valid_times          the number of states before the first that did not converge
    halved, renewed      lanes that smaller steps, or more corrections, integrated again
    failed_first         of these, lanes that still fail
    """

    steps: int | None = None
    step_size: float | None = None
    evaluations: int | None = None
    iteration_error: Tensor | None = None
    tangent_error: Tensor | None = None
    further_corrections: Tensor | None = None
    step_error: Tensor | None = None
    suggested_steps: Tensor | None = None
    turn: Tensor | None = None
    alternation: Tensor | None = None
    valid_times: Tensor | None = None
    halved: list[int] | None = None
    renewed: list[int] | None = None
    failed_first: list[int] | None = None

    def numbers(self) -> dict[str, Any]:
        """What is known, by name."""
        return {f.name: x for f in fields(self) if (x := getattr(self, f.name)) is not None}

    def of_lanes(self, index: Tensor) -> Statistics:
        """Those [lanes] of some lanes."""
        some: dict[str, Any] = {name: x[index] for name, x in self.numbers().items() if isinstance(x, Tensor)}
        return Statistics(**some)

    def maximum(self, other: Statistics) -> Statistics:
        """The larger of the numbers [lanes] of both."""
        both, rest = self.numbers(), other.numbers()
        return Statistics(**(rest | {name: x.maximum(rest.get(name, x)) for name, x in both.items()}))

    def replace_lanes(
        self, targets: list[int], other: Statistics, sources: list[int], substeps: int, lanes: int
    ) -> None:
        """Take over the numbers of lanes, out of so many, from another integration, of which so many steps stand for one."""
        for name in OF_LANES:
            new, x = getattr(other, name), getattr(self, name)
            if new is None and x is None:
                continue
            if x is None:  # of a lane that has not come to a check there is none
                x = torch.zeros(lanes, dtype=torch.float64)
                setattr(self, name, x)
            x[targets] = 0.0 if new is None else new[sources]
        if self.valid_times is not None and other.valid_times is not None:
            self.valid_times[targets] = (other.valid_times[sources] + substeps - 1) // substeps

    def limit_valid_times(self, possible: Tensor) -> None:
        """End the valid times of each lane before the first time that is not possible [times, lanes]."""
        before = possible.int().cumprod(0).sum(0)
        if bool((before < len(possible)).any()):
            self.valid_times = before if self.valid_times is None else self.valid_times.minimum(before)

    def note(self, name: str, lanes: Iterable[int]) -> None:
        """Add lanes to one of the lists."""
        setattr(self, name, sorted({*(getattr(self, name) or []), *lanes}))


# Numbers of lanes that those of a better integration replace.
OF_LANES = (
    "iteration_error",
    "tangent_error",
    "further_corrections",
    "step_error",
    "suggested_steps",
    "turn",
    "alternation",
)
