"""Several criteria as one: the weighted sum of eq. (38), with its normalization stated.

sum_i w_i f_i / f_i(initial design)      normalize="initial": no units, sum of the weights at the start (default)
sum_i w_i f_i                            normalize=None: weights carry the units
sum_i w_i f_i / s_i                      normalize=(s_1, s_2, ...)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchmbd.design.response import Measure, all_measures
from torchmbd.errors import InputError
from torchmbd.integrate import Trajectory
from torchmbd.multibody.system import System


@dataclass(frozen=True)
class WeightedSum(Measure):
    """Weighted sum of measures [lanes]; eq. (38).

    terms      (weight, measure) pairs, at least one
    normalize  what each measure is divided by: "initial", its value at the initial design (the sum has no unit then);
               one number for each, in the unit of its measure; None: nothing, weights carry the units
    """

    terms: Sequence[tuple[float, Measure]]
    normalize: str | Sequence[float] | None = "initial"

    def __post_init__(self) -> None:
        if (
            not isinstance(self.terms, Sequence)
            or not self.terms
            or any(not isinstance(term, (tuple, list)) or len(term) != 2 for term in self.terms)
        ):
            raise InputError(f"terms is {self.terms!r}; allowed: pairs (weight, measure), at least one")
        all_measures([measure for _, measure in self.terms], "weighted sum")
        for weight, _ in self.terms:
            if isinstance(weight, (str, bool)) or not abs(float(weight)) < float("inf"):
                raise InputError(f"weight is {weight!r}; allowed: a finite number")
        scales = self.normalize
        if scales is None or scales == "initial":
            return
        if isinstance(scales, str) or len(scales) != len(self.terms) or not all(float(s) != 0.0 for s in scales):
            raise InputError(f"normalize is {scales!r}; allowed: 'initial', None, or a number but 0 for each term")

    def check(self, system: System) -> None:
        for _, measure in self.terms:
            measure.check(system)

    @property
    def until(self) -> float:
        return max(measure.until for _, measure in self.terms)

    @property
    def refers_to_start(self) -> bool:
        return self.normalize == "initial" or any(measure.refers_to_start for _, measure in self.terms)

    def at_start(self, motion: Trajectory) -> Measure:
        terms = [(weight, measure.at_start(motion)) for weight, measure in self.terms]
        if self.normalize != "initial":
            return WeightedSum(terms, self.normalize)
        values = [float(measure.value(motion)[0]) for _, measure in terms]
        for (_, measure), value in zip(terms, values, strict=True):
            if value == 0.0:
                raise InputError(f"{measure!r} is zero at the initial design; allowed: normalize by numbers")
        return WeightedSum(terms, values)

    def value(self, motion: Trajectory) -> Tensor:
        if self.normalize == "initial":
            raise InputError(
                "weighted sum is normalized by the initial design, which a motion alone does not tell; "
                "allowed: in a Problem, or after at_start(motion of the initial design)"
            )
        scales = [1.0] * len(self.terms) if self.normalize is None else [float(s) for s in self.normalize]
        parts = [weight / s * measure.value(motion) for (weight, measure), s in zip(self.terms, scales, strict=True)]
        return torch.stack(parts).sum(0)
