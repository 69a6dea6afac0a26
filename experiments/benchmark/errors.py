"""Estimated over true errors of responses by steps: 12 mechanisms, 5 kinds of responses each.

errors_share       of the estimates that are between half and twice the true error, of those that say they hold
errors_unresolved  how many of all say that they do not hold

The true error is that of eight times the steps, extrapolated with four times. Steps are those of a coarse, but sensible motion.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torchmbd as mbd
from experiments.benchmark.report import Grid, Result, Settings
from experiments.models import chain, delta_robot, flapping_blade, four_bar, spacecraft
from experiments.peers import modal_slider_crank, soft_slider_crank
from torchmbd.examples import slider_crank, two_link_arm

LOW, HIGH = 0.5, 2.0  # an estimate within these times the true error is a good one
SMALL = 1e-9  # of the value: true errors below it are those of Newton's iterations


class Mechanism(NamedTuple):
    """A system, its motion, and what is looked at: a body with strain energy, or None, and a point."""

    build: Callable[[], mbd.System]
    duration: float
    steps: int
    elastic: str | None
    point: mbd.History


def _oscillator() -> mbd.System:
    bob = mbd.RigidBody("bob", 1.0, (1.0, 1.0, 1.0), velocity=(1.0, 0.0, 0.0))
    ground = mbd.Ground()
    spring = mbd.SpringDamper(ground.at(-1.0, 0.0, 0.0), bob.at(), stiffness=(2.0 * math.pi * 5.0) ** 2, rest=1.0)
    return mbd.System([bob], [mbd.Prismatic(ground.at(), bob.at(), axis="x")], [spring])


MECHANISMS: dict[str, Mechanism] = {
    "oscillator": Mechanism(_oscillator, 0.33, 60, None, mbd.Position("bob", "x")),
    "pendulum": Mechanism(mbd.examples.pendulum, 0.5, 40, None, mbd.Position("bob", "x")),
    "arm": Mechanism(mbd.examples.arm, 0.1, 100, "arm", mbd.Position("tool", "z")),
    "slider-crank": Mechanism(
        partial(slider_crank.build, 3, cells=(12, 2), modes=4),
        0.06,
        600,
        "rod",
        mbd.Displacement("rod", "z", node="right"),
    ),
    "soft slider-crank": Mechanism(partial(soft_slider_crank.system, 8), 0.2, 800, None, mbd.Position("slider", "x")),
    "slider-crank in pieces": Mechanism(
        partial(modal_slider_crank.parts, 2), 0.4, 400, "rod_0", mbd.Displacement("rod_0", "y", node="end")
    ),
    "two-link arm": Mechanism(
        partial(two_link_arm.build, cells=(4, 2), modes=2), 0.8, 400, "upper", mbd.Position("fore", "x")
    ),
    "four-bar": Mechanism(
        four_bar.build, 0.15, 400, "coupler", mbd.Displacement("coupler", "z", node="corner_left_top")
    ),
    "chain": Mechanism(partial(chain.build, 3), 0.5, 500, "link1", mbd.Position("link2", "y", node="end")),
    "delta robot": Mechanism(delta_robot.build, 0.25, 400, "rod0l", mbd.Displacement("rod0l", "y", node="start")),
    "flapping blade": Mechanism(flapping_blade.build, 1.25, 400, "blade", mbd.Position("blade", "z", node="end")),
    "spacecraft": Mechanism(spacecraft.build, 4.0, 200, "port", mbd.Displacement("port", "z", node="left")),
}


def errors(settings: Settings) -> Result:
    """See the module header."""
    names = list(MECHANISMS)[:2] if settings.quick else list(MECHANISMS)
    rows, shares, unresolved = [], [], 0
    for name in names:
        by_kind = effectivities(MECHANISMS[name])
        texts = ["not resolved" if x is None else "-" if math.isnan(x) else x for x in by_kind.values()]
        rows.append([name, MECHANISMS[name].steps, *texts])
        shares += [x for x in by_kind.values() if x is not None and not math.isnan(x)]
        unresolved += sum(x is None for x in by_kind.values())
    good = sum(LOW <= x <= HIGH for x in shares) / max(1, len(shares))
    columns = ["mechanism", "steps", *(kind for kind in responses(MECHANISMS[names[0]]))]
    title = f"estimated over true error by steps: {100 * good:.0f} % of {len(shares)} within {LOW:g} to {HIGH:g}"
    figures = {
        "errors_share": None if settings.quick else good,
        "errors_unresolved": None if settings.quick else unresolved,
    }
    return Result(figures, [Grid(title, columns, rows)])


def responses(mechanism: Mechanism) -> dict[str, mbd.Measure]:
    """Five kinds of responses of a mechanism."""
    point, duration = mechanism.point, mechanism.duration
    history = point if mechanism.elastic is None else mbd.StrainEnergy(mechanism.elastic)
    return {
        "integral": mbd.Integral(history),
        "maximum": mbd.Max(history),
        "final": mbd.Final(point),
        "at a time": mbd.AtTime(point, 0.37 * duration),
        "rms": mbd.RMS(point, window=(0.5 * duration, duration)),
    }


def effectivities(mechanism: Mechanism) -> dict[str, float | None]:
    """Estimated over true error by steps of every kind; None: not resolved; nan: the true error is rounding."""
    system = mechanism.build()
    motion, fine, finer = (
        mbd.simulate(system, mechanism.duration, steps=k * mechanism.steps, gradients="none") for k in (1, 4, 8)
    )
    effectivity: dict[str, float | None] = {}
    for kind, response in responses(mechanism).items():
        error = motion.error_of(response, modes=False, mesh=False)
        values = [response(x).item() for x in (fine, finer)]
        true = values[1] + (values[1] - values[0]) / 3.0 - error.value.item()
        known = abs(true) > SMALL * abs(error.value.item())
        effectivity[kind] = None if not error.resolved.all() else error.by_steps.item() / true if known else math.nan
    return effectivity
