"""The warning of large displacements: of a stiffened beam beyond its buckling load, not of one below it.

The warning of spin: said of lanes that are known, silent on bodies that nothing holds. A lane that failed has the spin before.
The part of loads in the stiffness: that of Euler's load, in tension and pressure, at rest and in motion.
"""

from __future__ import annotations

import math
import warnings
from types import SimpleNamespace
from typing import Any

import pytest
import torch

import torchmbd as mbd
from tests.refused import warned
from torchmbd.diagnosis import elastic_limits, load_shares
from torchmbd.diagnosis.elastic_limits import displacement_ratios


def pushed(force: float) -> mbd.System:
    """A cantilever of Euler's load 74 N under a force at its end, along it and a little across."""
    stiffness = torch.diag(torch.tensor([2e5, 1e5, 1e5, 20.0, 30.0, 40.0], dtype=torch.float64))
    section = mbd.GivenSection(stiffness, torch.diag(torch.tensor([2.0, 2, 2, 3e-3, 1e-3, 2e-3])))
    body = mbd.FlexibleBody.beam(
        "arm", mbd.BeamLine.straight(1.0, 4), section, modes=4, reference="start", stiffening=True
    )
    push = mbd.Force(body.at("end"), (-force, 0.0, 0.01))
    return mbd.System([body], [mbd.Fixed(mbd.Ground().at(), body.at("start"))], [push], truncation=None)


@pytest.mark.thorough
def test_a_buckled_beam_is_named():
    with warned("body 'arm'", "elastic displacements"):
        motion = mbd.simulate(pushed(200.0), 0.6, steps=60, backend="eager", gradients="none")
    end = motion.body("arm").at("end").position[0, :, 2].abs().max()
    assert displacement_ratios(motion)["arm"].tolist() == [pytest.approx(0.84 * end.item(), rel=0.1)]


@pytest.mark.thorough
def test_below_the_buckling_load_nothing_is_said():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mbd.simulate(pushed(50.0), 0.6, steps=60, backend="eager", gradients="none")
        mbd.equilibrium(pushed(50.0))


@pytest.mark.thorough
def test_equilibria_under_transforms():
    system = pushed(1.0)
    K = dict(system.named_parameters())["arm.section.matrix"].detach()

    def tip(x: torch.Tensor) -> torch.Tensor:
        rest = mbd.equilibrium(system, designs={"arm.section.matrix": (K * x)[None]})
        return rest.body("arm").at("end").position[0, 0, 2]

    by = torch.func.jacfwd(tip)(torch.ones((), dtype=torch.float64))
    assert by.item() == pytest.approx(-tip(torch.ones((), dtype=torch.float64)).item(), rel=0.05)


@pytest.mark.parametrize(
    ("ratios", "said"),
    [([0.05, torch.nan, torch.inf], None), ([0.05, torch.nan, 0.3], "0.3 of its first"), ([torch.nan], None)],
)
def test_only_known_ratios_count(monkeypatch: pytest.MonkeyPatch, ratios: list[float], said: str | None) -> None:
    monkeypatch.setattr(elastic_limits, "spin_ratios", lambda motion: {"rod": torch.tensor(ratios)})
    motion = SimpleNamespace(stats={}, dynamics=SimpleNamespace(data={}))
    if said is None:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            elastic_limits.warn_of_spin(motion)  # type: ignore[arg-type]
    else:
        with pytest.warns(UserWarning, match=said):
            elastic_limits.warn_of_spin(motion)  # type: ignore[arg-type]
    assert motion.stats["spin_ratio"]["rod"].shape == (len(ratios),)


E, SIDE, LENGTH = 70e9, 0.01, 0.5
EULER = math.pi**2 * E * SIDE**4 / 12.0 / (2.0 * LENGTH) ** 2  # of a cantilever [N]
WARNED = "body 'rod': tension and pressure of its loads are {} of its stiffness"


def rod(reference: str | None, density: float = 2700.0, **more: Any) -> mbd.FlexibleBody:
    section = mbd.GivenSection.isotropic(
        E=E, nu=0.3, density=density, area=SIDE**2, Iyy=SIDE**4 / 12, Izz=SIDE**4 / 12, J=0.14 * SIDE**4
    )
    place = (0.0 if reference == "start" else 0.5 * LENGTH, 0.0, 0.0)
    line = mbd.BeamLine.straight(LENGTH, 16)
    return mbd.FlexibleBody.beam("rod", line, section, modes=6, reference=reference, position=place, **more)


def held(reference: str | None, load: float, **more: Any) -> mbd.System:
    """A clamped rod under a load along it at its other end."""
    body = rod(reference, **more)
    push = mbd.Force(body.at("end"), (load, 0.0, 0.0))
    return mbd.System([body], [mbd.Fixed(mbd.Ground().at(), body.at("start"))], [push], truncation=None)


@pytest.mark.thorough
@pytest.mark.parametrize("part", [-0.3, 0.1, 0.3])
def test_a_cantilever_has_the_share_of_its_euler_load(part):
    with pytest.warns(UserWarning, match=WARNED.format(f"{abs(part):g}")):
        rest = mbd.equilibrium(held("start", part * EULER))
    assert rest.stats["load_share"]["rod"] == pytest.approx(abs(part), rel=3e-3)  # 16 elements


@pytest.mark.thorough
def test_beside_its_middle_a_rod_turns_less():
    """Each half is a cantilever under the whole load: a quarter of the share."""
    rest = mbd.equilibrium(held(None, 0.16 * EULER))
    assert rest.stats["load_share"]["rod"] == pytest.approx(0.04, rel=2e-2)


@pytest.mark.thorough
@pytest.mark.parametrize("more", [{"stiffening": True}, {}])
def test_small_loads_and_stiffened_bodies_are_silent(more):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        mbd.equilibrium(held("start", (0.3 if more else 0.03) * EULER, **more))


def carried(acceleration: float, tip: float, reference: str = "start") -> mbd.System:
    """A rod with a mass at its end, which a drive accelerates along it: a load without spin."""
    body = rod(reference)
    foot = mbd.RigidBody("foot", 1.0, (1e-3, 1e-3, 1e-3))
    head = mbd.RigidBody("head", tip, (1e-9, 1e-9, 1e-9), position=(LENGTH, 0, 0))
    joints = [
        mbd.Prismatic(mbd.Ground().at(), foot.at(), axis="x"),
        mbd.Drive(mbd.Ground().at(), foot.at(), axis="x", position=lambda t: 0.5 * acceleration * t**2, name="push"),
        mbd.Fixed(foot.at(), body.at("start")),
        mbd.Spherical(body.at("end"), head.at()),
    ]
    return mbd.System([body, foot, head], joints, truncation=None)


@pytest.mark.thorough
def test_a_load_of_inertia_counts_along_the_motion():
    """The same system again, more slowly and faster: the share follows the loads."""
    with pytest.warns(UserWarning, match=WARNED.format("0.2")):
        motion = mbd.simulate(carried(0.2 * EULER / 20.0, 20.0), 1e-3, steps=5)
    assert motion.stats["load_share"]["rod"] == pytest.approx(0.2, rel=1e-2)


@pytest.mark.thorough
def test_loads_that_grow_are_looked_at_again():
    body = rod("start")
    load = mbd.variable(0.001 * EULER)
    push = mbd.Force(body.at("end"), (load, 0.0, 0.0), name="push")
    system = mbd.System([body], [mbd.Fixed(mbd.Ground().at(), body.at("start"))], [push], truncation=None)
    (name,) = [name for name, _ in system.named_parameters() if name.startswith("push")]
    for part in (0.001, 0.2, 0.1):
        motion = mbd.equilibrium(system, designs={name: torch.tensor([part * EULER], dtype=torch.float64)})
        assert motion.stats["load_share"]["rod"] == pytest.approx(part if part > 0.01 else 0.0, rel=1e-2)


LOADS = {"across": (0.0, 0.0, 0.35), "along": (-0.3, 0.0, 0.0), "both": (0.2, 0.0, 0.35), "small": (-0.08, 0.0, 0.0)}


@pytest.mark.parametrize("shared", ["body", "system", "batch"])
def test_a_share_does_not_depend_on_what_was_simulated_before(shared):
    """Loads of other directions, of the body in another system or of another design, leave it as it is alone."""
    body = rod("start")

    def pushed(body: mbd.FlexibleBody) -> mbd.System:
        push = mbd.Force(body.at("end"), tuple(mbd.variable(0.0) for _ in "xyz"), name="push")
        return mbd.System([body], [mbd.Fixed(mbd.Ground().at(), body.at("start"))], [push], truncation=None)

    def share(system: mbd.System, *kinds: str) -> float:
        loads = torch.tensor([LOADS[kind] for kind in kinds], dtype=torch.float64) * EULER
        names = [name for name, _ in system.named_parameters() if name.startswith("push")]
        assert len(names) == 3
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            motion = mbd.equilibrium(system, designs=dict(zip(names, loads.T, strict=True)))
        return motion.stats["load_share"]["rod"]

    alone = {kind: share(pushed(rod("start")), kind) for kind in LOADS}
    one = pushed(body)
    if shared == "batch":
        assert share(one, *LOADS) == pytest.approx(max(alone.values()), rel=1e-6)
    for kind in ("across", "along", "both", "across", "small", "along"):
        system = pushed(body) if shared == "body" else one
        assert share(system, kind) == pytest.approx(alone[kind], rel=1e-6, abs=1e-9)


class _Ramp(torch.nn.Module):
    """An angle whose rate grows for the whole motion [rad/s2], from the rate at the start [rad/s]."""

    def __init__(self, rate: float, acceleration: float):
        super().__init__()
        self.rate, self.acceleration = rate, acceleration

    def forward(self, t: torch.Tensor) -> torch.Tensor:
        return self.rate * t + 0.5 * self.acceleration * t**2


def spun(rate: float, acceleration: float, stiffening: bool = False) -> mbd.Trajectory:
    body = rod("start", stiffening=stiffening)
    hinge = [mbd.Revolute(mbd.Ground().at(), body.at("start"), axis="z")]
    drive = mbd.Drive(mbd.Ground(), body, axis="z", angle=_Ramp(rate, acceleration))
    return mbd.simulate(mbd.System([body], [*hinge, drive], truncation=None), 0.4, steps=200, backend="eager")


@pytest.mark.thorough
def test_a_spin_that_makes_a_motion_fail_is_warned_of_and_named_in_the_status():
    """A rod whose spin passes its first frequency, 210 rad/s: without stiffening it bends without bound."""
    with warned("body 'rod'", "centrifugal stiffening"):
        motion = spun(350.0, 1500.0)
    assert motion.status[0].startswith("failed: ")
    assert "likely cause: body 'rod' turns at" in motion.status[0]
    assert "stiffening=True helps" in motion.status[0]
    assert 0.1 < float(motion.stats["spin_ratio"]["rod"][0]) < 3.0  # of the drive, not of the motion that explodes
    assert spun(350.0, 1500.0, stiffening=True).status == ["ok"]


@pytest.mark.thorough
def test_a_search_warns_of_a_body_once_and_its_table_says_what_stiffening_gives(recwarn):
    """A column under half of the weight that buckles it, 7.84 EI / L^2: its share falls with its mass."""
    body = rod("start", density=mbd.variable(2700.0))
    weight = 0.5 * 7.84 / (math.pi**2 / 4.0) * EULER
    gravity = (-weight / (2700.0 * SIDE**2 * LENGTH), 0.0, 0.0)
    system = mbd.System([body], [mbd.Fixed(mbd.Ground().at(), body.at("start"))], gravity=gravity)
    problem = mbd.Problem(system, 1e-4, steps=4, minimize=mbd.Mass("rod"), bounds=(540.0, 9000.0), backend="eager")
    result = mbd.optimize(problem, "mmfd", max_iterations=4)
    assert result.analyses > 1
    loads = [str(x.message) for x in recwarn if "of its stiffness" in str(x.message)]
    assert len(loads) == 1
    [note] = [note for note in mbd.verify(result).notes if "stiffness" in note]
    assert note.startswith(
        "linear elastic displacements leave out tension and pressure of the loads of body 'rod', up to 0."
    )
    assert note.endswith("with stiffening=True they are part of it")


@pytest.mark.thorough
def test_shares_do_not_depend_on_the_parts_by_which_they_are_computed(monkeypatch):
    shares = []
    for states in (10**6, 3):
        monkeypatch.setattr(load_shares, "_STATES", states)
        system = carried(0.2 * EULER / 20.0, 20.0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            shares.append(mbd.simulate(system, 1e-3, steps=7, backend="eager").stats["load_share"])
    assert shares[1] == pytest.approx(shares[0], rel=1e-12)
    assert shares[0]["rod"] > 0.1


def test_a_state_that_is_unknown_does_not_hide_the_loads_after_it() -> None:
    """Means over two intervals of loads of size 1, 1, ?, 1, 1, 9, 9, 9."""
    loads = torch.zeros(3, 1, 1, 8, dtype=torch.float64)
    for unknown in (math.nan, math.inf):
        loads[0, 0, 0] = torch.tensor([1.0, 1.0, unknown, 1.0, 1.0, 9.0, 9.0, 9.0])
        one = torch.ones(1, 1, 1, dtype=torch.float64)
        [[largest]] = load_shares._largest_loads([(loads, one)], [2], torch.ones(1, 1))[0].tolist()
        assert largest == pytest.approx(9.0)


@pytest.mark.parametrize(("built", "design"), [(0.02, None), (1e-5, None), (1e-5, 0.02), (0.02, 1e-5)])
def test_damping_above_the_critical_one_is_told(built, design):
    """A ratio of 0.02 that is given as a time of 0.02 s, in the body or by the design."""
    laminate = mbd.Laminate(mbd.Ply.isotropic(70e9, 0.3, 2700.0), [0.0], 2e-3)
    mesh = mbd.mesh.rectangle(0.2, 0.05, (4, 1))
    damping = mbd.variable(built)
    body = mbd.FlexibleBody.plate("strip", mesh, laminate, modes=2, reference="left_edge", damping=damping)
    system = mbd.System([body], [mbd.Fixed(mbd.Ground().at(), body.at("left_edge"))], gravity=(0.0, 0.0, -9.81))
    shape = system.get_parameter("strip.damping.time").shape
    designs = {} if design is None else {"strip.damping.time": torch.full((1, *shape), design, dtype=torch.float64)}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        mbd.simulate(system, 0.001, steps=20, designs=designs, backend="eager", gradients="none")
    words = [str(x.message) for x in caught if "'strip'" in str(x.message) and "ratio" in str(x.message)]
    assert len(words) == ((design or built) == 0.02)
