"""Many rows with one limit as one smooth number, whose gradient costs one reverse pass.

    ks       c/rho ln sum exp(rho y_k / c)     above the largest row by at most c ln(rows) / rho
    p_norm   (sum max(y_k, 0)^p)^(1/p)         above the largest row by at most the factor rows^(1/p)

Both are not below the largest row: if the aggregate is below a limit, all rows are below it, with a margin that makes the
optimum somewhat worse. An aggregate of large sharpness has a small one, but is badly conditioned: sharpening.py.

Source: Kreisselmeier and Steinhauser, IFAC Symp. Computer Aided Design of Control Systems (1979) 113-117; Poon and Martins,
Structural and Multidisciplinary Optimization 34 (2007) 61-73, whose constants adapt as well.
Checked in tests/design/test_aggregate.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchmbd.design.response import Measure, check_scale
from torchmbd.errors import DesignFailure, InputError, unknown
from torchmbd.integrate import Trajectory
from torchmbd.math.checked_numbers import list_of, scalar
from torchmbd.math.gradients import untransformed

KINDS = ("ks", "p_norm")


@dataclass(frozen=True)
class Aggregate(Measure):
    """One smooth number [lanes] for all rows of measures, in their unit, not below the largest row.

    measures   a measure, as AtTimes with many rows, or several in one unit
    kind       "ks" (Kreisselmeier-Steinhauser), or "p_norm", which requires that the largest row is positive
    sharpness  rho or p, positive: the larger, the nearer to the largest row, and the less smooth [-]
    scale      c of "ks", positive: the size of the rows, in their unit; None for "p_norm", which does not use it

    `largest(motion)` is the largest row itself.
    Source: Kreisselmeier and Steinhauser (1979).

    >>> motion = mbd.simulate(mbd.examples.arm(), 0.1, steps=40)
    >>> limits = [mbd.Max(mbd.Displacement("arm", axis, node="right")) for axis in ("y", "z")]
    >>> aggregate = mbd.Aggregate(limits, scale=1e-3)
    >>> bool(aggregate(motion) >= aggregate.largest(motion))
    True
    """

    measures: Measure | Sequence[Measure]
    kind: str = "ks"
    sharpness: float = 50.0
    scale: float | None = None

    def __post_init__(self) -> None:
        if isinstance(self.measures, Measure):
            object.__setattr__(self, "measures", [self.measures])
        if not list_of("measures", self.measures, Measure, "a measure, or a list of them"):
            raise InputError("measures", allowed="a measure, or at least one in a list", state="is []")
        if not isinstance(self.kind, str) or self.kind not in KINDS:
            raise unknown("kind", self.kind, KINDS)
        if scalar("sharpness", self.sharpness, "a positive number") <= 0.0:
            raise InputError("sharpness", self.sharpness, "a positive number")
        if self.kind == "p_norm" and self.scale is not None:
            raise InputError("scale", self.scale, "None", state=f"is {self.scale!r} but kind 'p_norm' does not use it")
        if self.kind == "ks":
            check_scale(self.scale)

    @property
    def operands(self) -> Sequence[Measure]:
        assert not isinstance(self.measures, Measure)  # a list since __post_init__
        return self.measures

    def mapped(self, change: Callable[[Measure], Measure]) -> Measure:
        return replace(self, measures=[change(measure) for measure in self.operands])

    def _rows(self, motion: Trajectory) -> Tensor:
        """All rows [lanes, rows]."""
        return torch.cat([m.value(motion).reshape(motion.lanes, -1) for m in self.operands], 1)

    def value(self, motion: Trajectory) -> Tensor:
        rows, rho = self._rows(motion), float(self.sharpness)
        if self.scale is not None:  # kind "ks"
            return torch.logsumexp(rho / self.scale * rows, 1) * (self.scale / rho)
        for lane in torch.nonzero(untransformed(rows).amax(1) <= 0.0)[:, 0].tolist():
            raise DesignFailure(
                "kind",
                self.kind,
                "must have at least one positive row",
                noun="Aggregate(kind='p_norm')",
                state=f"has rows of design {lane + 1} that are all zero or negative",
                hint="kind='ks' with scale=..., which also takes negative rows",
            )
        # Logarithms avoid overflow of powers.
        return torch.exp(torch.logsumexp(rho * rows.clamp_min(torch.finfo(rows.dtype).tiny).log(), 1) / rho)

    def change(self, motion: Trajectory) -> Tensor:
        return torch.cat([m.size(motion).reshape(motion.lanes, -1) for m in self.operands], 1).amax(1)

    def largest(self, motion: Trajectory) -> Tensor:
        """The largest row [lanes]."""
        return motion.sound(self._rows(motion).amax(1))
