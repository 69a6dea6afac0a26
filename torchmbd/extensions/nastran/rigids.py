"""Cards that tie degrees of freedom to others: RBE2, RBE3, RBAR, RBAR1 and MPC.

    RBE2   the components CM of grids follow another grid as one rigid body      RBAR, RBAR1   the same of two grids
    RBE3   the components REFC of a grid are the weighted mean motion of others
    MPC    A1 u1 + A2 u2 + ... = 0 of single components: the first one follows

A grid that leads may follow by another card; circles are refused. Components are along the axes of the system CD of their grid.
Source: MSC Nastran Quick Reference Guide, section 8. Checked in tests/extensions/nastran/test_rigids.py.
"""

from __future__ import annotations

import graphlib
import re
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from torchmbd.errors import InputError, warn, wrong_entry
from torchmbd.extensions.nastran.card import Card
from torchmbd.extensions.nastran.elements import rbar_grids
from torchmbd.fem.elements import Average, Combination, Follower, RigidLink

RIGIDS = ("RBE2", "RBE3", "RBAR", "RBAR1")
ALL = "123456"
#: Rows: axes of the system CD of a grid, in the basic system.
Axes = Callable[[int], np.ndarray]


@dataclass(frozen=True)
class Rigid:
    """RBE2, RBAR, RBAR1: grid leads components of the others; RBE3: those of grid are the weighted mean of the others."""

    card: Card
    grid: int
    others: tuple[int, ...]
    weights: tuple[float, ...] = ()
    components: str = ALL

    @property
    def grids(self) -> tuple[int, ...]:
        return (self.grid, *self.others)


class Term(NamedTuple):
    """Component 1 to 6 of a grid, with its factor in an MPC."""

    grid: int
    component: int
    factor: float


@dataclass(frozen=True)
class MultipointConstraint:
    """A card MPC; the first term follows."""

    card: Card
    terms: tuple[Term, ...]

    @property
    def grids(self) -> tuple[int, ...]:
        return tuple(dict.fromkeys(term.grid for term in self.terms))


def read_rigid(card: Card, grids: Collection[int]) -> Rigid:
    """Read an RBE2, RBE3, RBAR or RBAR1."""
    if card.name == "RBAR":
        leader, follower = rbar_grids(card)
        made = Rigid(card, leader, (follower,))
    elif card.name == "RBAR1":
        chosen = _components(card, 4, "CB") if card.text(4) else ALL
        made = Rigid(card, card.integer(2, "GA"), (card.integer(3, "GB"),), components=chosen)
    else:
        made = _rbe2(card, grids) if card.name == "RBE2" else _rbe3(card)
    if made.grid in made.others:
        raise wrong_entry(card, f"GRID {made.grid} follows itself", "must follow other grids", key="G")
    return made


def read_constraint(card: Card) -> MultipointConstraint:
    """Read an MPC: two terms to a line of eight fields, the first field of the other lines is blank."""
    terms: list[Term] = []
    for line in range(0, max(len(card.fields), 1), 8):
        for k, start in enumerate((line + 2, line + 5)):
            number = line // 4 + k + 1
            if not any(card.text(start + i) for i in range(3)):
                continue
            component = card.integer(start + 1, f"C{number}", 0)
            if not 1 <= component <= 6:
                raise wrong_entry(card, f"C{number} = {card.text(start + 1)!r}", "1 to 6", key="C")
            terms.append(Term(card.integer(start, f"G{number}"), component, card.real(start + 2, f"A{number}")))
    if len(terms) < 2:
        raise wrong_entry(card, f"it has {len(terms)} terms", "must have at least two, G1 C1 A1 G2 C2 A2", key="G")
    first, others = terms[0], terms[1:]
    if first.factor == 0.0:
        raise InputError(
            (str(card), "A1"),
            card.text(4),
            "a number other than 0, because the first term depends on the others",
            noun=f"{card}: A1",
            shown=f"{card.text(4)}",
        )
    if any(term[:2] == first[:2] for term in others):
        raise wrong_entry(
            card, f"component {first.component} of GRID {first.grid} appears twice", "must follow once", key="C"
        )
    return MultipointConstraint(card, tuple(terms))


def _rbe2(card: Card, grids: Collection[int]) -> Rigid:
    components = _components(card, 3, "CM")
    words = [word for word in card.fields[3:] if word and not re.search(r"[.]", word)]
    followers = Card(card.name, (*card.fields[:1], "", "", *words), card.where).integers(4, grids)
    if not followers:
        raise wrong_entry(card, "no grid follows", "must have at least one", key="GM")
    return Rigid(card, card.integer(2, "GN"), tuple(followers), (), components)


def _rbe3(card: Card) -> Rigid:
    grids: list[int] = []
    weights: list[float] = []
    weight, components, turning = 1.0, False, ""
    for position, word in enumerate(card.fields[4:], start=5):
        if word.upper() in ("UM", "ALPHA"):
            break
        if not word:
            continue
        if "." in word:
            weight, components = card.real(position, "WT"), True
        elif components:
            if not {"1", "2", "3"} <= set(word):
                raise InputError(
                    (str(card), "C"), word, "123, the displacements of the averaged grids", noun=f"{card}: C"
                )
            if set(word) & {"4", "5", "6"} and not turning:
                turning = word
            components = False
        else:
            grids.append(card.integer(position, "G"))
            weights.append(weight)
    if not grids:
        raise wrong_entry(card, "no grids to average", "must have at least three that span a plane", key="G")
    if turning:
        warn(f"{card}: C is {turning!r}; torchmbd averages the displacements of these grids, not their rotations")
    return Rigid(card, card.integer(3, "REFGRID"), tuple(grids), tuple(weights), _components(card, 4, "REFC"))


def _components(card: Card, position: int, name: str) -> str:
    """A field of components, such as 123: digits 1 to 6, each once."""
    text = card.text(position)
    if not text or not set(text) <= set(ALL) or len(set(text)) < len(text):
        raise InputError((str(card), name), text, "components 1 to 6, each once, such as 123", noun=f"{card}: {name}")
    return "".join(sorted(text))


def followers(
    rigids: list[Rigid], constraints: list[MultipointConstraint], index: dict[int, int], axes: Axes, length: float
) -> list[Follower]:
    """Links of a body; `length`: meters per unit of the file. InputError names the cards that contradict each other."""
    links: list[tuple[Card, Follower]] = []
    for rigid in rigids:
        if rigid.weights:
            chosen = _basic_freedoms(rigid.card, rigid.grid, rigid.components, axes)
            others = tuple(index[grid] for grid in rigid.others)
            links.append((rigid.card, Average(index[rigid.grid], others, rigid.weights, chosen)))
            continue
        for grid in rigid.others:
            chosen = _basic_freedoms(rigid.card, grid, rigid.components, axes)
            links.append((rigid.card, RigidLink(index[grid], index[rigid.grid], chosen)))
    links += [(x.card, _combination(x, index, axes, length)) for x in constraints]
    _check_links(links, {node: grid for grid, node in index.items()})
    return [link for _, link in links]


def _combination(constraint: MultipointConstraint, index: dict[int, int], axes: Axes, length: float) -> Combination:
    """u1 = -(A2 u2 + ...) / A1 in meters, along the basic axes."""
    first = constraint.terms[0]
    (led,) = _basic_freedoms(constraint.card, first.grid, str(first.component), axes)
    unit = _direction(first.component, axes(first.grid))[led]  # 1 or -1
    size = unit * first.factor * _per_meter(first.component, length)
    terms: dict[tuple[int, int], float] = {}
    for grid, component, factor in constraint.terms[1:]:
        for i, e in enumerate(_direction(component, axes(grid))):
            if e != 0.0 and factor != 0.0:
                key = index[grid], i
                terms[key] = terms.get(key, 0.0) - e * factor * _per_meter(component, length) / size
    return Combination(index[first.grid], led, tuple((*key, factor) for key, factor in terms.items()))


def _per_meter(component: int, length: float) -> float:
    return 1.0 / length if component <= 3 else 1.0


def _direction(component: int, axes: np.ndarray) -> np.ndarray:
    """Return a component along `axes` as a combination of the six degrees of freedom of the basic system."""
    e = np.zeros(6)
    e[3 * ((component - 1) // 3) :][:3] = axes[(component - 1) % 3]
    e[np.abs(e) < 1e-12] = 0.0
    return e


def _basic_freedoms(card: Card, grid: int, components: str, axes: Axes) -> tuple[int, ...]:
    """Return the degrees of freedom 0 to 5 along the basic axes of components of a grid in its system CD."""
    system, chosen = axes(grid), []
    for triad in ("123", "456"):
        numbers = [int(word) for word in triad if word in components]
        directions = [_direction(component, system) for component in numbers]
        if len(numbers) < 3 and any(np.count_nonzero(e) != 1 for e in directions):
            raise wrong_entry(
                card,
                f"components {components} of GRID {grid} are in a system CD that is turned",
                "123 or 456 together, or axes along the basic ones",
                key="CM",
            )
        if len(numbers) == 3:
            chosen += [numbers[0] - 1 + k for k in range(3)]
        else:
            chosen += [int(e.nonzero()[0][0]) for e in directions]
    return tuple(sorted(chosen))


def _check_links(links: list[tuple[Card, Follower]], grids: dict[int, int]) -> None:
    led: dict[tuple[int, int], Card] = {}
    for card, link in links:
        for i in link.components:
            if (link.node, i) in led:
                raise wrong_entry(
                    card,
                    f"GRID {grids[link.node]} follows already by {led[link.node, i]}, in component {i + 1}",
                    "must have one card for each degree of freedom",
                    key="G",
                )
            led[link.node, i] = card
    order = graphlib.TopologicalSorter[tuple[int, int]]()
    for _, link in links:
        for i in link.components:
            order.add((link.node, i), *(source for source in _sources(link) if source in led))
    try:
        order.prepare()
    except graphlib.CycleError as error:
        cards = dict.fromkeys(str(led[freedom]) for freedom in error.args[1])
        raise wrong_entry(
            ", ".join(cards),
            "their dependent grids form a closed chain",
            "must form chains that end at an independent grid",
            key="G",
        ) from None


def _sources(link: Follower) -> set[tuple[int, int]]:
    """Return the degrees of freedom that lead, as (node, component)."""
    if isinstance(link, Combination):
        return {(node, i) for node, i, _ in link.terms}
    if isinstance(link, Average):
        return {(node, i) for node in link.nodes for i in range(3)}
    turned = (3, 4, 5) if min(link.components) < 3 else ()
    return {(link.leader, i) for i in (*link.components, *turned)}
