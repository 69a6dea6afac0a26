"""Short names and units of the entries of the design vector, for tables and metrics.

rod.laminate.angles[0], deg  ->  angle_1_deg         rod_angle_1_deg, or all words, if others would have this name
spring.stiffness[0]          ->  stiffness           a parameter that is one number has no others to be distinguished from

The extra variable of a min-max problem or of a worst case, the last of a vector, is not a design and has no column.

Checked in tests/study/report/test_columns.py.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from torchmbd.study.file.schema import UNITS


@dataclass(frozen=True)
class Columns:
    """One column for each design variable; vectors may have the extra variable behind them."""

    labels: tuple[str, ...]  # rod.laminate.angles[0]
    names: tuple[str, ...]  # angle_1_deg
    units: tuple[str, ...]
    factors: np.ndarray  # unit -> SI

    @classmethod
    def of(cls, labels: Sequence[str], units: Mapping[str, str], scalars: Collection[str] = ()) -> Columns:
        """Return the columns of design variables.

        labels   names of the entries, such as those of a problem
        units    parameter -> unit of its numbers; parameters that are missing have none
        scalars  parameters of one number
        """
        owners = [label.rpartition("[")[0] if label.endswith("]") else label for label in labels]
        words = _short_names(list(dict.fromkeys(owners)))
        names = []
        for label, parameter in zip(labels, owners, strict=True):
            number = "" if label == parameter or parameter in scalars else f"_{int(label[len(parameter) + 1 : -1]) + 1}"
            unit = units.get(parameter, "none")
            names.append(f"{words[parameter]}{number}{'' if unit == 'none' else f'_{unit}'}")
        counts = Counter(names)
        for k, name in enumerate(names):
            if counts[name] > 1:  # as of x[0] beside x_1: what is left are the labels, which differ
                names[k] = labels[k].replace("[", ".").removesuffix("]")
                counts.update({name: -1, names[k]: 1})
        unit_names = tuple(units.get(parameter, "none") for parameter in owners)
        return cls(tuple(labels), tuple(names), unit_names, np.array([UNITS[unit] for unit in unit_names]))

    def by_name(self, x: np.ndarray) -> dict[str, float]:
        """Return a design vector [SI] by name, in the units of the study."""
        return dict(zip(self.names, self.in_units(x).tolist(), strict=True))

    def in_units(self, X: np.ndarray) -> np.ndarray:
        """Return design vectors [..., n] in the units of the study, from SI."""
        return np.asarray(X, dtype=float)[..., : len(self.names)] / self.factors

    def si(self, values: np.ndarray) -> np.ndarray:
        """Return a design vector in SI from one in the units of the study."""
        return np.asarray(values, dtype=float) * self.factors

    def sentence(self, x: np.ndarray) -> str:
        """Return a design vector [SI] in one line: `45, -45, 45 deg`, of several units `height 17.7 cm, angle 1 45 deg`.

        Angles to a hundredth, other numbers to four digits.
        """
        indices = range(min(len(x), len(self.names)))
        values = (np.asarray(x, dtype=float)[: len(indices)] / self.factors[: len(indices)]).tolist()
        shown = [round(values[k], 2) if self.units[k] == "deg" else values[k] for k in indices]
        numbers = [f"{float(f'{value:.4g}') + 0.0:g}" for value in shown]
        if len({self.units[k] for k in indices}) > 1:
            words = [self.heading(k).partition(" [")[0] for k in indices]
            units = ["" if self.units[k] == "none" else f" {self.units[k]}" for k in indices]
            return ", ".join(f"{word} {x}{unit}" for word, x, unit in zip(words, numbers, units, strict=True))
        return ", ".join(numbers) + ("" if self.units[0] == "none" else f" {self.units[0]}")

    def named(self, x: np.ndarray) -> str:
        """Return a design vector [SI] in one line with names and units: `angle 1 45 deg, thickness 0.6 mm`."""
        return ", ".join(self._named(k, value) for k, value in enumerate(self.in_units(x).tolist()))

    def _named(self, k: int, value: float) -> str:
        word, _, unit = self.heading(k).partition(" [")
        text = f"{round(value, 2) + 0.0:g}" if self.units[k] == "deg" else f"{value:.6g}"
        return f"{word} {text} {unit.removesuffix(']')}".rstrip()

    @property
    def headings(self) -> list[str]:
        return [self.heading(k) for k in range(len(self.names))]

    def heading(self, index: int) -> str:
        """Return a column's title: `angle 1 [deg]`."""
        unit = self.units[index]
        word = self.names[index].removesuffix(f"_{unit}").replace("_", " ")
        return word if unit == "none" else f"{word} [{unit}]"


def _short_names(parameters: Sequence[str]) -> dict[str, str]:
    """Return the shortest name of each parameter that no other has: its last word, its first and last word, or all words.

    Parameters of one part have names of one form: push_x and push_y, not push_x and y. A last word of one letter, such as
    that of a component, is not a name by itself.
    """
    words = {parameter: parameter.split(".") for parameter in parameters}
    words = {parameter: [*parts[:-1], _singular(parts[-1])] for parameter, parts in words.items()}
    count = Counter(parts[-1] for parts in words.values())
    vague = {tuple(parts[:-1]) for parts in words.values() if count[parts[-1]] > 1 or len(parts[-1]) == 1}
    names = {parameter: [*parts[:-1][: tuple(parts[:-1]) in vague], parts[-1]] for parameter, parts in words.items()}
    count = Counter(map(tuple, names.values()))
    return {
        parameter: "_".join(name if count[tuple(name)] == 1 else words[parameter]) for parameter, name in names.items()
    }


def _singular(word: str) -> str:
    return word[:-1] if word.endswith("s") and not word.endswith(("ss", "us", "is")) else word
