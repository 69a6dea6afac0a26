"""Several criteria as one measure: the weighted sum of eq. (38), with a choice of normalization.

sum_i w_i f_i / |f_i(initial design)|    normalize="initial": no units; of positive f_i the sum of the weights (default)
sum_i w_i f_i                            normalize=None: weights carry the units
sum_i w_i f_i / s_i                      normalize=(s_1, s_2, ...), positive

Divisors are positive, so that a term of positive weight is minimized whatever the sign of its measure.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor

from torchmbd.design.response import Measure, Total
from torchmbd.errors import InputError
from torchmbd.integrate import Trajectory


@dataclass(frozen=True)
class WeightedSum(Total):
    """Weighted sum of measures [lanes]; eq. (38).

    terms      (weight, measure) pairs, at least one
    normalize  "initial": each measure is divided by the size of its value at the initial design, and the sum does not have a
               unit; or one positive divisor for each measure, in its unit; None: measures are not divided, and the weights
               have units

    >>> motion = mbd.simulate(mbd.examples.arm(), 0.01, steps=4)
    >>> both = mbd.WeightedSum([(0.5, mbd.Mass("arm")), (0.5, mbd.Mass("tool"))], normalize=None)
    >>> round(both(motion).item(), 4)  # (0.0793 + 0.2) / 2
    0.1396
    """

    normalize: str | Sequence[float] | None = "initial"

    def __post_init__(self) -> None:
        if (
            not isinstance(self.terms, Sequence)
            or not self.terms
            or any(not isinstance(term, (tuple, list)) or len(term) != 2 for term in self.terms)
        ):
            raise InputError("terms", self.terms, "pairs (weight, measure), at least one")
        super().__post_init__()
        scales = self.normalize
        if scales is None or scales == "initial":
            return
        if isinstance(scales, str) or len(scales) != len(self.terms) or not all(float(s) > 0.0 for s in scales):
            raise InputError("normalize", scales, "'initial', None, or a positive number for each term")

    @property
    def refers_to_start(self) -> bool:
        return self.normalize == "initial" or super().refers_to_start

    def mapped(self, change: Callable[[Measure], Measure]) -> Measure:
        return WeightedSum([(weight, change(measure)) for weight, measure in self.terms], self.normalize)

    def at_start(self, motion: Trajectory) -> Measure:
        measures = [measure.at_start(motion) for _, measure in self.terms]
        scales = self.normalize
        if scales == "initial":
            scales = [abs(float(measure.value(motion)[0])) for measure in measures]
            for measure, scale in zip(measures, scales, strict=True):
                if scale == 0.0:
                    raise InputError(
                        "normalize",
                        "initial",
                        "a positive number for each term",
                        state=f"is 'initial', but {measure!r} is zero at the initial design",
                    )
        return WeightedSum([(w, m) for (w, _), m in zip(self.terms, measures, strict=True)], scales)

    def value(self, motion: Trajectory) -> Tensor:
        return Total(self._scaled).value(motion)

    def change(self, motion: Trajectory) -> Tensor:
        return Total(self._scaled).change(motion)

    @property
    def _scaled(self) -> Sequence[tuple[float, Measure]]:
        """The terms with their weights over what normalizes them."""
        if self.normalize is None:
            return self.terms
        if self.normalize == "initial":
            raise InputError(
                "normalize",
                "initial",
                "used in a Problem, or after at_start(motion of the initial design)",
                state="is 'initial', but this measure does not know the initial design",
            )
        return [(w / float(s), m) for (w, m), s in zip(self.terms, self.normalize, strict=True)]
