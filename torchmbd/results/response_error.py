"""The estimated errors of a response of a motion; diagnosis/response_error.py computes them.

Checked in tests/diagnosis/test_response_errors.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class ResponseError:
    """The errors of a response, each the estimated true value minus the value, in the unit of the response.

    name      of the response
    value     of the motion [lanes] or [lanes, rows]
    size      what its errors are compared with, without constant parts (`Measure.size`), of the same shape
    change    by how much it follows from the motion (`Measure.change`), of the same shape
    by_steps  error by the steps, of the same shape
    resolved  whether the estimate by steps holds [lanes]: the error falls with the steps as the method promises
    reasons   why a lane is not resolved, "" where it is
    note      what the estimates are worth for this kind of response, "" where there is nothing to say
    by_modes  error by the modes of flexible bodies; zeros where bodies have none that could be more; None: not estimated
    by_mesh   error by the meshes of flexible bodies; None: not estimated
    unknown   why an error is None or lacks a part: "by_modes: ..."

    >>> motion = mbd.simulate(mbd.examples.pendulum(), 0.5, steps=50)
    >>> error = motion.error_of(mbd.Final(mbd.Angle("bob", "z")))
    >>> error.resolved.tolist(), bool(error.by_steps.abs() < 1e-3)  # [rad]
    ([True], True)
    """

    name: str
    value: Tensor
    size: Tensor
    change: Tensor
    by_steps: Tensor
    resolved: Tensor
    reasons: tuple[str, ...]
    note: str = ""
    by_modes: Tensor | None = None
    by_mesh: Tensor | None = None
    unknown: tuple[str, ...] = ()

    @property
    def parts(self) -> dict[str, Tensor]:
        """The errors that are estimated, by "steps", "modes", "mesh"."""
        errors = {"steps": self.by_steps, "modes": self.by_modes, "mesh": self.by_mesh}
        return {name: x for name, x in errors.items() if x is not None}

    @property
    def error(self) -> Tensor:
        """Size of all errors that are estimated, positive: the sum of their sizes, of the shape of `value`."""
        return torch.stack([x.abs() for x in self.parts.values()]).sum(0)

    def __str__(self) -> str:
        """A line for each lane."""
        lines = []
        for lane, reason in enumerate(self.reasons):
            errors = {name: x[lane].reshape(-1).tolist() for name, x in self.parts.items()}
            pairs = []
            for row, value in enumerate(self.value[lane].reshape(-1).tolist()):
                texts = [f"by {name} {x[row]:+.2g}" for name, x in errors.items()]
                pairs.append(f"{value:.6g} (error {', '.join(texts)})")
            lines.append(f"{self.name}: {', '.join(pairs)}" + (f", not resolved: {reason}" if reason else ""))
        return "\n".join([*lines, *(f"({text})" for text in (self.note, *self.unknown) if text)])


def rows_of(x: Tensor) -> Tensor:
    """Numbers [lanes, ...] as [lanes, rows]."""
    return x.reshape(len(x), -1)
