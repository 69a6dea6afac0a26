"""Buckling along a motion: against static buckling, closed forms, the full eigenproblem, and differences."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import finished, pendulum
from tests.refused import refused
from torchmbd.design.response_spec import history_of, measure_of
from torchmbd.extensions.buckling import eigenproblem
from torchmbd.extensions.buckling.body_loads import body_loads, interpolations
from torchmbd.extensions.buckling.buckling_series import BucklingSeries
from torchmbd.extensions.buckling.unit_loads import UnitLoads

pytestmark = pytest.mark.usefixtures("compiled")
CARBON = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=5.36e9, nu12=0.23, density=1586.0)
LENGTH, EI, GJ = 2.0, 100.0, 1000.0
PINNED = {"start": "u1 u2 u3 phi1", "end": "u2 u3"}


def rod(mass: float = 1e-3, reference: str = "start", cells: int = 12, **given: Any) -> mbd.FlexibleBody:
    """A beam that bends with 100 and 200 N m2; mass per length [kg/m]."""
    stiffness = torch.diag(torch.tensor([1e8, 1e8, 1e8, GJ, EI, 2.0 * EI], dtype=torch.float64))
    inertia = torch.diag(torch.tensor([mass, mass, mass, 2e-3, 1e-3, 1e-3], dtype=torch.float64))
    section, line = mbd.GivenSection(stiffness, inertia), mbd.BeamLine.straight(LENGTH, cells)
    return mbd.FlexibleBody.beam("rod", line, section, **({"modes": 4, "reference": reference} | given))


def panel() -> mbd.FlexibleBody:
    laminate = mbd.Laminate(CARBON, [0.3, -0.5, 1.0], [1e-3, 2e-3, 1.5e-3])
    mesh = mbd.mesh.rectangle(1.0, 0.7, (4, 3))
    return mbd.FlexibleBody.plate("rod", mesh, laminate, modes=4, reference="left_edge")


def tube(elements: int = 4) -> mbd.FlexibleBody:
    section = mbd.sections.tube(0.03, CARBON, [0.3, -0.3], 1e-3)
    return mbd.FlexibleBody.beam("rod", mbd.BeamLine.straight(1.0, elements), section, modes=2, reference="start")


def loaded(body: mbd.FlexibleBody, root: str, end: Any, force: tuple[float, float, float], rise: float) -> mbd.System:
    """The body on the ground under a force that rises slowly."""
    full = torch.tensor(force, dtype=torch.float64)
    law = mbd.Force(body.at(end), lambda t: full * torch.sin(0.5 * math.pi * t / rise) ** 2)
    return mbd.System([body], [mbd.Fixed(mbd.Ground().at(0, 0, 0), body.at(root))], [law])


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("make", "root", "end", "force"),
    [
        (rod, "start", "end", (-30.0, 0.0, 0.0)),
        (lambda: rod(modes=0, reduction="craig-bampton", interface="end"), "start", "end", (-30.0, 3.0, 0.0)),
        (lambda: rod(stiffening=True), "start", "end", (-30.0, 0.0, 1.0)),
        (panel, "left_edge", "corner_right_top", (-1e2, 30.0, 0.0)),
    ],
    ids=["column", "static_modes", "stiffening", "panel"],
)
def test_a_slow_motion_has_the_factor_of_static_loads(make: Callable, root: str, end: str, force: tuple):
    body = make()
    motion = finished(mbd.simulate(loaded(body, root, end, force, 2.0), 2.0, steps=40, backend="eager"))
    for number in (1, 2):
        index = mbd.buckling.BucklingIndex("rod", number=number)(motion)[0]
        expected = 1.0 / mbd.buckling.linear_buckling(body, {end: force}, number=number).factors[-1]
        share = torch.sin(0.25 * math.pi * motion.t) ** 2
        assert_close(index[10:], (expected * share)[10:], rtol=2e-4, atol=0.0)
    assert_close(
        mbd.buckling.BucklingFactor("rod")(motion)[0],
        mbd.buckling.linear_buckling(body, {end: force}).factors[0],
        rtol=2e-4,
        atol=0.0,
    )


@pytest.mark.thorough
def test_lateral_buckling_of_a_cantilever():
    """4.0126 (EI GJ)^1/2 / L^2, a force at the tip in the stiff plane (Timoshenko and Gere)."""
    motion = finished(mbd.simulate(loaded(rod(), "start", "end", (0.0, 5.0, 0.0), 2.0), 2.0, steps=40, backend="eager"))
    factor = 5.0 * mbd.buckling.BucklingFactor("rod")(motion)[0].item()
    assert factor == pytest.approx(4.0126 * math.sqrt(EI * GJ) / LENGTH**2, rel=3e-3)


@pytest.mark.thorough
@pytest.mark.parametrize("reference", ["start", "center"])
def test_a_column_under_its_own_weight(reference):
    """7.837 EI / L^3 (Greenhill): the stress comes from gravity, or from a foundation that rises as fast."""
    body = rod(mass=2.0, reference=reference, modes=2, axes=[[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    system = mbd.System([body], [mbd.Fixed(mbd.Ground().at(0, 0, 0), body.at("start"))], gravity=(0, -9.81, 0))
    fall = mbd.System([body], [mbd.Fixed(mbd.Ground().at(0, 0, 0), body.at("start"))], gravity=(0, 9.81, 0))
    supports = {"start": "all"}
    assert bool((body.axes @ torch.tensor([1.0, 0, 0], dtype=torch.float64))[1] == 1.0)
    upright = mbd.buckling.BucklingIndex("rod", supports)(mbd.simulate(system, 0.1, steps=10, backend="eager"))[0]
    hanging = mbd.buckling.BucklingIndex("rod", supports)(mbd.simulate(fall, 0.1, steps=10, backend="eager"))[0]
    expected = 2.0 * 9.81 * LENGTH**3 / (7.8373 * EI)
    assert_close(upright, torch.full_like(upright, expected), rtol=5e-3, atol=0.0)
    assert not bool(hanging.any())


@pytest.mark.thorough
@pytest.mark.parametrize("where", ["start", "center"])
def test_euler_column_on_a_slider_crank(where):
    """The rod carries F / cos(angle) between its pins; it buckles at pi^2 EI / L^2."""
    r, force = 0.4, 50.0
    crank = mbd.RigidBody("crank", 1e-3, (1e-6, 1e-6, 1e-6))
    body = rod(reference=where, damping=0.01, position=(r, 0, 0) if where == "start" else (r + 0.5 * LENGTH, 0, 0))
    slider = mbd.RigidBody("slider", 1e-3, (1e-6, 1e-6, 1e-6), position=(r + LENGTH, 0, 0))
    ground = mbd.Ground()
    system = mbd.System(
        [crank, body, slider],
        [
            mbd.Revolute(ground.at(0, 0, 0), crank.at(), axis="z"),
            mbd.Drive(ground, crank, axis="z", speed=0.5),
            mbd.Revolute(crank.at(r, 0, 0), body.at("start"), axis="z"),
            mbd.Revolute(body.at("end"), slider.at(), axis="z"),
            mbd.Prismatic(ground.at(r + LENGTH, 0, 0), slider.at(), axis="x"),
        ],
        [mbd.Force(slider.at(), (-force, 0.0, 0.0))],
    )
    motion = finished(mbd.simulate(system, 4.0, steps=40, backend="eager"))
    index = mbd.buckling.BucklingIndex("rod", PINNED)(motion)[0]
    lean = r * torch.sin(0.5 * motion.t) / LENGTH
    expected = force / torch.sqrt(1.0 - lean**2) * LENGTH**2 / (math.pi**2 * EI)
    assert_close(index[2:], expected[2:], rtol=2e-3, atol=0.0)
    peak = mbd.buckling.BucklingFactor("rod", supports=PINNED)(motion).item()
    assert peak == pytest.approx(1.0 / float(expected.max()), rel=2e-3)


@pytest.mark.thorough
def test_a_frame_on_several_nodes_spreads_its_force():
    body, force = panel(), (-1e2, 0.0, 0.0)
    frame = list(body.mesh.node_sets["right_edge"])
    motion = finished(mbd.simulate(loaded(body, "left_edge", frame, force, 2.0), 2.0, steps=40, backend="eager"))
    nodal = {(int(k),): tuple(x / len(frame) for x in force) for k in frame}
    expected = 1.0 / mbd.buckling.linear_buckling(body, nodal).factors[0]
    assert_close(mbd.buckling.BucklingIndex("rod")(motion)[0, -1], expected, rtol=1e-4, atol=0.0)


@pytest.mark.thorough
@pytest.mark.parametrize("supports", [None, {"left": "all", "right": "u2 u3"}])
def test_the_small_basis_against_the_full_eigenproblem(supports):
    """At every time of a spatial motion, several indices."""
    system = pendulum()
    body, motion = system.body("rod"), mbd.simulate(system, 0.04, steps=20, backend="eager")
    with torch.no_grad():
        loads, view = body_loads(motion, body), motion.body("rod")
        moved = torch.cat([view.psi, UnitLoads(body, interpolations(system, body))(view.psi, view.stiffness[0])], -1)
        c = torch.cat([view.w, loads.inertia, loads.concentrated.flatten(2)], -1)
        series = BucklingSeries(body, supports)
        result, supported = series(moved, c, 3), series.supported
        Kg = torch.einsum("tk,kn->tn", c[0], supported.geometric(moved).reshape(c.shape[-1], -1))
        K = supported.restricted(supported.assembly.stiffness()).dense().numpy()
    for got, values in zip(result[0], Kg, strict=True):
        full = supported.pattern.to_scipy(values).toarray()
        expected = -scipy.linalg.eigvalsh(full, K)[:3]
        np.testing.assert_allclose(got.numpy(), np.maximum(expected, 0.0), rtol=0.0, atol=1e-8 * expected.max())


@pytest.mark.thorough
def test_the_sparse_way_and_times_without_load(monkeypatch):
    motion = finished(
        mbd.simulate(loaded(rod(), "start", "end", (-30.0, 0.0, 0.0), 2.0), 2.0, steps=10, backend="eager")
    )
    dense = mbd.buckling.BucklingIndex("rod")(motion)
    assert not bool(dense[0, 0])
    monkeypatch.setattr(eigenproblem, "SMALL", 10)
    assert_close(mbd.buckling.BucklingIndex("rod")(motion), dense, rtol=0.0, atol=1e-8 * float(dense.max()))
    body = rod()
    unloaded = mbd.System([body], [mbd.Fixed(mbd.Ground().at(0, 0, 0), body.at("start"))])
    still = mbd.simulate(unloaded, 2.0, steps=2, backend="eager")
    assert not bool(mbd.buckling.BucklingIndex("rod")(still).any())
    assert bool(torch.isinf(mbd.buckling.BucklingFactor("rod")(still)))


@pytest.mark.thorough
def test_phases_go_on_with_the_same_forces_only():
    system = loaded(rod(), "start", "end", (-30.0, 0.0, 0.0), 2.0)
    index = mbd.buckling.BucklingIndex("rod")
    whole = index(mbd.simulate(system, 2.0, steps=10, backend="eager"))
    phases = [mbd.Phase(until=1.0), mbd.Phase()]
    assert_close(
        index(mbd.simulate(system, 2.0, steps=10, phases=phases, backend="eager")), whole, rtol=1e-6, atol=1e-9
    )
    pushed = mbd.RigidBody("block", 1.0, (1.0, 1.0, 1.0))
    body = rod()
    spring = mbd.forces.AxialSpringDamper(mbd.Ground().at(3.0, 0, 0), body.at("end"), stiffness=1.0, name="spring")
    other = mbd.System(
        [body, pushed], [mbd.Fixed(mbd.Ground().at(0, 0, 0), body.at("start"))], [spring], free=["block"]
    )
    changed = [mbd.Phase(until=0.01), mbd.Phase(laws={"spring": lambda s, rate, t: 2.0 * s})]
    with refused("phases"):
        index(mbd.simulate(other, 0.02, steps=4, phases=changed, backend="eager"))


def differences(f: Callable[[Tensor], Tensor], x: Tensor, step: float) -> Tensor:
    def central(h: float) -> Tensor:
        return torch.stack([(f(x + e) - f(x - e)) / (2.0 * h) for e in h * torch.eye(len(x), dtype=x.dtype)], -1)

    return (4.0 * central(0.5 * step) - central(step)) / 3.0


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "step"), [("angles", 4e-3), ("thickness", 1e-5)])
def test_gradients_by_torch_func_and_differences(name, step):
    system = pendulum()
    key = f"rod.laminate.{name}"
    x = dict(system.named_parameters())[key].detach().clone()
    index = mbd.buckling.BucklingIndex("rod", {"left": "all", "right": "u2 u3"})

    def f(x: Tensor, gradients: str = "auto") -> Tensor:
        options: dict[str, Any] = {
            "steps": 8,
            "iterations": (6, 6),
            "refresh": 1,
            "gradients": gradients,
            "backend": "eager",
        }
        motion = mbd.simulate(system, 0.01, designs={key: x[None]}, **options)
        return index(motion)[0, [0, 4, 8]]

    expected = differences(lambda y: f(y, "none").detach(), x, step)
    for result in (torch.func.jacrev(f)(x), torch.func.jacfwd(f)(x)):
        assert_close(result, expected, rtol=0.0, atol=1e-6 * float(expected.abs().max()))


@pytest.mark.thorough
def test_coinciding_indices_have_the_mean_of_their_derivatives():
    body = tube()
    system = loaded(body, "start", "end", (-1e3, 0.0, 0.0), 0.5)
    name = next(name for name, _ in system.named_parameters() if name.endswith("angles"))
    x = dict(system.named_parameters())[name].detach().clone()

    along = torch.tensor([1.0, 0.5], dtype=torch.float64)

    def f(s: Tensor) -> Tensor:
        motion = mbd.simulate(system, 0.5, steps=4, backend="eager", designs={name: (x + s * along)[None]})
        return torch.stack([mbd.buckling.BucklingIndex("rod", number=k)(motion)[0, -1] for k in (1, 2)])

    zero = torch.zeros(1, dtype=torch.float64)
    first, second = torch.func.jacrev(f)(zero)
    assert_close(first, second, rtol=1e-6, atol=0.0)
    with torch.no_grad():
        expected = differences(lambda s: f(s).mean()[None], zero, 1e-2)[0]
    assert_close(first, expected, rtol=1e-6, atol=0.0)


@pytest.mark.thorough
def test_lanes_backends_and_a_problem():
    system = pendulum()
    designs = {"rod.laminate.angles": torch.deg2rad(torch.tensor([[20.0, -50.0], [70.0, 15.0]], dtype=torch.float64))}
    index = mbd.buckling.BucklingIndex("rod")
    both = index(mbd.simulate(system, 0.01, steps=10, designs=designs))
    alone = [
        index(mbd.simulate(system, 0.01, steps=10, designs={k: x[i, None] for k, x in designs.items()})) for i in (0, 1)
    ]
    assert_close(both, torch.cat(alone), rtol=1e-8, atol=0.0)
    eager = index(mbd.simulate(system, 0.01, steps=10, designs=designs, backend="eager"))
    assert_close(both, eager, rtol=1e-7, atol=1e-9 * float(both.max()))
    options: dict[str, Any] = {"duration": 0.01, "steps": 10}
    problem = mbd.Problem(
        system, minimize=mbd.Max(index), subject_to=[mbd.buckling.BucklingFactor("rod") >= 1.0], **options
    )
    result = problem.evaluate(designs["rod.laminate.angles"].numpy(), gradients=True)
    for lane, evaluation in enumerate(result):
        peak = float(both[lane].max())
        assert evaluation.objective == pytest.approx(peak, rel=1e-3)
        assert evaluation.constraints == pytest.approx([1.0 - 1.0 / evaluation.objective])
        assert evaluation.constraint_gradients is not None


def test_in_experiment_files():
    supports = {"left": "all", "right": "u2 u3"}
    assert history_of({"buckling_index": {"body": "rod", "supports": supports}}) == mbd.buckling.BucklingIndex(
        "rod", supports
    )
    assert measure_of({"buckling_factor": "rod"}) == mbd.buckling.BucklingFactor("rod")


@pytest.mark.thorough
def test_what_cannot_buckle_so_is_named(tmp_path):
    body = rod()
    system = loaded(body, "start", "end", (-1.0, 0.0, 0.0), 1.0)
    cases = [
        ({"number": 0}, "number"),
        ({"supports": {"start": "u9"}}, "rod.supports.start"),
        ({"supports": {"start": (1e-3, None, None, None, None, None)}}, "supports"),
    ]
    for given, path in cases:
        with refused(path):
            mbd.buckling.BucklingIndex("rod", **given).check(system)
    with pytest.raises(mbd.InputError, match="do not hold the body"):
        mbd.buckling.BucklingIndex("rod", {"start": "u1"})(mbd.simulate(system, 0.01, steps=2, backend="eager"))
    given = mbd.FlexibleBody.from_reduced("rod", body.save_reduced(tmp_path / "rod.npz"))
    block = mbd.RigidBody("block", 1.0, (1.0, 1.0, 1.0))
    other = mbd.System([given, block], [], free=["rod", "block"])
    with refused("rod"):
        mbd.buckling.BucklingIndex("rod").check(other)
    with refused("block"):
        mbd.buckling.BucklingFactor("block").check(other)


@pytest.mark.thorough
def test_loads_that_differ_in_the_fifth_digit_are_two_cases():
    body = rod(cells=4)
    system = mbd.System([body], [mbd.Fixed(mbd.Ground().at(), body.at("start"))])
    motion = mbd.simulate(system, 1e-4, steps=2)
    loads = [torch.tensor([-force, 0.001, 0.0], dtype=torch.float64) for force in (1234.51, 1234.54)]
    assert repr(loads[0]) == repr(loads[1])
    first, second = (mbd.buckling.BucklingFactor("rod", {"end": load})(motion).item() for load in loads)
    assert first / second == pytest.approx(1234.54 / 1234.51, rel=1e-9)
