"""The antenna: counts of the paper, rigid motion against one pendulum equation, gradient, failure, gaps."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import torchmbd as mbd
from experiments.models.sar_antenna import build, phi3, theta
from experiments.models.sar_antenna_bodies import Truss
from experiments.models.sar_antenna_clearance import gaps, verdict
from experiments.models.sar_antenna_data import (
    ANGLES,
    CRANK,
    DAMPING,
    HALF,
    IM6,
    INTEGRATOR,
    KNOTS,
    LENGTH,
    PLY,
    STOWED,
    WIDTH,
)
from experiments.models.sar_antenna_flatness import flatness
from experiments.models.sar_antenna_whole import unlocked
from experiments.paper.antenna_tables import OBJECTIVE, gradient, reaches_zero

pytestmark = pytest.mark.usefixtures("compiled")

COARSE = (16, 8)


def rigid_angle(times: np.ndarray) -> np.ndarray:
    """theta of the rigid parallelogram, one freedom: I theta'' = -M(theta) - c theta'; rods move on circles of the crank."""
    area = math.pi * 5e-3**2
    panel, crank = IM6["density"] * LENGTH * WIDTH * 2e-3, IM6["density"] * area * CRANK
    rods = 2 * IM6["density"] * area * math.hypot(HALF, 0.4875)
    inertia = panel * ((LENGTH**2 + 2e-3**2) / 12 + HALF**2) + crank * (CRANK**2 / 3 + 5e-3**2 / 4) + rods * CRANK**2
    s, M = np.array(KNOTS).T

    def rates(_, z):
        return [z[1], -(np.interp(z[0], s, M) + DAMPING * z[1]) / inertia]

    return solve_ivp(rates, (0.0, times[-1]), [STOWED, 0.0], t_eval=times, rtol=1e-10, atol=1e-12, max_step=0.02).y[0]


def test_counts_of_the_paper():
    result = unlocked().describe()
    assert (len(result.bodies) + 1, result.rows, result.rank, result.mobility) == (12, 63, 58, 8)
    kinds = [joint.kind for joint in result.joints]
    assert (kinds.count("Spherical"), kinds.count("Revolute")) == (16, 3)
    assert len(result.redundant) == 5
    names = {f"S{k}" for k in range(1, 17)}
    assert {row.partition(":")[0] for row in result.redundant} <= names | {"R1", "R2", "R3"}


def test_rows_of_phase_1():
    rigid, flexible = build(None).describe(), build(modes=4, cells=COARSE)().dynamics.rank
    assert (rigid.rows, rigid.rank, rigid.mobility, len(rigid.redundant)) == (31, 27, 3, 4)
    first, second = (sorted(x) for x in zip(*(row.split(": ") for row in flexible.redundant), strict=True))
    assert second == ["coincide y"] * 2
    assert first in (["S1", "S3"], ["S1", "S4"], ["S2", "S3"], ["S2", "S4"])
    assert len(flexible.left_out) == 2


@pytest.mark.thorough
def test_rigid_motion_is_that_of_one_freedom():
    """Through the steep part of the law; rods do not spin, panel 2 stays."""
    motion = mbd.simulate(build(None), 4.0, steps=160).require_ok()
    expected = torch.from_numpy(rigid_angle(motion.t.numpy()))
    assert float(expected[-1]) < 2.9
    assert float((theta(motion)[0] - expected).abs().max()) < 1e-4
    assert float((phi3(motion)[0] - expected).abs().max()) < 1e-4
    panel2, rod = motion.body("panel2"), motion.body("roda")
    assert float((panel2.r[0] - panel2.r[0, 0]).abs().max()) < 1e-9
    assert float(rod.omega[0, :, 0].abs().max()) < 1e-9


def test_time_at_which_the_antenna_is_in_line():
    """Of the one freedom: 8.25 s; the reference code has 8.26 s."""
    times = np.linspace(0.0, 8.4, 841)
    t = times[np.argmax(rigid_angle(times) <= 0.0)]
    assert t == pytest.approx(8.26, abs=0.02)
    motion = mbd.simulate(build(None), 0.1, steps=2)
    assert math.isnan(reaches_zero(motion))


def test_gradient_of_the_energy_integral(monkeypatch):
    monkeypatch.setattr("experiments.paper.antenna_tables.DURATION", 0.3)
    assert gradient(30, modes=4, cells=COARSE) < 1e-4


@pytest.mark.thorough
def test_gradient_by_the_plies_of_the_trusses():
    """Wound tubes that share their plies, beside differences of the same map."""
    name, angles = "crank.section.angles", (10.0, -30.0)
    system = build((40.0, -30.0), modes=2, cells=COARSE, reduction="craig-bampton", trusses="tube", truss_angles=angles)
    assert [x for x, y in system.named_parameters() if y.requires_grad] == [ANGLES, name]
    given: dict[str, Any] = {"steps": 20, "halvings": 0} | INTEGRATOR["tube"] | {"iterations": (5, 2)}
    motion = mbd.simulate(system, 0.1, gradients="forward", variables=[ANGLES, name], **given).require_ok()
    exact = OBJECTIVE.value_and_gradient(motion).gradient[0, 2:]
    step = 1e-4 * torch.cat([torch.eye(2), -torch.eye(2)]).double()
    f = OBJECTIVE.value(mbd.simulate(system, 0.1, designs={name: mbd.deg(angles) + step}, **given).require_ok())
    torch.testing.assert_close(exact, (f[:2] - f[2:]) / 2e-4, rtol=1e-4, atol=0.0)


def test_tubes_have_the_mass_of_the_rods():
    """Fibers along the axis: the tensile stiffness of the rods as well, and more in bending."""
    rod, tube = (Truss(kind).section for kind in ("beam", "tube"))
    torch.testing.assert_close(tube.mass()[0, 0], rod.mass()[0, 0], rtol=5e-3, atol=0.0)
    torch.testing.assert_close(tube.stiffness()[0, 0], rod.stiffness()[0, 0], rtol=8e-2, atol=0.0)
    assert tube.stiffness()[4, 4] > 10.0 * rod.stiffness()[4, 4]


def test_hub_rod_ends_and_stowed_angle():
    """A wider axle leaves fewer nodes free; rods end elsewhere; without gravity phase 1 does not notice the stowed angle."""
    narrow, wide = (build(modes=2, cells=COARSE, hub=x).body("panel2") for x in (0.0, 0.13))
    assert len(wide.reference) == 3 * len(narrow.reference)
    system = build(None, rod_point=(0.623125, 0.4875))
    assert float(system.body("crank").center[0]) == pytest.approx((HALF + 0.623125) / 2)
    turned, flat = (mbd.simulate(build(None, stowed=x), 1.0, steps=20).require_ok() for x in (3.0, STOWED))
    assert float((theta(turned) - theta(flat)).abs().max()) < 1e-9


def test_panels_share_one_laminate():
    system = build(modes=4, cells=COARSE)
    assert [name for name, x in system.named_parameters() if x.requires_grad] == [ANGLES]
    assert system.body("panel2").laminate is system.body("panel3").laminate
    assert len([x for x in build(angles3=(0.0, 90.0), modes=4, cells=COARSE).parameters() if x.requires_grad]) == 2
    OBJECTIVE.check(system)


def test_the_crank_that_runs_ahead_is_recognized():
    """Joints 50 mm off the mid-surfaces: the force of the rods bends the panels."""
    motion = mbd.simulate(build((0.0, 0.0), arm=0.05, modes=12, cells=COARSE), 1.5, steps=100, halvings=0)
    assert verdict(motion).startswith("fails as in Fig. 17: from t = ")
    fair = mbd.simulate(build(None), 1.6, steps=20)
    assert verdict(fair) == "deploys"


def test_gaps_of_the_stowed_antenna():
    """Panel 2 rises by sin(3.12) = 0.0216 from the hinge line, panel 3 lies level above it at 2 * 0.997 * 0.0216."""
    motion = mbd.simulate(build(None), 0.1, steps=2)
    result = {pair: float(gap[0, 0]) for pair, gap in gaps(motion).items()}
    slope = math.sin(STOWED)
    assert result["panel 1 - panel 3"] == pytest.approx(LENGTH * slope, rel=1e-3)
    assert result["panel 3 - crank"] == pytest.approx(HALF * slope, rel=1e-3)
    assert all(gap > 0.0 for gap in result.values())
    flexible = gaps(mbd.simulate(build(modes=4, cells=COARSE), 0.01, steps=1))
    assert float(flexible["panel 3 - crank"][0, 0]) == pytest.approx(HALF * slope, rel=1e-3)


def test_errors_name_the_argument():
    with pytest.raises(mbd.InputError, match="law = 'jumpy': must be one of continuous, printed"):
        build(law="jumpy")
    with pytest.raises(mbd.InputError, match="Try: cells in multiples of"):
        build(cells=(10, 4))


@pytest.mark.thorough
def test_flatness_in_the_sun():
    """The closed form against the nodes of a panel of elements that is held at one point, by their best plane."""
    system = build((20.0, -50.0, 75.0, 10.0), cells=(16, 8), modes=2, reduction="craig-bampton")
    expected = flatness(mbd.simulate(system, 1e-3, steps=2, backend="eager"), "panel2", 10.0)
    mesh = mbd.mesh.rectangle(LENGTH, WIDTH, (16, 8))
    laminate = system.body("panel2").laminate
    panel = mbd.FlexibleBody.plate("panel", mesh, laminate, 1, reference="center", expansion=True)
    hold, sun = mbd.Fixed(mbd.Ground().at(), panel.at("center")), mbd.Temperature(panel, gradient=10.0 / (4 * PLY))
    w = mbd.equilibrium(mbd.System([panel], [hold], [sun], truncation=None)).body("panel").w[0, 0]
    x, y = mesh.nodes[:, :2].T
    planes = torch.stack([torch.ones_like(x), x, y], 1)
    simpson = torch.ones_like(x)
    for s, length, cells in ((x, LENGTH, 16), (y, WIDTH, 8)):
        k = ((s / length + 0.5) * cells).round()
        simpson = simpson * torch.where((k == 0) | (k == cells), 1.0, torch.where(k % 2 == 1, 4.0, 2.0))
    share = (simpson / simpson.sum()).sqrt()[:, None]  # of the area
    moved = share * (panel.structure()["psi"] @ w).detach()[:, 2:3]
    rest = moved - share * planes @ torch.linalg.lstsq(share * planes, moved).solution
    assert float(rest.norm()) == pytest.approx(float(expected.detach()), rel=2e-3)
