"""The design vector as people read it: short names, values in the unit of the file.

rod.laminate.angles[0], deg  ->  angle_1_deg         (rod_angle_1_deg where two parameters would share the name)
spring.stiffness[0]          ->  stiffness           a parameter that is one number has no others to be told from
bound                        ->  bound               the extra variable of a min-max problem, the last

Checked in tests/study/test_columns.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from torchmbd.design.problem import BOUND
from torchmbd.multibody.system import System
from torchmbd.study.schema import UNITS, Variable


@dataclass(frozen=True)
class Columns:
    """One column for each entry of the design vector."""

    labels: tuple[str, ...]  # rod.laminate.angles[0]
    names: tuple[str, ...]  # angle_1_deg
    units: tuple[str, ...]
    factors: np.ndarray  # unit -> SI

    @classmethod
    def of(cls, design: Mapping[str, Variable], system: System, rows: int = 1) -> Columns:
        """Columns of a design; `rows` of the objective: several make a min-max problem."""
        own = dict(system.named_parameters())
        words = [name.rpartition(".")[2] for name in design]
        labels, names, units = [], [], []
        for parameter, variable in design.items():
            word = _singular(parameter.rpartition(".")[2])
            if words.count(parameter.rpartition(".")[2]) > 1:
                word = f"{parameter.partition('.')[0]}_{word}"
            suffix = "" if variable.unit == "none" else f"_{variable.unit}"
            for i in range(own[parameter].numel()):
                labels.append(f"{parameter}[{i}]")
                number = f"_{i + 1}" if own[parameter].ndim else ""
                names.append(f"{word}{number}{suffix}")
                units.append(variable.unit)
        if rows > 1:
            labels, names, units = [*labels, BOUND], [*names, BOUND], [*units, "none"]
        return cls(tuple(labels), tuple(names), tuple(units), np.array([UNITS[unit] for unit in units]))

    def shown(self, x: np.ndarray) -> dict[str, float]:
        """Return a design vector [SI] by name, in the units of the file."""
        return dict(zip(self.names, (np.asarray(x, dtype=float) / self.factors).tolist(), strict=True))

    def si(self, values: np.ndarray) -> np.ndarray:
        """Return a design vector in SI from one in the units of the file."""
        return np.asarray(values, dtype=float) * self.factors

    def sentence(self, x: np.ndarray) -> str:
        """Return a design vector [SI] in one line: `45, -45, 45 deg`; angles to a hundredth."""
        own = {name: unit for name, unit in zip(self.names, self.units, strict=True) if name != BOUND}
        shown = {name: round(x, 2) if own.get(name) == "deg" else x for name, x in self.shown(x).items()}
        values = ", ".join(f"{float(f'{shown[name]:.4g}') + 0.0:g}" for name in own)
        return f"{values} {self.units[0]}" if len(set(own.values())) == 1 and self.units[0] != "none" else values

    @property
    def headings(self) -> list[str]:
        return [self.heading(k) for k in range(len(self.names))]

    def heading(self, index: int) -> str:
        """Return a column's title: `angle 1 [deg]`."""
        unit = self.units[index]
        word = self.names[index].removesuffix(f"_{unit}").replace("_", " ")
        return word if unit == "none" else f"{word} [{unit}]"


def _singular(word: str) -> str:
    return word[:-1] if word.endswith("s") and not word.endswith("ss") else word
