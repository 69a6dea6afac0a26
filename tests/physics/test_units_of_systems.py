"""Whole systems are the same in other units, at another place, in another direction, with other names and in another order.

A `World` states a system of units, and where the whole system stands: it makes all numbers of a model, and turns results back
into SI units at the origin. Every number with a unit goes through it. Bounds are relative to the largest number of a quantity.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import INERTIA, SOFT, tensor, turned
from tests.units import Units

EYE = torch.eye(3, dtype=torch.float64)
USUAL = ("units of ", "radius of gyration")  # begins of warnings of numbers that are unusual in SI units


@dataclass(frozen=True)
class World:
    """Units, a rotation of the whole system, and then its displacement [m]."""

    units: Units = field(default_factory=Units)
    turn: Tensor = field(default_factory=lambda: EYE)
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    reverse: bool = False  # lists of bodies, joints and forces
    prefix: str = ""  # of names

    def __call__(self, x: Any, length: float = 0.0, mass: float = 0.0, time: float = 0.0) -> Any:
        """SI numbers in these units."""
        return self.units(x, length, mass, time)

    def name(self, name: str) -> str:
        return self.prefix + name

    def point(self, *x: float) -> list[float]:
        """A point of the ground in these units, from its SI numbers."""
        return self(self.turn @ tensor(*x) + tensor(*self.place), 1)

    def vector(self, x: Sequence[float], length: float = 0.0, mass: float = 0.0, time: float = 0.0) -> list[float]:
        """A vector in ground axes and these units, from its SI numbers."""
        return self(self.turn @ tensor(*x), length, mass, time)

    def ground(self, *x: float, axes: Tensor = EYE) -> mbd.Frame:
        return mbd.Ground().at(*self.point(*x), axes=self.turn @ axes)

    def at(self, body: Any, *x: float, axes: Tensor | None = None) -> mbd.Frame:
        return body.at(*self(tensor(*x), 1), axes=axes)

    def box(
        self, name: str, position: Sequence[float], axes: Tensor = EYE, mass: float = 0.7, **rates: Any
    ) -> mbd.RigidBody:
        """With products of inertia and an eccentric center."""
        if "velocity" in rates:
            rates["velocity"] = self.vector(rates["velocity"], 1, 0, -1)
        if "angular_velocity" in rates:  # in axes of the body
            rates["angular_velocity"] = self(tensor(*rates["angular_velocity"]), 0, 0, -1)
        return mbd.RigidBody(
            self.name(name),
            self(mass, 0, 1),
            self(mass / 0.7 * INERTIA, 2, 1),
            center=self((0.03, -0.02, 0.04), 1),
            position=self.point(*position),
            axes=self.turn @ axes,
            **rates,
        )

    def plate(self, name: str, position: Sequence[float], axes: Tensor = EYE, **options: Any) -> mbd.FlexibleBody:
        """A soft laminated plate of 0.3 m x 0.1 m, whose two ply angles vary."""
        ply = {key: self(x, -1, 1, -2) for key, x in SOFT.items()} | {
            "nu12": SOFT["nu12"],
            "density": self(1586.0, -3, 1),
        }
        laminate = mbd.Laminate(mbd.Ply(**ply), mbd.deg([20.0, -50.0]), thickness=self(1.5e-3, 1))
        mesh = mbd.mesh.rectangle(self(0.3, 1), self(0.1, 1), (4, 2))
        options = {"modes": 2, "damping": self(1e-3, 0, 0, 1)} | options
        return mbd.FlexibleBody.plate(
            self.name(name), mesh, laminate, position=self.point(*position), axes=self.turn @ axes, **options
        )

    def system(self, bodies: list, joints: list, forces: Sequence = (), **options: Any) -> mbd.System:
        step = -1 if self.reverse else 1
        gravity = self.vector((1.5, -9.0, 3.5), 1, 0, -2)
        stabilization = self(5e-3, 0, 0, 1)  # the default
        return mbd.System(
            bodies[::step],
            joints[::step],
            list(forces)[::step],
            gravity=gravity,
            stabilization=stabilization,
            **options,
        )

    def back(self, x: Tensor) -> Tensor:
        """Positions [..., 3] in SI units at the origin."""
        return (x / self.units.length - tensor(*self.place)) @ self.turn


def mechanism(w: World, gap: float = 0.0) -> mbd.System:
    """A drive, a rack, a screw and a gear; a laminated plate on a turned hinge; springs, a damper and a bushing.

    gap   by which joints are open where the bodies were put [m]; [rad] by turns
    """
    tilt, swing = turned(0.2, 0.5, -0.4), turned(-0.5, 0.2, 0.9)
    crank = w.box("crank", (0.1, 0.05, -0.02), turned(0.4, -0.7, 0.3))
    wheel = w.box("wheel", (0.3 + gap, 0.4, 0.1), tilt)
    slider = w.box("slider", (-0.2, 0.3, 0.2 - gap), swing @ turned(0.0, gap, 0.0))
    nut = w.box("nut", (0.5, -0.3, 0.4), tilt)
    arm = w.box("arm", (-0.4, 0.1, 0.1 + gap), swing)
    tip = tensor(-0.4, 0.1, 0.1) + swing @ tensor(0.2, 0.1, -0.05)
    sheet = w.plate("sheet", (tip + swing @ tensor(0.15, gap, 0.0)).tolist(), swing)
    name = w.name
    hinge = mbd.Revolute(w.ground(0.1, 0.05, -0.02, axes=tilt), crank.at(), "x", name("hinge"))
    axle = mbd.Revolute(w.ground(0.3, 0.4, 0.1, axes=tilt), wheel.at(), "z", name("axle"))
    slide = mbd.Prismatic(w.ground(-0.2, 0.3, 0.2, axes=swing), slider.at(), "y", name("slide"))
    guide = mbd.Cylindrical(w.ground(0.5, -0.3, 0.4, axes=tilt), nut.at(), "x", name("guide"))
    joints = [
        hinge,
        axle,
        slide,
        guide,
        mbd.Spherical(w.ground(-0.4, 0.1, 0.1), arm.at(), name("ball")),
        mbd.Revolute(w.at(arm, 0.2, 0.1, -0.05), sheet.at("left"), "y", name("leaf")),
        mbd.JointCoupling([hinge.angle, axle.angle], [1.0, 2.0], name=name("gear")),
        mbd.JointCoupling([axle.angle, slide.travel], [w(0.05, 1), 1.0], name=name("rack")),
        mbd.JointCoupling([guide.angle, guide.travel], [w(0.01, 1), -1.0], name=name("screw")),
    ]
    forces = [
        mbd.SpringDamper(
            w.at(crank, 0.1, 0.0, 0.05),
            w.ground(0.5, 0.2, 0.1),
            stiffness=mbd.variable(w(40.0, 0, 1, -2)),
            damping=w(0.3, 0, 1, -1),
            rest=w(0.2, 1),
            name=name("spring"),
        ),
        mbd.SpringDamper(
            w.at(nut, 0.0, 0.1, 0.0),
            w.ground(0.5, 0.3, 0.1),
            w(500.0, 0, 1, -2),
            w(2.0, 0, 1, -1),
            w(0.3, 1),
            name=name("pull"),
        ),
        mbd.Bushing(
            w.ground(0.1, 0.2, 0.3),
            w.at(arm, 0.05, 0.02, 0.01),
            stiffness=w((300.0, 200.0, 500.0), 0, 1, -2),
            damping=w(1.0, 0, 1, -1),
            turning_stiffness=w((4.0, 2.0, 3.0), 2, 1, -2),
            name=name("mount"),
        ),
        mbd.SpringDamper(
            w.ground(-0.2, 0.5, 0.4), sheet.at("right"), w(20.0, 0, 1, -2), 0.0, w(0.2, 1), name=name("thread")
        ),
    ]
    return w.system([crank, wheel, slider, nut, arm, sheet], joints, forces)


PARTS = ("crank", "wheel", "slider", "nut", "arm", "sheet")
SPRING, ANGLES = "spring.stiffness", "sheet.laminate.angles"


@dataclass(frozen=True)
class Facts:
    """Results that must not depend on the world: numbers in SI units at the origin, counts, statuses and warnings.

    derived   derivatives and reactions, in which errors of steps count more
    """

    values: dict[str, Tensor]
    derived: dict[str, Tensor]
    said: dict[str, Any]


def said(w: World, caught: Sequence[warnings.WarningMessage]) -> list[str]:
    """Begins of warnings, up to the first number, but those of unusual numbers and of other packages."""
    texts = [str(x.message).replace(w.prefix, "") if w.prefix else str(x.message) for x in caught]
    return sorted(re.split(r"\d", x)[0] for x in texts if not x.startswith(USUAL) and "torch.jit" not in x)


def motion_facts(w: World, build: Callable[[World], mbd.System], duration: float = 0.02, **options: Any) -> Facts:
    """Those of a motion, of `describe` and of the derivatives of two responses."""
    u = w.units
    energy = u.factor(2, 1, -2)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        system = build(w)
        described = system.describe()
        designs = {
            name: system.get_parameter(w.name(name)).detach()[None].requires_grad_() for name in (SPRING, ANGLES)
        }
        T = w(duration, 0, 0, 1)
        by_name = {w.name(name): x for name, x in designs.items()}
        motion = mbd.simulate(system, T, steps=10, designs=by_name, **options)
    sheet = motion.body(w.name("sheet"))
    responses = {
        "mean strain energy": mbd.Mean(mbd.StrainEnergy(w.name("sheet")))(motion)[0] / energy,
        "angle": mbd.Final(mbd.Angle(w.name("crank"), "x", seen_from=w.name("arm")))(motion)[0],
    }
    derived = {
        f"{response} by {name}": torch.autograd.grad(x, designs[name], retain_graph=True, materialize_grads=True)[0]
        * (u.factor(0, 1, -2) if name == SPRING else 1.0)
        for response, x in responses.items()
        for name in designs
    }
    derived |= {
        "force in leaf": motion.reaction(w.name("leaf")).force[0] / u.factor(1, 1, -2),
        "torque in guide": motion.reaction(w.name("guide")).torque[0] / energy,
    }
    values = {f"place of {name}": w.back(motion.body(w.name(name)).r[0]) for name in PARTS}
    values |= responses | {
        "strain energy": sheet.strain_energy / energy,
        "kinetic energy": motion.energies.kinetic / energy,
        "frequencies": tensor(*described.frequencies) * u.time,
        "gaps": tensor(*(x.distance for x in sorted(described.closing.joints, key=lambda x: x.name))) / u.length,
    }
    d = described
    counts = (d.rows, d.rank, d.freedoms, d.mobility, len(d.redundant), d.closing.far)
    return Facts(
        {k: x.detach() for k, x in values.items()},
        {k: x.detach() for k, x in derived.items()},
        {"status": motion.status, "counts": counts, "warnings": said(w, caught)},
    )


def check(result: Facts, expected: Facts, of_values: float = 1e-9, of_derived: float = 1e-8) -> None:
    """Equal but for shares of the largest number of a quantity."""
    assert result.said == expected.said
    for actual, numbers, share in (
        (result.values, expected.values, of_values),
        (result.derived, expected.derived, of_derived),
    ):
        for name, x in numbers.items():
            size = float(x[x.isfinite()].abs().max()) if x.numel() else 0.0
            atol = share * size
            assert_close(actual[name], x, rtol=0.0, atol=atol, equal_nan=True, msg=lambda m, n=name: f"{n}: {m}")


WORLDS = {
    "mm, t, s": World(Units(1e3, 1e-3)),
    "km, g, ms": World(Units(1e-3, 1e3, 1e3)),
    "um, ug, ms": World(Units(1e6, 1e9, 1e3)),
    "100 km, 1000 t, s": World(Units(1e-5, 1e-6, 1.0)),
    "elsewhere": World(turn=turned(0.7, -1.3, 2.0), place=(60.0, -70.0, 40.0)),
    "elsewhere in mm": World(Units(1e3, 1e-3), turned(0.7, -1.3, 2.0), (60.0, -70.0, 40.0)),
    "other order and names": World(reverse=True, prefix="z_"),
}


@cache
def expected_facts(gap: float) -> Facts:
    return motion_facts(World(), partial(mechanism, gap=gap))


THOROUGH = pytest.mark.thorough
SOME = ("mm, t, s", "elsewhere")  # worlds of tests that are not thorough
ALL = [pytest.param(name, marks=() if name in SOME else THOROUGH) for name in WORLDS]


@pytest.mark.parametrize("world", ALL)
def test_a_motion_is_the_same_in_any_world(world: str) -> None:
    check(motion_facts(WORLDS[world], mechanism), expected_facts(0.0))


@pytest.mark.parametrize(
    ("world", "gap"),
    [("mm, t, s", 3e-3), *(pytest.param(name, 3e-3, marks=THOROUGH) for name in WORLDS if name != "mm, t, s")]
    + [pytest.param(name, 2e-4, marks=THOROUGH) for name in ("mm, t, s", "um, ug, ms")],
)
def test_joints_that_are_open_close_in_the_same_way(world: str, gap: float) -> None:
    """By rounded positions, or by a mistake that gets a warning."""
    check(motion_facts(WORLDS[world], partial(mechanism, gap=gap)), expected_facts(gap))


@THOROUGH
@pytest.mark.filterwarnings("ignore::UserWarning")  # of what the model leaves out, and of open joints
def test_a_design_is_the_same_alone_and_in_a_batch() -> None:
    """Motion and gradients, from joints that are open."""
    system = mechanism(World(), gap=3e-3)
    angles = mbd.deg([[20.0, -50.0], [35.0, -10.0], [80.0, 5.0]])
    stiffness = tensor(40.0, 60.0, 20.0)
    results = []
    for lanes in ([0, 1, 2], [1]):
        designs = {SPRING: stiffness[lanes].requires_grad_(), ANGLES: angles[lanes].requires_grad_()}
        motion = mbd.simulate(system, 0.02, steps=10, designs=designs)
        value = mbd.Mean(mbd.StrainEnergy("sheet"))(motion) + mbd.Final(mbd.Position("crank", "x"))(motion)
        value.sum().backward()
        lane = lanes.index(1)
        of_lane = [motion.q[lane], motion.lam[lane], *(designs[name].grad[lane] for name in (SPRING, ANGLES))]
        results.append([x.detach() for x in of_lane])
    for x, y in zip(*results, strict=True):
        assert_close(x, y, rtol=0.0, atol=1e-9 * float(y.abs().max()))


def door(w: World) -> Facts:
    """Reactions of two hinges, of which one would do: the choice of least norm."""
    tilt, place = turned(0.2, 0.5, -0.4), tensor(0.3, 0.1, 0.2)
    leaf = w.box("leaf", place.tolist(), tilt)
    joints = [
        mbd.Revolute(w.ground(*(place + tilt @ tensor(*x)).tolist(), axes=tilt), w.at(leaf, *x), "z", name=w.name(name))
        for name, x in {"low": (-0.2, 0.0, -0.3), "high": (-0.2, 0.0, 0.4)}.items()
    ]
    system = w.system([leaf], joints)
    motion = mbd.simulate(system, w(0.1, 0, 0, 1), steps=10, gradients="none")
    values = {}
    for name in ("low", "high"):
        with pytest.warns(UserWarning, match="over-constraint"):
            reaction = motion.reaction(w.name(name))
        values[f"force in {name}"] = reaction.force[0] / w.units.factor(1, 1, -2)
        values[f"torque in {name}"] = reaction.torque[0] / w.units.factor(2, 1, -2)
    described = system.describe()
    return Facts(values, {}, {"status": motion.status, "rank": described.rank, "redundant": len(described.redundant)})


def hooked(w: World, time: float) -> Facts:
    """A block slides from its hook, which acts again after a time: it may have moved by a millionth of the size."""
    base, block = w.box("base", (0.0, 0.0, 0.0)), w.box("block", (0.3, 0.2, 0.1))
    at = w.at(base, 0.3, 0.2, 0.1)
    joints = [
        mbd.Fixed(w.ground(0.0, 0.0, 0.0), base.at(), w.name("mount")),
        mbd.Prismatic(at, block.at(), "x", w.name("slide")),
        mbd.Fixed(at, block.at(), w.name("hook")),
    ]
    begin, end = (w(t, 0, 0, 1) for t in (0.01, 0.01 + time))
    phases = [mbd.Phase(until=begin), mbd.Phase(until=end, release=[w.name("hook")]), mbd.Phase()]
    system, duration = w.system([base, block], joints), w(0.03, 0, 0, 1)
    motion = mbd.simulate(system, duration, steps=30, phases=phases, gradients="none")
    return Facts({}, {}, {"fails": [status.startswith("failed") for status in motion.status]})


def latched(w: World, impact: float | None = None) -> Facts:
    """An elbow that is locked by an event, and then is free again; with an impact it is locked a little later."""
    arm, fore = w.box("arm", (0.0, 0.0, 0.0)), w.box("fore", (0.3, 0.0, 0.0))
    joints = [
        mbd.Revolute(w.ground(0.0, 0.0, 0.0), arm.at(), "z", w.name("shoulder")),
        mbd.Revolute(w.at(arm, 0.3, 0.0, 0.0), fore.at(), "z", w.name("elbow")),
    ]
    spring = mbd.SpringDamper(
        w.ground(0.2, 0.5, 0.1),
        w.at(fore, 0.1, 0.0, 0.0),
        stiffness=mbd.variable(w(40.0, 0, 1, -2)),
        damping=w(0.3, 0, 1, -1),
        rest=w(0.2, 1),
        name=w.name("spring"),
    )
    system = w.system([arm, fore], joints, [spring])
    angle = mbd.Angle(w.name("fore"), "z", seen_from=w.name("arm"))
    phases = [
        mbd.Phase(until=mbd.Event(angle + 0.1, "falling"), impact=impact),
        *([] if impact is None else [mbd.Phase(until=w(0.37, 0, 0, 1))]),
        mbd.Phase(until=w(0.39, 0, 0, 1), lock=[w.name("elbow")]),
        mbd.Phase(),
    ]
    k = system.get_parameter(w.name(SPRING)).detach()[None].requires_grad_()
    motion = mbd.simulate(system, w(0.42, 0, 0, 1), steps=60, designs={w.name(SPRING): k}, phases=phases)
    time = motion.switches[0].t / w.units.time
    responses = {"time": time.sum(), "angle": mbd.Final(angle)(motion)[0]}
    slopes = {
        f"{name} by stiffness": torch.autograd.grad(x, k, retain_graph=True)[0].detach() * w.units.factor(0, 1, -2)
        for name, x in responses.items()
    }
    place = w.back(motion.body(w.name("fore")).r[0])
    return Facts({"time": time.detach(), "place": place.detach()}, slopes, {"status": motion.status})


def boom(w: World) -> Facts:
    """An exact beam that is put beside its joints, between a crank and a plane."""
    section = mbd.GivenSection.isotropic(
        E=w(7e7, -1, 1, -2),
        nu=0.3,
        density=w(2700.0, -3, 1),
        area=w(1e-4, 2),
        Iyy=w(1e-9, 4),
        Izz=w(2e-9, 4),
        J=w(2e-9, 4),
    )
    crank, line = w.box("crank", (0.0, 0.0, 0.0)), mbd.BeamLine.straight(w(1.0, 1), 4)
    beam = mbd.FlexibleBeam(w.name("boom"), line, section, position=w.point(0.201, 0.002, 0.0), axes=w.turn)
    joints = [
        mbd.Revolute(w.ground(0.0, 0.0, 0.0), crank.at(), "z", w.name("hinge")),
        mbd.Revolute(w.at(crank, 0.2, 0.0, 0.0), beam.at("start"), "z", w.name("pin")),
        mbd.PointOnPlane(w.ground(1.2, 0.0, 0.0), beam.at("end"), normal="y", name=w.name("tip")),
    ]
    system = w.system([crank, beam], joints)
    motion = mbd.simulate(system, w(0.02, 0, 0, 1), steps=10, gradients="none")
    nodes, energy = w.back(motion.body(w.name("boom")).nodes[0]), motion.energies.strain / w.units.factor(2, 1, -2)
    said = {"status": motion.status, "freedoms": system.describe().freedoms}
    return Facts({"nodes": nodes, "strain energy": energy}, {}, said)


def bounce(w: World) -> Facts:
    """A ball falls on a rough floor."""
    ball = w.box("ball", (0.0, 0.0, 0.12), velocity=(0.5, 0.2, -1.0), angular_velocity=(1.0, 2.0, 3.0))
    stiffness, speed = w(1e4, 0, 1, -2), w(0.01, 1, 0, -1)
    floor = mbd.PlaneContact(
        w.ground(0.0, 0.0, 0.0), ball.at(), "z", w(0.1, 1), stiffness, friction=0.3, speed=speed, name=w.name("floor")
    )
    system = w.system([ball], [], [floor], free=[w.name("ball")])
    motion = mbd.simulate(system, w(0.05, 0, 0, 1), steps=100, gradients="none")
    return Facts({"place": w.back(motion.body(w.name("ball")).r[0])}, {}, {"status": motion.status})


def beside(w: World) -> Facts:
    """A body turns about a point that is 10 um from its origin: its rates are not constant in the axes of the body."""
    top = w.box("top", (0.0, 0.0, 0.0))
    joints = [mbd.Spherical(w.ground(1e-5, 0.0, 0.0), w.at(top, 1e-5, 0.0, 0.0), name=w.name("ball"))]
    system = w.system([top], joints)
    motion = mbd.simulate(system, w(0.3, 0, 0, 1), steps=20, gradients="none")
    ways = w.back(motion.body(w.name("top")).r[0])
    return Facts({"ways": ways}, {}, {"status": motion.status})


OTHERS: dict[str, Callable[[World], Facts]] = {
    "reactions of redundant joints": door,
    "hook that meets": partial(hooked, time=4e-4),
    "hook that misses": partial(hooked, time=1e-3),
    "latch": latched,
    "latch with an impact": partial(latched, impact=0.6),
    "beam": boom,
    "contact": bounce,
    "hinge beside the origin": beside,
}
QUICK = ("reactions of redundant joints", "hook that meets", "hook that misses")
IN_SI = cache(lambda name: OTHERS[name](World()))


@pytest.mark.filterwarnings("ignore::UserWarning")  # of unusual units
@pytest.mark.parametrize(
    ("name", "world"),
    [
        pytest.param(name, world, marks=() if name in QUICK and world == "mm, t, s" else THOROUGH)
        for name in OTHERS
        for world in WORLDS
    ],
)
def test_other_systems_are_the_same_in_any_world(name: str, world: str) -> None:
    check(OTHERS[name](WORLDS[world]), IN_SI(name), of_values=1e-8)


def test_both_hooks_are_told_apart() -> None:
    assert [IN_SI(f"hook that {name}").said["fails"] for name in ("meets", "misses")] == [[False], [True]]
