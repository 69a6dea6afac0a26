"""Coordinate systems of a Nastran model: where grids lie in basic coordinates, and the axes of a system.

CORD2R, CORD2C, CORD2S (three points A, B, C: origin, z axis, x-z plane) and CORD1R, CORD1C, CORD1S (the same by grids), in
any order of reference. Displacements in another system than the basic one (CD) count for springs (springs.py) only: supports
hold all six degrees of freedom, or are only named.
Checked in tests/extensions/nastran/test_data.py.
"""

from __future__ import annotations

import math

import numpy as np

from torchmbd.errors import InputError, wrong_entry
from torchmbd.extensions.nastran.card import Card

NESTED = 100  # systems that refer to one another in a chain
KINDS = ("CORD1R", "CORD1C", "CORD1S", "CORD2R", "CORD2C", "CORD2S")


class Systems:
    """The systems by number; 0 is the basic one. `axes` rows are the unit vectors x, y, z in basic coordinates."""

    def __init__(self, cards: list[Card] | None = None, grids: list[Card] | None = None) -> None:
        self._cards: dict[int, Card] = {}
        self._grids = {grid.integer(1, "ID"): grid for grid in grids or []}
        self._systems: dict[int, tuple[np.ndarray, np.ndarray, str]] = {0: (np.zeros(3), np.eye(3), "R")}
        for card in cards or []:
            by_grids = card.name.startswith("CORD1")
            for start in range(0, max(len(card.fields), 1), 4 if by_grids else 8):  # CORD1R holds up to two systems
                if by_grids or start == 0:
                    part = Card(card.name, card.fields[start:] if start else card.fields, card.where)
                    self._add(part, part.integer(1, "CID"))

    def _add(self, card: Card, number: int) -> None:
        if number < 1:
            raise InputError(
                (str(card), "CID"),
                number,
                "a positive number, because 0 is the basic system",
                noun=f"{card}: CID",
                shown=f"{number}",
            )
        if number in self._cards:
            raise wrong_entry(card, f"the number {number} is taken by {self._cards[number]}", key="CID")
        self._cards[number] = card

    def axes(self, number: int, card: Card, at: np.ndarray) -> np.ndarray:
        """Return the unit vectors of a system, rows [3, 3], at a basic position; x of a curved one is along its radius."""
        origin, axes, kind = self._system(number, card, ())
        if kind == "R":
            return axes
        x, y, z = axes @ (at - origin)
        r = math.hypot(x, y)
        if r == 0.0:
            raise wrong_entry(
                card, f"it lies on the axis of system {number}", "must lie at a place with a radius", key="CID"
            )
        if kind == "C":
            return np.array([[x, y, 0.0], [-y, x, 0.0], [0.0, 0.0, r]]) / r @ axes
        R = math.hypot(r, z)
        out, down = np.array([x, y, z]) / R, np.array([x * z / r, y * z / r, -r]) / R
        return np.stack([out, down, np.array([-y, x, 0.0]) / r]) @ axes

    def curved(self, number: int, card: Card) -> bool:
        """True if a system is cylindrical or spherical."""
        return self._system(number, card, ())[2] != "R"

    def position(self, grid: Card, opened: tuple[int, ...] = ()) -> tuple[float, float, float]:
        """Position of a GRID in basic coordinates."""
        x = np.array([grid.real(k, f"X{k - 2}", 0.0) for k in (3, 4, 5)])
        point = self._basic(grid.integer(2, "CP", 0), x, grid, opened)
        return float(point[0]), float(point[1]), float(point[2])

    def _basic(self, number: int, x: np.ndarray, card: Card, opened: tuple[int, ...]) -> np.ndarray:
        origin, axes, kind = self._system(number, card, opened)
        if kind == "C":
            angle = math.radians(x[1])
            x = np.array([x[0] * math.cos(angle), x[0] * math.sin(angle), x[2]])
        elif kind == "S":
            down, angle = math.radians(x[1]), math.radians(x[2])
            r = x[0] * math.sin(down)
            x = np.array([r * math.cos(angle), r * math.sin(angle), x[0] * math.cos(down)])
        return origin + x @ axes

    def _system(self, number: int, card: Card, opened: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, str]:
        if number in self._systems:
            return self._systems[number]
        if number not in self._cards:
            raise wrong_entry(card, f"coordinate system {number} does not exist", hint="a CORD2R card", key="CID")
        if number in opened:
            raise wrong_entry(card, f"coordinate system {number} refers to itself", key="RID")
        if len(opened) > NESTED:
            raise wrong_entry(
                card, f"systems refer to one another in a chain of more than {NESTED}", f"at most {NESTED}", key="RID"
            )
        definition = self._cards[number]
        origin, up, side = self._points(definition, (*opened, number))
        z, x = up - origin, side - origin
        normal = np.cross(z, x)
        if np.linalg.norm(normal) <= 1e-9 * np.linalg.norm(z) * np.linalg.norm(x):
            raise wrong_entry(definition, "its three points lie on a line", key="A")
        z, y = z / np.linalg.norm(z), normal / np.linalg.norm(normal)
        self._systems[number] = origin, np.stack([np.cross(y, z), y, z]), definition.name[-1]
        return self._systems[number]

    def _points(self, card: Card, opened: tuple[int, ...]) -> list[np.ndarray]:
        if card.name.startswith("CORD1"):
            numbers = [card.integer(k, f"G{k - 1}") for k in (2, 3, 4)]
            for k in numbers:
                if k not in self._grids:
                    raise wrong_entry(card, f"GRID {k} does not exist", key="G")
            return [np.array(self.position(self._grids[k], opened)) for k in numbers]
        reference = card.integer(2, "RID", 0)
        names = [f"{letter}{k}" for letter in "ABC" for k in (1, 2, 3)]
        x = np.array([card.real(3 + k, name, 0.0) for k, name in enumerate(names)]).reshape(3, 3)
        return [self._basic(reference, point, card, opened) for point in x]
