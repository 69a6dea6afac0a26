"""Fatigue over a hundred load cases: the gradient by a hundred variables beside the values, as one batch.

A laminated arm with steered fibers (25 x 2 controls of two plies: 100 angles) swings under a hundred payloads; the objective is
the mean damage of its plies (rainflow, power laws through their strengths) over all of them. Beside it the peer's forward
differences: the slider-crank with 30 ply angles in 20 cases, 31 simulations of each.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

import torchmbd as mbd
from experiments.benchmark.cases import Case, compilation, interleaved
from experiments.benchmark.motion import Row, measured
from experiments.benchmark.report import Grid, Result, Settings
from experiments.peers import exudyn_peer
from torchmbd.examples import slider_crank
from torchmbd.extensions.native.codegen.compiler import unavailable

DURATION, STEPS = 0.4, 200
DAMAGE = mbd.fatigue.FatigueDamage("arm", exponent={"11": 14.0, "22": 10.0, "12": 10.0}, repeats=1e6)


def arm(controls: tuple[int, int], cells: tuple[int, int]) -> mbd.System:
    """A steered arm that swings with a tool whose mass is a parameter."""
    plate = mbd.mesh.rectangle(length=0.5, width=0.05, cells=cells)
    field = mbd.fibers.FiberField(plate, controls, degree=1)
    turn = 0.1 * torch.rand(field.controls, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    laminate = mbd.fibers.SteeredLaminate(
        mbd.examples.carbon(), turn + torch.tensor(mbd.deg([20.0, -20.0])), 1e-3, field
    )
    upright = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    body = mbd.FlexibleBody.plate(
        "arm", plate, laminate, modes=4, position=(0.25, 0, 0), axes=upright, reference="left_edge"
    )
    tool = mbd.RigidBody("tool", mbd.variable(0.2), (1e-4, 1e-4, 1e-4), position=(0.5, 0, 0))
    hinge = mbd.Revolute(mbd.Ground().at(0, 0, 0), body.at("left"), axis="z", name="hinge")
    grip = mbd.Fixed(body.at("right"), tool.at(0, 0, 0), name="grip")
    return mbd.System([body, tool], [hinge, grip], gravity=(0, -9.81, 0))


def problem(cases: int, controls: tuple[int, int], cells: tuple[int, int], steps: int) -> mbd.Scenarios:
    """Mean damage over payloads from 0.1 to 0.4 kg."""
    payloads = {f"{mass:.3f} kg": {"tool.mass": float(mass)} for mass in np.linspace(0.1, 0.4, cases)}
    return mbd.Scenarios(
        arm(controls, cells),
        DURATION * steps / STEPS,
        DAMAGE,
        scenarios=payloads,
        objective="mean",
        variables=["arm.laminate.angles"],
        steps=steps,
    )


def load_cases(settings: Settings) -> Result:
    """load_cases: the gradient over the simulations alone; load_cases_error: of its slopes, the worst case;
    load_cases_peer: the peer's differences by 30 variables over 20 cases, over a gradient of ours."""
    figures: dict[str, Any] = dict.fromkeys(("load_cases", "load_cases_error", "load_cases_peer"))
    if unavailable() is not None:
        return Result(figures)
    with compilation(not settings.quick):
        scenarios = problem(4, (3, 2), (4, 2), 20) if settings.quick else problem(100, (25, 2), (24, 2), STEPS)
        x = scenarios.start[None]
        motion = scenarios.motions(x[0])  # built before the clock starts
        ways = {
            "simulations": lambda: scenarios.motions(x[0]),
            "values": lambda: scenarios.evaluate(x, False),
            "gradient": lambda: scenarios.evaluate(x, True),
        }
        seconds = interleaved(ways, settings.repeat)
        error = _error(scenarios, x[0])
    ratio = seconds["gradient"] / seconds["simulations"]
    rows = [[motion.lanes, x.shape[1], *(1e3 * seconds[name] for name in ways), ratio, error]]
    columns = ["cases", "variables", "simulations ms", "with damage ms", "gradient ms", "in simulations", "error"]
    table = Grid("damage over load cases", columns, rows)
    if settings.quick:
        return Result(figures, [table])
    angles = {"rod.laminate.angles": 0.1}
    rod = Case(
        "slider-crank, 30 angles",
        slider_crank.build(30, joint="spherical"),
        slider_crank.DURATION,
        angles,
        exudyn_peer.slider_crank,
    )
    peer = measured(rod, (Row("load_cases_peer", 20),), settings)
    return Result({"load_cases": ratio, "load_cases_error": error, **peer.figures}, [table, *peer.tables])


def _error(scenarios: mbd.Scenarios, x: np.ndarray) -> float:
    """Largest relative error of a slope by Richardson's differences, of the cases that have one.

    In the others the ranking of cycles or the worst point changes between the designs: differences of two widths disagree.
    All variables add to the slope along the direction, of random components with the signs of the gradient: where they cancel,
    rounding of the modes is 1e-6 of the differences.
    """
    [name], cases = scenarios.space.variables, list(scenarios.scenarios.values())
    designs = {key: torch.stack([case[key] for case in cases]) for key in cases[0]}
    angles = scenarios.space.designs(x[None])[name].repeat(len(cases), 1, 1).requires_grad_()
    motion = mbd.simulate(
        scenarios.system, scenarios.duration, designs={**designs, name: angles}, steps=scenarios.steps, variables=[name]
    )
    gradient = DAMAGE.value_and_gradient(motion).gradient
    assert gradient is not None
    G = gradient.numpy()
    along = np.abs(np.random.default_rng(5).normal(size=len(x))) * np.sign(G.mean(0))
    exact = G @ along
    one, two = (
        (DAMAGE(scenarios.motions(x + h * along)) - DAMAGE(scenarios.motions(x - h * along))) / (2 * h)
        for h in (1e-4, 2e-4)
    )
    smooth = ((one / two - 1.0).abs() < 1e-5).numpy()
    difference = ((4.0 * one - two) / 3.0).numpy()
    return float(np.abs(difference[smooth] / exact[smooth] - 1.0).max())
