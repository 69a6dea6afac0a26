"""The contract of responses, over the registry: every history and every measure has the gradient of its value.

On real motions with their neighbors as lanes: spatial, unbalanced lay-ups, windows that end between samples.
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import GRAVITY, SOFT, pendulum
from tests.refused import refused
from torchmbd.design import COMBINATORS, OF_DESIGN, RESPONSES, History, Measure, WeightedSum, history, measure
from torchmbd.design.aggregate import Aggregate
from torchmbd.design.angle import Angle
from torchmbd.design.constraint_rows import AtPeaks, AtTimes
from torchmbd.design.histories import (
    Acceleration,
    Displacement,
    Position,
    Reaction,
    RelativeDisplacement,
    StrainEnergy,
    Velocity,
)
from torchmbd.design.measures import (
    RMS,
    AtTime,
    Final,
    Frequency,
    Integral,
    Mass,
    Max,
    Mean,
    MeanFrequency,
    Min,
    SmoothMax,
)
from torchmbd.design.ply_failure import PlyFailure, PlyStress
from torchmbd.fem.materials import Strength
from torchmbd.integrate import Trajectory
from torchmbd.math.variable import LayerNumbers

DURATION, STEPS = 0.04, 30
WEIGHTS = {-3: -1.0, -2: 9.0, -1: -45.0, 1: 45.0, 2: -9.0, 3: 1.0}
JOINT = "universal_arm_rod"


@history
def reach(motion):
    """A response of one's own."""
    return motion.body("rod").at("right").position.norm(dim=-1)


@measure
def angle_weighted_mass(motion):
    """A measure of one's own: depends on motion and design."""
    return motion.body("rod").mass * motion.body("rod").w[:, -1].square().sum(-1)


HISTORIES: dict[str, list[History]] = {
    "strain_energy": [StrainEnergy("rod")],
    "position": [
        Position("rod", "x", node="right"),
        Position("rod", (1.0, 2.0, -2.0), node=0, seen_from="arm"),
        Position("rod", "y", seen_from="arm", axes="ground"),
        Position("rod", "x", node="right", seen_from="rod"),
    ],
    "displacement": [
        Displacement("rod", "z", node="right"),
        Displacement("rod", "y", node="right", axes="arm"),
        Displacement("rod", "z", node=0, seen_from="ground"),
        Displacement("arm", "x", point=(0.2, 0.1, -0.05), axes="rod"),
    ],
    "velocity": [
        Velocity("rod", "x", node="right"),
        Velocity("rod", "z", node=0, seen_from="rod"),
        Velocity("rod", "y", node=0, seen_from="arm", axes="rod"),
        Velocity("arm", "z", point=(0.2, 0.1, -0.05)),
    ],
    "acceleration": [
        Acceleration("rod", "y", node="right"),
        Acceleration("rod", "z", node=0, seen_from="rod", axes="ground"),
        Acceleration("rod", "x", node=0, seen_from="arm"),
    ],
    "relative_displacement": [
        RelativeDisplacement("rod", 0, "right", "z"),
        RelativeDisplacement("rod", "left", "right", (0.0, 1.0, 1.0), axes="ground"),
    ],
    "reaction": [
        Reaction(JOINT, "x"),
        Reaction(JOINT, "z", on="arm", axes="rod"),
        Reaction(JOINT, (1.0, 1.0, 0.0), kind="torque"),
    ],
    "angle": [
        Angle("rod", "x"),
        Angle("rod", (0.2, 1.0, -0.3), seen_from="arm"),
        Angle("arm", "z", seen_from="rod", center=3.0),
    ],
    "ply_failure": [PlyFailure("rod"), PlyFailure("rod", "max_stress"), PlyFailure("rod", "puck")],
    "ply_stress": [PlyStress("rod", "11", layer=1), PlyStress("rod", "12", layer=1, extreme="lowest")],
}
ENERGY, LAG = StrainEnergy("rod"), Displacement("rod", "z", node="right")
MEASURES: dict[str, list[Measure]] = {
    "integral": [Integral(ENERGY), Integral(LAG**2, window=(0.0113, 0.0307))],
    "mean": [Mean(LAG), Mean(ENERGY, window=(0.0, 0.0305))],
    "rms": [RMS(LAG), RMS(ENERGY - 0.3 * ENERGY, window=(0.0107, 0.04))],
    "max": [Max(ENERGY), Max(LAG), Max(ENERGY, window=(0.0113, 0.0197))],
    "min": [Min(Position("rod", "z", node=0)), Min(-ENERGY, window=(0.0113, 0.0305))],
    "smooth_max": [SmoothMax(ENERGY, sharpness=20.0, scale=1e-4), SmoothMax(LAG, window=(0.0, 0.0303), scale=1e-4)],
    "at_time": [AtTime(ENERGY, 0.0123), AtTime(LAG, 0.04)],
    "final": [Final(LAG), Final(ENERGY, window=(0.0, 0.0227))],
    "at_times": [AtTimes(ENERGY, count=7), AtTimes(LAG, times=(0.0101, 0.02, 0.04))],
    "at_peaks": [AtPeaks(ENERGY, count=3), AtPeaks(LAG, window=(0.0051, 0.0303), count=2)],
    "frequency": [Frequency("rod"), Frequency("rod", 2), Frequency("rod", 1, {"left_edge": "all", "right_edge": "u3"})],
    "mean_frequency": [
        MeanFrequency("rod", (1, 2)),
        MeanFrequency("rod", (2,), power=-3.0),
        MeanFrequency("rod", (1, 3), supports={}),
    ],
    "mass": [Mass("rod"), Mass()],
}
OTHERS = [
    Max(reach),
    Aggregate([AtTimes(ENERGY, count=5), Max(ENERGY)], sharpness=20.0, scale=1e-4),
    Aggregate(AtPeaks(ENERGY, count=2), "p_norm", 6.0),
    angle_weighted_mass,
    0.3 * Max(ENERGY) - Integral(ENERGY) * 2.0 + -Min(LAG),
    WeightedSum([(0.6, Integral(ENERGY)), (0.4, RMS(LAG))], normalize=(1e-6, 1e-4)),
]
if "buckling" in mbd.__all__:  # the extension is there
    HISTORIES["buckling_index"] = [mbd.buckling.BucklingIndex("rod")]
    MEASURES["buckling_factor"] = [
        mbd.buckling.BucklingFactor("rod", {"right": (-1.0, 0.2, 0.0)}, number=2),
        mbd.buckling.BucklingFactor("rod"),
        mbd.buckling.BucklingFactor("rod", {}, {"left": "all", "right": (-1e-4, None, 0.0, None, None, None)}),
    ]
if "fatigue" in mbd.__all__:  # the extension fatigue is there
    CURVE = mbd.fatigue.SNCurve([(1e2, 2e4), (1e4, 8e3), (1e7, 1e3)], tension=4e4, compression=2.5e5)
    MEASURES |= {
        "equivalent_load": [
            mbd.fatigue.EquivalentLoad(LAG, exponent=4.0),
            mbd.fatigue.EquivalentLoad(ENERGY, (0.0051, 0.0303), 3.0, 2.0),
        ],
        "fatigue_damage": [
            mbd.fatigue.FatigueDamage("rod", {"22": 3}),
            mbd.fatigue.FatigueDamage("rod", curves={"22": CURVE}, repeats=1e3),
        ],
    }
    OTHERS.append(mbd.fatigue.Damage(PlyStress("rod", "11", layer=1), curve=CURVE))


def strong_pendulum() -> mbd.System:
    """The pendulum with a strength given to its plies."""
    strength = Strength(Xt=1.5e6, Xc=1.2e6, Yt=4e4, Yc=2.5e5, S12=7e4, S13=6e4, S23=5e4)
    system = pendulum()
    result = system.body("rod").laminate
    result._plies = LayerNumbers(result, "ply", (mbd.Ply(**SOFT, strength=strength),) * 2)
    return system


def cases(table: dict) -> list:
    return [pytest.param(x, id=f"{name}{i}") for name, given in table.items() for i, x in enumerate(given)]


@pytest.fixture(scope="module", params=["angles", "thickness"])
def motions(request, native) -> tuple[Trajectory, Trajectory]:
    """Two designs with gradients, and their neighbors as lanes; by angles, or by thicknesses (which change the mass)."""
    name = f"rod.laminate.{request.param}"
    system, options = strong_pendulum(), {"steps": STEPS, "iterations": (6, 6), "refresh": 1, "backend": "native"}
    designs, step = torch.deg2rad(torch.tensor([[20.0, -50.0], [70.0, 15.0]], dtype=torch.float64)), 2e-2
    if request.param == "thickness":
        designs, step = torch.tensor([[1.5e-3, 1.2e-3], [1.1e-3, 2.0e-3]], dtype=torch.float64), 1.5e-5
    shifts = torch.cat([k * step * torch.eye(2, dtype=torch.float64) for k in WEIGHTS])
    neighbors = (designs[:, None] + shifts).flatten(0, 1)
    exact, shifted = (
        mbd.simulate(system, DURATION, gradients=way, variables=[name], designs={name: x}, **options).require_ok()
        for way, x in (("forward", designs), ("none", neighbors))
    )
    shifted.stats["difference"] = step
    exact.stats["reverse"] = mbd.simulate(
        system, DURATION, gradients="reverse", variables=[name], designs={name: designs}, **options
    )
    return exact, shifted


def difference(x: Tensor, step: float) -> Tensor:
    """[2 lanes x 6 shifts x 2 variables, ...] -> slopes [2 lanes, ..., 2 variables].

    Of sixth order: accelerations and reactions carry the rounding of a motion divided by the square of its time step,
    which only differences over wide steps bear.
    """
    shifted = x.unflatten(0, (2, len(WEIGHTS), 2)).unbind(1)
    total = torch.stack([w * y for w, y in zip(WEIGHTS.values(), shifted, strict=True)]).sum(0)
    return (total / (60.0 * step)).movedim(1, -1)


#: Of bodies that the pendulum does not have: tests/extensions/fibers/test_variables.py, test_measures.py,
#: tests/extensions/lamination/test_region.py; of the whole system at rest or in rotation, which the pendulum is not:
#: tests/extensions/vibrations/measures/test_system_vibrations.py, test_critical_values.py, test_frequency_response.py.
OF_SYSTEM = [
    "system_frequency",
    "damping_ratio",
    "stability_margin",
    "campbell_clearance",
    "critical_speed",
    "stability_limit",
]
ELSEWHERE = {
    name: OF_DESIGN[name]
    for name in ("fiber_curvature", "fiber_divergence", "lamination_region", *OF_SYSTEM, "frequency_response")
    if name in OF_DESIGN
}


def test_every_registered_response_is_in_this_contract():
    assert {name: type(given[0]) for name, given in HISTORIES.items()} == RESPONSES
    assert ELSEWHERE | {name: type(given[0]) for name, given in MEASURES.items()} == {**COMBINATORS, **OF_DESIGN}


@pytest.mark.thorough("angles-buckling_index0", "thickness-buckling_index0")
@pytest.mark.parametrize("response", [*cases(HISTORIES), reach])
def test_gradient_of_a_history_against_differences(response, motions):
    response.check(motions[0].system)
    value, gradient = response.series(motions[0])
    assert value.shape == (2, STEPS + 1)
    assert gradient.shape == (2, STEPS + 1, 2)
    expected = difference(response.values(motions[1]), motions[1].stats["difference"])
    assert float(expected.abs().max()) > 0
    assert_close(gradient, expected, rtol=0, atol=1e-5 * float(expected.abs().max()))
    assert response.series(motions[1]).gradient is None


@pytest.mark.thorough("angles-buckling_factor1", "thickness-buckling_factor1")
@pytest.mark.parametrize("response", [*cases(MEASURES), *OTHERS])
def test_gradient_of_a_measure_against_differences(response, motions):
    response.check(motions[0].system)
    value, gradient = response.value_and_gradient(motions[0])
    rows = () if response.rows == 1 and value.dim() == 1 else (response.rows,)
    assert value.shape == (2, *rows)
    assert gradient.shape == (2, *rows, 2)
    assert_close(value, response.value(motions[0]), rtol=0, atol=0)
    expected = difference(response.value(motions[1]), motions[1].stats["difference"])
    rounding = 1e-13 * float(value.abs().max()) / motions[1].stats["difference"]
    assert_close(gradient, expected, rtol=0, atol=1e-5 * float(expected.abs().max()) + rounding)
    assert response.of(motions[1]).gradient is None
    with refused("motion"):
        response.value_and_gradient(motions[1])


@pytest.mark.parametrize("response", [*cases(MEASURES), *OTHERS, *cases(HISTORIES)])
def test_the_adjoint_gives_the_same_gradient(response, motions):
    """By the adjoint: of every response, whatever it looks at."""
    measure = AtTime(response, 0.0123) if isinstance(response, History) else response
    expected, result = (measure.of(x) for x in (motions[0], motions[0].stats["reverse"]))
    assert_close(result.value, expected.value, rtol=1e-9, atol=1e-9 * float(expected.value.abs().max()))
    assert result.gradient is not None
    assert expected.gradient is not None
    assert_close(result.gradient, expected.gradient, rtol=0, atol=1e-8 * float(expected.gradient.abs().max()))


@pytest.mark.parametrize("response", [*cases(HISTORIES), *(c for c in cases(MEASURES) if "mass1" not in str(c.id))])
def test_a_body_or_joint_that_does_not_exist_is_named(response, renamed):
    """Every response looks at its names when it is checked against the system."""
    with pytest.raises(mbd.InputError, match=r"must be .*Try:"):
        response.check(renamed)


@pytest.fixture(scope="module")
def renamed() -> mbd.System:
    system = pendulum()
    for body in system.bodies:
        vars(body)["name"] += "s"
    for joint in system.joints:
        vars(joint)["name"] += "s"
    return system


@pytest.mark.thorough("enable_grad")
@pytest.mark.parametrize("around", [torch.no_grad, torch.inference_mode, torch.enable_grad])
@pytest.mark.parametrize(
    "measure", [mbd.Integral(mbd.StrainEnergy("rod")), mbd.AtTimes(mbd.StrainEnergy("rod"), count=9)]
)
def test_gradients_do_not_depend_on_the_mode_of_torch_around(around, measure):
    """In reverse and in forward mode; of motions that were simulated there or outside."""
    system = pendulum()

    def run() -> mbd.Trajectory:
        return mbd.simulate(system, 0.01, steps=10, gradients="forward")

    expected = measure.value_and_gradient(run())[1]
    with around():
        inside = run()
        first = measure.value_and_gradient(inside)[1]
    outside = measure.value_and_gradient(inside)[1]
    for result in (first, outside):
        assert_close(result, expected, rtol=1e-12, atol=0.0)


@pytest.fixture(scope="module")
def failed(native) -> Trajectory:
    """Two lanes; in the second a spring overflows."""
    system = strong_pendulum()
    spring = mbd.SpringDamper(
        mbd.Ground().at(0.1, 0.2, 0.3), system.body("rod").at("right"), stiffness=mbd.variable(1.0)
    )
    held = mbd.System(system.bodies, system.joints, [spring], gravity=GRAVITY)
    stiffness = torch.tensor([1.0, 1e22], dtype=torch.float64)
    motion = mbd.simulate(held, DURATION, steps=STEPS, designs={f"{spring.name}.stiffness": stiffness})
    assert [status.startswith("failed") for status in motion.status] == [False, True]
    return motion


@pytest.mark.thorough("at_times0", "at_times1")
@pytest.mark.parametrize("response", [*cases(HISTORIES), *cases(MEASURES), *OTHERS])
def test_a_lane_that_failed_has_no_number(response, failed):
    """Of its motion; the mass, the frequencies and what loads buckle belong to the design."""
    expected = {"Mass", "Frequency", "MeanFrequency"} | (
        {"BucklingFactor"} if getattr(response, "loads", None) is not None else set()
    )
    made = response if isinstance(response, Measure) else mbd.Final(response)
    for result in (response(failed), *made.of(failed)):
        assert result.reshape(2, -1)[:, -1].isnan().tolist() == [False, type(response).__name__ not in expected]
