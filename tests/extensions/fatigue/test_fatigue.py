"""Fatigue: rainflow counting as the standard prints it, S-N curves and constant-life diagrams in closed form, damage."""

from __future__ import annotations

import dataclasses
import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

import torchmbd as mbd
from tests.refused import refused
from torchmbd.design import history
from torchmbd.design.spline import Spline
from torchmbd.extensions.fatigue import Damage, EquivalentLoad, FatigueDamage, SNCurve, damage
from torchmbd.extensions.fatigue.rainflow import Cycles, rainflow

pytestmark = pytest.mark.usefixtures("compiled")

STANDARD = [-2.0, 1.0, -3.0, 5.0, -1.0, 3.0, -4.0, 4.0, -2.0]  # ASTM E1049-85, figure 6


def one_by_one(y: list[float]) -> list[tuple[float, float, float]]:
    """The rules of ASTM E1049-85, section 5.4.4, word by word: (range, mean, count)."""
    kept = [x for k, x in enumerate(y) if k == 0 or x != y[k - 1]]
    points = [x for k, x in enumerate(kept) if k in (0, len(kept) - 1) or (kept[k - 1] - x) * (kept[k + 1] - x) > 0]
    result, stack = [], []
    for point in points:
        stack.append(point)
        while len(stack) >= 3 and abs(stack[-1] - stack[-2]) >= abs(stack[-2] - stack[-3]):
            a, b = stack[-3], stack[-2]
            if len(stack) == 3:
                result.append((abs(b - a), (a + b) / 2, 0.5))
                stack.pop(0)
            else:
                result.append((abs(b - a), (a + b) / 2, 1.0))
                del stack[-3:-1]
    return result + [(abs(b - a), (a + b) / 2, 0.5) for a, b in pairwise(stack)]


@pytest.mark.parametrize("y", [STANDARD, torch.tensor(STANDARD), np.array(STANDARD, dtype=int)])
def test_the_example_of_the_standard(y):
    cycles = rainflow(y)
    result = {r: float(cycles.count[cycles.range == r].sum()) for r in (3.0, 4.0, 6.0, 8.0, 9.0)}
    assert result == {3.0: 0.5, 4.0: 1.5, 6.0: 0.5, 8.0: 1.0, 9.0: 0.5}
    assert float(cycles.count.sum()) == 4.0


@pytest.mark.parametrize("y", [[0.0, 1.0], [0.0, 0.5, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
def test_one_swing_is_half_a_cycle_however_it_is_sampled(y):
    cycles = rainflow(y)
    assert float(cycles.count[cycles.range == 1.0].sum()) == 0.5
    assert float(cycles.count[cycles.range > 0.0].sum()) == 0.5


@pytest.mark.thorough
@settings(max_examples=60, deadline=None)
@given(st.lists(st.lists(st.integers(-6, 6), min_size=12, max_size=12), min_size=1, max_size=4))
def test_stacked_as_one_by_one(rows):
    y = torch.tensor(rows, dtype=torch.float64)
    cycles = rainflow(y)
    for k, row in enumerate(rows):
        parts = zip(*(x[k].tolist() for x in cycles), strict=True)
        result = sorted(x for x in parts if x[2] and x[0])
        assert result == sorted(x for x in one_by_one([float(v) for v in row]) if x[0])


def test_ranges_and_means_have_derivatives():
    y = torch.tensor(STANDARD, dtype=torch.float64, requires_grad=True)

    def total(y):
        cycles = rainflow(y)
        return (cycles.count * (cycles.range**3 + cycles.mean**2)).sum()

    assert torch.autograd.gradcheck(total, y)
    rows = torch.vmap(torch.func.grad(total))(torch.stack([y.detach(), 2.0 * y.detach()]))
    assert_close(rows[0], torch.autograd.grad(total(y), y)[0])


@pytest.mark.parametrize("y", [torch.tensor(1.0), torch.tensor([1.0])])
def test_a_history_needs_two_values(y):
    with refused("y"):
        rainflow(y)
    with refused("y", "load.csv"):
        rainflow("load.csv")


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_a_history_that_is_not_finite_has_no_damage_made_up(wrong):
    y = torch.tensor([[0.0, 2.0, -1.0, 3.0], [0.0, 2.0, wrong, 3.0]])
    cycles = rainflow(y)
    assert cycles.range[1].isnan().all()
    assert cycles.range[0].tolist() == [2.0, 3.0, 4.0]
    t = torch.arange(4.0)
    load = mbd.fatigue.EquivalentLoad(mbd.Position("bob", "x"), exponent=3.0).reduce(Spline.of(t, y))
    damage = mbd.fatigue.Damage(mbd.Position("bob", "x"), curve=mbd.fatigue.SNCurve([(1e3, 4.0), (1e6, 2.0)])).reduce(
        Spline.of(t, y)
    )
    assert load.isnan().tolist() == damage.isnan().tolist() == [False, True]


def test_peaks_between_the_samples_are_found():
    """A sine of amplitude one, sampled nine times a period, of which no sample is a peak: one whole cycle, two halves."""
    t = torch.linspace(0.0, 2.0, 19, dtype=torch.float64)
    curve = Spline.of(t, torch.sin(2 * math.pi * t))
    cycles = rainflow(curve.extremes()[None])
    assert float(cycles.range.max()) == pytest.approx(2.0, rel=2e-3)
    assert float((cycles.count * (cycles.range > 1.9)).sum()) == 1.5
    assert float(cycles.range.max()) > float(rainflow(curve.y).range.max()) + 1e-3


def sine(amplitude: float, mean: float, cycles: float) -> tuple[mbd.System, dict]:
    """A free body on whose clock histories are written."""
    clock = mbd.RigidBody("clock", 1.0, (1.0, 1.0, 1.0), velocity=(1.0, 0.0, 0.0))

    @history
    def stress(motion):
        return mean + amplitude * torch.sin(2 * math.pi * cycles * motion.body("clock").r[..., 0])

    return mbd.System([clock], []), {"stress": stress}


@pytest.mark.thorough
def test_equivalent_load_and_damage_of_a_sine_in_closed_form():
    system, result = sine(30e6, 10e6, 4.0)
    motion = mbd.simulate(system, 1.0, steps=400)
    load = EquivalentLoad(result["stress"], exponent=6.0, cycles=1.0)(motion)
    # Three whole cycles of the full range, two halves of it, and two halves of half the range at both ends.
    expected = 60e6 * (3.5 + 0.5 * (0.5**6) * 2) ** (1 / 6)
    assert float(load) == pytest.approx(expected, rel=1e-3)
    curve = SNCurve([(1e3, 100e6), (1e6, 50e6)], tension=200e6)
    damage = Damage(result["stress"], curve=curve, repeats=10.0)(motion)
    exponent = 3.0 / math.log10(2.0)
    whole = (30e6 / (1 - 0.05) / 100e6) ** exponent / 1e3
    halves = sum((15e6 / (1 - mean / 200e6) / 100e6) ** exponent / 1e3 for mean in (25e6, -5e6))
    down = sum((15e6 / (1 - abs(mean) / 200e6) / 100e6) ** exponent / 1e3 for mean in (25e6, 5e6))
    assert halves > 0.0
    assert float(damage) == pytest.approx(10 * (3.5 * whole + 0.5 * down), rel=2e-3)


def test_a_history_at_rest_does_no_damage():
    system, result = sine(0.0, 5e6, 1.0)
    motion = mbd.simulate(system, 1.0, steps=20)
    assert float(EquivalentLoad(result["stress"])(motion)) == 0.0
    assert float(Damage(result["stress"], curve=SNCurve([(1, 2e6), (10, 1e6)]))(motion)) == 0.0


def test_lives_in_closed_form():
    curve = SNCurve([(1e2, 500e6), (1e4, 300e6), (1e7, 100e6)], tension=1000e6, compression=600e6)

    def life(a: float, mean: float = 0.0) -> float:
        return float(curve.cycles(*(torch.tensor(x, dtype=torch.float64) for x in (a, mean))))

    for n, a in curve.points:
        assert life(a) == pytest.approx(n, rel=1e-12)
    middle = math.sqrt(500e6 * 300e6)
    assert life(middle) == pytest.approx(1e3, rel=1e-12)
    assert life(50e6) > 1e7  # continued
    # The triangle: highest at the mean (T - C) / 2 = 200e6, where A = 800e6, against A(0) = 600e6.
    assert life(300e6, 200e6) == pytest.approx(life(225e6), rel=1e-12)
    assert life(300e6, 500e6) == pytest.approx(life(300e6 * 600 / 500), rel=1e-12)
    assert life(300e6, -300e6) == pytest.approx(life(300e6 * 600 / 300), rel=1e-12)
    assert life(300e6, 2000e6) < 1e-3
    assert life(0.0) == math.inf


@pytest.mark.parametrize(
    ("points", "path"),
    [
        ([(1e3, 2e8)], "points"),
        ([(1e3, 2e8), (1e2, 1e8)], "points.1"),
        ([(1e3, 2e8), (1e4, 1e8), (1e5, 1.5e8)], "points.2"),
        ([(1e3, 2e8), (1e4, -1.0)], "points.1"),
        ([(1e3, 2e8), (float("nan"), 1e8)], "points.1"),
        ("steel", "points"),
        ([(1e3, mbd.variable(2e8)), (1e4, 1e8)], "points"),
    ],
)
def test_points_that_are_not_in_order_are_named(points, path):
    with refused(path):
        SNCurve(points)


@pytest.mark.parametrize(
    ("make", "path"),
    [
        (lambda: SNCurve([(1, 2), (3, 1)], tension=-1.0), "tension"),
        (lambda: SNCurve([(1, 2), (3, 1)], compression=5.0), "compression"),
        (lambda: EquivalentLoad(mbd.StrainEnergy("rod"), exponent=0.0), "exponent"),
        (lambda: EquivalentLoad(mbd.StrainEnergy("rod"), cycles=-2), "cycles"),
        (lambda: Damage(mbd.StrainEnergy("rod")), "curve"),
        (lambda: FatigueDamage("rod", {"33": 4.0}), "stress component"),
        (lambda: FatigueDamage("rod", {"11": -4.0}), "exponent 11"),
        (lambda: FatigueDamage("rod", {}), "exponent"),
        (lambda: FatigueDamage("rod", curves={}), "curves"),
        (lambda: FatigueDamage("rod", curves={"11": 3}), "11.curve"),
        (lambda: FatigueDamage("rod", repeats=0), "repeats"),
    ],
)
def test_what_is_wrong_is_named(make, path):
    with refused(path):
        make()


@pytest.fixture(scope="module")
def swinging():
    return mbd.simulate(mbd.examples.arm(), 0.3, steps=150, gradients="reverse")


def test_the_worst_point_of_all(swinging):
    """Against the damage of every point and component, one at a time, at the output times."""
    plies = mbd.PlyHistory(swinging, "arm")
    stress, strength = plies.stress()[0].detach(), plies.strength[0].detach()
    most = 0.0
    for c, (up, down) in enumerate(((0, 1), (2, 3), (4, 4))):
        for point in range(stress.shape[1]):
            T, C = float(strength[point, up]), float(strength[point, down])
            damage = sum(
                n * (0.5 * r / (0.5 * (T + C - abs(2 * m - T + C)))) ** 10
                for r, m, n in one_by_one(stress[:, point, c].tolist())
            )
            most = max(most, damage)
    assert most > 0.0
    assert float(FatigueDamage("arm")(swinging)) == pytest.approx(most, rel=2e-2)


def waves(amplitude: float, mean: float) -> torch.Tensor:
    """Twenty equal waves about a mean, at their ends only [40]."""
    sign = torch.ones(40, dtype=torch.float64)
    sign[1::2] = -1.0
    return mean + amplitude * sign


def bounds_and_damages(y: torch.Tensor, rule: FatigueDamage, strengths: torch.Tensor | None = None):
    """Upper bounds [points] of histories [points, times] of component 22, and their damages by the cycles."""
    basis = torch.zeros(1, len(y), 5, y.shape[1], dtype=torch.float64)
    basis[0, :, 1] = y
    bounds = damage._upper_bounds(basis, torch.eye(y.shape[1], dtype=torch.float64)[None], strengths, rule)
    strength = None if strengths is None else strengths[0]
    return bounds[0], rule.of_cycles(rainflow(y), 1, strength)


def test_the_bound_of_the_screening_is_sharp_for_equal_waves():
    """A curve without influence of the mean: the damage is (turns + 1) half cycles of the whole range."""
    rule = FatigueDamage("arm", curves={"22": SNCurve([(1e3, 100e6), (1e6, 50e6)])})
    y = torch.stack([waves(a, m) for a, m in ((30e6, 0.0), (70e6, 20e6), (50e6, -90e6))])
    bounds, damages = bounds_and_damages(y, rule)
    assert_close(bounds, damages, rtol=1e-12, atol=0)
    assert float(damages[2]) == pytest.approx(19.5e-6, rel=1e-12)  # 39 half cycles of a life of 1e6


def test_no_damage_is_above_the_bound_of_the_screening():
    """Waves about means on both sides of the most that the diagram allows, small ones beside a large one, and noise."""
    make = torch.Generator().manual_seed(3)
    noise = 40e6 * torch.randn(40, 40, generator=make, dtype=torch.float64) + torch.linspace(-3e7, 3e7, 40)[:, None]
    far = torch.stack([waves(10e6, m) for m in (-120e6, -60e6, 0.0, 60e6, 120e6)])
    y = torch.cat([noise, far, torch.cat([far[:, :39], -far[:, :1]], 1)])
    strengths = torch.tensor([3e8, 2e8, 2e8, 2.5e8, 6e7, 5e7, 5e7, 0.0], dtype=torch.float64).expand(1, len(y), 8)
    for exponent in (1.0, 10.0):
        bounds, damages = bounds_and_damages(y, FatigueDamage("arm", {"22": exponent}), strengths)
        assert bool((bounds >= damages).all())
    curve = SNCurve([(1e3, 100e6), (1e6, 50e6)], tension=200e6, compression=250e6)
    bounds, damages = bounds_and_damages(y, FatigueDamage("arm", curves={"22": curve}))
    assert bool((bounds >= damages).all())


@pytest.mark.thorough
def test_the_screening_finds_the_worst_point(monkeypatch):
    """Where one history at a time is counted: the one with the largest bound has not the largest damage."""
    monkeypatch.setattr(damage, "_HISTORIES", 1)
    make = torch.Generator().manual_seed(8)
    basis = 3e7 * torch.randn(2, 25, 5, 30, generator=make, dtype=torch.float64)
    strengths = 3e8 + 1e8 * torch.rand(2, 25, 8, generator=make, dtype=torch.float64)
    w, rule = torch.eye(30, dtype=torch.float64).expand(2, 30, 30), FatigueDamage("arm", 4.0)
    component, point = damage._worst_points(basis, w, strengths, rule)
    first = damage._upper_bounds(basis, w, strengths, rule).argmax(1).tolist()
    for lane in range(2):
        damages = [rule.of_cycles(rainflow(basis[lane, :, c]), c, strengths[lane]) for c in range(5)]
        worst = int(torch.cat(damages).argmax())
        assert worst == 25 * int(component[lane]) + int(point[lane])
        assert worst != first[lane]


@pytest.mark.thorough
def test_repeats_and_curves(swinging):
    once, often = (float(FatigueDamage("arm", repeats=n)(swinging)) for n in (1.0, 1e5))
    assert often == pytest.approx(1e5 * once, rel=1e-12)
    strength = mbd.examples.carbon().strength
    T, C = strength.Yt, strength.Yc
    curve = SNCurve([(1.0, min(T, C)), (1e10, min(T, C) / 10)], tension=T, compression=C)
    same = [float(x(swinging)) for x in (FatigueDamage("arm", {"22": 10}), FatigueDamage("arm", curves={"22": curve}))]
    assert same[0] == pytest.approx(same[1], rel=1e-9)


@pytest.mark.thorough
def test_beams_are_judged_as_well():
    """A clamped strip that swings: the damage at the root by the bending stress of its section."""
    section = mbd.sections.strip(0.02, mbd.examples.carbon(), mbd.deg([0.0, 0.0]), thickness=1e-3, cells=(8, 1))
    line = mbd.BeamLine.straight(0.5, 4)
    beam = mbd.FlexibleBody.beam("beam", line, section, modes=3, reference=0)
    system = mbd.System([beam], [mbd.Fixed(mbd.Ground().at(), beam.at(0))], gravity=(0.0, 0.0, -9.81))
    motion = mbd.simulate(system, 0.2, steps=200)
    damage = FatigueDamage("beam", {"11": 8.0})(motion)
    stress = mbd.SectionHistory(motion, "beam").stress()[0].flatten(1, 2)[..., 0].detach()
    worst = max(
        sum(n * (0.5 * r / 1.2e9) ** 8 for r, _, n in one_by_one(stress[:, k].tolist())) for k in range(stress.shape[1])
    )
    assert worst > 0.0
    assert float(damage) == pytest.approx(worst, rel=0.2)  # without the mean, which the diagram shifts by a little


def test_many_histories_at_once_take_no_longer_than_they_should():
    y = torch.from_numpy(np.random.default_rng(0).standard_normal((300, 60)))
    cycles = rainflow(y)
    assert cycles.range.shape == (300, 59)
    assert bool((cycles.count.sum(1) > 10.0).all())


def test_cycles_are_counted_for_each_second_of_the_window():
    """Four cycles of range 2 in the four seconds from peak to peak, which begin after four."""
    t = torch.linspace(0.0, 10.0, 401, dtype=torch.float64)
    curve = Spline.of(t, torch.cos(2.0 * math.pi * t), (4.0, 8.0))
    load = EquivalentLoad(mbd.Position("bob", "x"), (4.0, 8.0), exponent=3.0)
    assert_close(load.reduce(curve), torch.tensor(2.0, dtype=torch.float64), rtol=1e-4, atol=0.0)


@pytest.mark.parametrize(("component", "name"), [(0, "11"), (1, "22")])
def test_each_component_has_its_strengths_in_tension_and_compression(component, name):
    """The constant-life triangle from -C to T: T - mean on the side of tension, C + mean on that of compression."""
    strength = torch.full((8,), 1e9, dtype=torch.float64)
    strength[2 * component], strength[2 * component + 1] = 40.0, 160.0
    rule = FatigueDamage("rod", exponent={name: 3.0})
    for mean, allowable in ((20.0, 20.0), (-100.0, 60.0)):
        cycles = Cycles(*(torch.tensor([x], dtype=torch.float64) for x in (20.0, mean, 1.0)))
        damage = rule.of_cycles(cycles, component, strength)
        assert float(damage) == pytest.approx((10.0 / allowable) ** 3, rel=1e-12)


@pytest.mark.thorough
def test_a_free_laminate_that_warms_and_cools():
    """Residual stresses of [0/90]s alternate: five whole cycles of the closed form; and the gradient on an unbalanced stack."""
    ply = dataclasses.replace(mbd.examples.carbon(), alpha1=-0.3e-6, alpha2=28e-6)
    ground, mesh = mbd.Ground(), mbd.mesh.rectangle(0.2, 0.1, (2, 2))

    def damage_of(stack: list[float]) -> tuple[torch.Tensor, mbd.Laminate, torch.nn.Parameter]:
        laminate, size = mbd.Laminate(ply, mbd.deg(stack), 0.25e-3, symmetric=True), mbd.variable(100.0)
        body = mbd.FlexibleBody.plate("panel", mesh, laminate, 2, reference=0, expansion=True, damping=1e-5)
        body.position.copy_(body.origin)
        heat = mbd.Temperature(body, mbd.forces.Scaled(size, lambda t: torch.cos(10.0 * math.pi * t)), name="heat")
        hold = mbd.Fixed(ground.at(*body.origin.tolist()), body.at(0))
        system = mbd.System([body], [hold], [heat], truncation=None)
        motion = mbd.simulate(system, 1.0, steps=40, backend="eager", start="equilibrium")
        return FatigueDamage("panel", exponent={"22": 10.0})(motion), laminate, size

    total, laminate, size = damage_of([0, 90])
    stress = laminate.expansion(temperature=100.0).stress[..., 1].abs().max()
    _, _, Yt, Yc = ply.strength.numbers()[:4]
    expected = 5.0 * (stress / (0.5 * (Yt + Yc - (Yc - Yt)))) ** 10
    assert float(total.detach()) == pytest.approx(float(expected.detach()), rel=1e-3)
    total, laminate, size = damage_of([10, 70])
    total.sum().backward()
    assert laminate.angles.grad is not None
    assert size.grad is not None
    assert float(size.grad) == pytest.approx(10.0 * float(total.detach()) / 100.0, rel=1e-5)
    ends = [float(damage_of([10 + h, 70])[0].detach()) for h in (0.02, -0.02)]
    assert float(laminate.angles.grad[0]) == pytest.approx((ends[0] - ends[1]) / math.radians(0.04), rel=1e-5)
