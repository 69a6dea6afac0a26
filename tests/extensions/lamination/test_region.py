"""Limits of lamination parameters: gradients, a panel whose best stack comes near its bound, refusals."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.refused import refused
from tests.sensitivity.number_cases import check, hung

pytestmark = pytest.mark.usefixtures("compiled")

MESH = mbd.mesh.rectangle(0.4, 0.1, cells=(4, 2))
CARBON = mbd.examples.carbon()
INSIDE = [[0.21, 0.13, -0.31, 0.05], [0.12, -0.23, -0.17, 0.1], [-0.3, 0.11, 0.14, 0.02], [0.03, 0.16, -0.4, 0.07]]


def system() -> mbd.System:
    field = mbd.fibers.FiberField(MESH, (2, 2), degree=1)
    x = torch.tensor(INSIDE)
    laminate = mbd.lamination.LaminationParameters(
        CARBON, [2e-3, 2.2e-3, 1.9e-3, 2.1e-3], x, 0.9 * x.flip(0), 0.2 * x.flip(1), field=field
    )
    return hung(mbd.FlexibleBody.plate("rod", MESH, laminate, modes=2, reference="left_edge"))


@pytest.mark.thorough
def test_forward_reverse_and_differences() -> None:
    """Of the motion with the smooth conditions; of the exact ones over steps that cross no kink."""
    names = [f"rod.laminate.{name}" for name in ("membrane", "coupling", "bending", "thickness")]

    def number(system: mbd.System, designs: dict[str, torch.Tensor], **options) -> torch.Tensor:
        motion = mbd.simulate(system, 0.02, steps=20, designs=designs, **options)
        return mbd.Integral(mbd.StrainEnergy("rod"))(motion) + mbd.lamination.LaminationRegion("rod", power=40.0)(
            motion
        ).mean(-1)

    def exact(system: mbd.System, designs: dict[str, torch.Tensor], **options) -> torch.Tensor:
        return mbd.lamination.LaminationRegion("rod")(
            mbd.simulate(system, 1e-3, steps=1, designs=designs, **options)
        ).sum(-1)

    check(system(), names, number)
    check(system(), names[:3], exact, dict.fromkeys(names, 1e-6))


@pytest.mark.thorough
def test_norms_bound_the_largest():
    motion = mbd.simulate(system(), 0.01, steps=4)
    exact, smooth = (mbd.lamination.LaminationRegion("rod", p)(motion) for p in (None, 50.0))
    assert bool((exact <= 1.0).all())
    assert bool((smooth >= exact - 1e-12).all())
    assert bool((smooth <= 4 ** (1 / 50) * exact.clamp(min=0.0) + 1e-12).all())


def test_refused():
    motion = mbd.simulate(mbd.examples.arm(), 0.01, steps=4)
    with refused("arm"):
        mbd.lamination.LaminationRegion("arm")(motion)
    with refused("power", 1.0):
        mbd.lamination.LaminationRegion("arm", 1.0)


def panel(laminate: mbd.Laminate) -> mbd.System:
    mesh = mbd.mesh.rectangle(0.5, 0.3, cells=(8, 5))
    body = mbd.FlexibleBody.plate("panel", mesh, laminate, modes=1, reference="left_edge")
    return mbd.System([body], [mbd.Fixed(mbd.Ground().at(), body.at("left_edge"), name="wall")])


EDGES = ("left_edge", "right_edge", "bottom_edge", "top_edge")
BUCKLING = mbd.buckling.BucklingFactor(
    "panel",
    {
        "right_edge": (-3e3, 0.0, 0.0),
        "left_edge": (3e3, 0.0, 0.0),
        "top_edge": (0.0, -2e3, 0.0),
        "bottom_edge": (0.0, 2e3, 0.0),
    },
    dict.fromkeys(EDGES, "u3") | {"corner_left_bottom": "u1 u2 u3", "corner_right_bottom": "u2 u3"},
)


@pytest.mark.slow  # an optimization, and a search of stacks
def test_the_best_stack_of_a_panel_comes_near_the_bound():
    """Largest buckling factor over lamination parameters, and of a stack of 16 plies in steps of 15 degrees: within 2 %."""
    laminate = mbd.lamination.LaminationParameters(CARBON, 2e-3, [0.0] * 4, bending=[0.0] * 4)
    problem = mbd.Problem(
        panel(laminate),
        1e-3,
        -1.0 * BUCKLING,
        [mbd.lamination.LaminationRegion("panel") <= 1.0],
        bounds=(-1.0, 1.0),
        variables=["panel.laminate.membrane", "panel.laminate.bending"],
        steps=2,
    )
    result = mbd.optimize(problem, method="slsqp", max_iterations=15)
    assert result.violation <= 1e-6
    bound = -result.value
    best = mbd.lamination.LaminationParameters(CARBON, 2e-3, *np.array(result.x).reshape(2, 4), checked=False)
    rules = mbd.lamination.LaminationRules(symmetric=True, balanced=True)
    stacks = mbd.lamination.recover_stacks(
        best, 16, mbd.deg(list(range(-75, 91, 15))), rules, weights=(0.0, 0.0, 1.0), number=3
    )
    assert all(not stack.broken for stack in stacks)
    reached = [float(BUCKLING(mbd.simulate(panel(stack.laminate), 1e-3, steps=2))) for stack in stacks]
    assert max(reached) <= bound * (1 + 1e-3)
    assert max(reached) >= 0.98 * bound
