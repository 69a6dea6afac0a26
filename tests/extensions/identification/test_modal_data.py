"""Modal data: frequencies and damping ratios against matrices, pairs by MAC, modes without partner."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.extensions.identification import pendulum
from tests.refused import ANY, refused
from torchmbd.extensions.identification.measurement import Prediction
from torchmbd.extensions.identification.run import Run

TRUTH = (9e3, 4e3, 5.0, 4.0)


def fitted(data: mbd.identification.ModalData, unknowns=pendulum.ROW_UNKNOWNS) -> mbd.identification.Identification:
    return mbd.identification.identify(mbd.identification.Experiment(pendulum.row(), data), unknowns)


@pytest.mark.thorough
def test_stiffness_and_damping_of_two_masses():
    f, zeta, shapes = pendulum.row_modes(*TRUTH)
    fit = fitted(mbd.identification.ModalData(f, zeta, 3.0 * shapes, pendulum.ROW_SENSORS))
    np.testing.assert_allclose(fit.x, TRUTH, rtol=1e-6)
    assert fit.status == "converged"
    assert [x.name for x in fit.channels] == ["frequency", "damping ratio"]
    assert fit.notes[0].startswith(f"measured mode 1 ({f[0]:.4g} Hz) is mode 1 of the model")
    assert fit.notes[0].endswith("MAC 1.00")


@pytest.mark.thorough
def test_without_shapes_modes_are_paired_by_their_order():
    f, zeta, _ = pendulum.row_modes(*TRUTH)
    np.testing.assert_allclose(fitted(mbd.identification.ModalData(f, zeta)).x, TRUTH, rtol=1e-6)
    second = fitted(mbd.identification.ModalData(f[1:], modes=[2]), ["second.stiffness"])
    shown = mbd.equilibrium(pendulum.row(k2=second["second.stiffness"])).frequencies[0, 1]
    assert float(shown) == pytest.approx(f[1])


@pytest.mark.thorough
def test_shapes_pair_modes_of_another_order():
    """What was measured first is the second mode of the model: its frequency alone is lower there."""
    f, _, shapes = pendulum.row_modes()
    data = mbd.identification.ModalData([f[0], f[1]], shapes=shapes[:, ::-1], sensors=pendulum.ROW_SENSORS)
    fit = mbd.identification.identify(
        mbd.identification.Experiment(pendulum.row(), data), ["first.stiffness"], max_evaluations=1
    )
    assert fit.notes[0].startswith(f"measured mode 1 ({f[0]:.4g} Hz) is mode 2 of the model ({f[1]:.4g} Hz)")


@pytest.mark.thorough
def test_a_measured_mode_without_partner_is_named():
    f, _, shapes = pendulum.row_modes()
    sensors = [*pendulum.ROW_SENSORS, mbd.Position("a", "y")]  # which no mode of the model moves
    shown = np.zeros((3, 3))
    shown[:2, :2], shown[2, 2] = shapes, 1.0
    data = mbd.identification.ModalData([*f, 2.0 * f[1]], shapes=shown, sensors=sensors)
    with refused("frequencies", ANY, "3 modes", "2 vibrations"):
        fitted(data, ["first.stiffness"])
    data = mbd.identification.ModalData([f[0], 2.0 * f[1]], shapes=shown[:, [0, 2]], sensors=sensors)
    fit = fitted(data, ["first.stiffness"])
    assert fit.notes[0].startswith("frequency: measured modes without a partner in the model are left out: 2 (")
    assert fit["first.stiffness"] == pytest.approx(8e3, rel=1e-6)


@pytest.mark.thorough
def test_frequencies_of_a_flexible_body_in_rotation():
    """Stiffness by rotation is part of the model: the modulus is found by frequencies at 30 rad/s."""

    def blade(modulus: float) -> mbd.System:
        metal = {"E2": 70e9, "G12": 27e9, "G13": 27e9, "G23": 27e9, "nu12": 0.3, "density": 2700.0}
        laminate = mbd.Laminate(mbd.Ply(E1=mbd.variable(modulus), **metal), mbd.deg([0.0]), 2e-3)
        plate = mbd.mesh.rectangle(length=0.5, width=0.05, cells=(4, 2))
        body = mbd.FlexibleBody.plate("blade", plate, laminate, modes=3, position=(0.25, 0, 0))
        return mbd.System([body], [mbd.Revolute(mbd.Ground().at(), body.at("left"), axis="z", name="root")])

    f = mbd.equilibrium(blade(70e9), spin=(0.0, 0.0, 30.0)).frequencies[0]
    f = f[f > 1.0][:2].tolist()  # without that of the hinge
    data = mbd.identification.ModalData(f, modes=[1, 2], spin=(0.0, 0.0, 30.0))
    fit = mbd.identification.identify(mbd.identification.Experiment(blade(60e9), data), ["blade.laminate.ply.E1"])
    assert fit["blade.laminate.ply.E1"] == pytest.approx(70e9, rel=1e-3)


@pytest.mark.parametrize(
    ("make", "fault"),
    [
        (lambda: mbd.identification.ModalData([2.0, 1.0]), ("frequencies", [2.0, 1.0])),
        (lambda: mbd.identification.ModalData([-1.0]), ("frequencies", [-1.0])),
        (lambda: mbd.identification.ModalData([]), ("frequencies", [])),
        (lambda: mbd.identification.ModalData([1.0], damping=[0.1, 0.2]), ("damping",)),
        (
            lambda: mbd.identification.ModalData([1.0], shapes=[[1.0]]),
            ("shapes", ANY, "(1, 1)", "[0 sensors, 1 modes]"),
        ),
        (
            lambda: mbd.identification.ModalData([1.0], shapes=[[0.0]], sensors=[mbd.Position("a", "x")]),
            ("shapes", [[0.0]]),
        ),
        (lambda: mbd.identification.ModalData([1.0], sensors=[mbd.StrainEnergy("a")]), ("sensors", ANY, "positions")),
        (lambda: mbd.identification.ModalData([1.0], modes=[0]), ("modes", [0])),
        (lambda: mbd.identification.ModalData([1.0], modes=[1.5]), ("modes", [1.5])),
        (lambda: mbd.identification.ModalData([1.0], modes=["a"]), ("modes", ["a"])),
        (lambda: mbd.identification.ModalData([1.0], damping=["a"]), ("damping",)),
        (lambda: mbd.identification.ModalData([1.0], damping=[np.inf]), ("damping",)),
        (lambda: mbd.identification.ModalData([1.0], shapes=[["a"]], sensors=[mbd.Position("a", "x")]), ("shapes",)),
        (lambda: mbd.identification.ModalData([1.0], sensors=[mbd.Position("a", "x")]), ("sensors",)),
        (
            lambda: mbd.identification.ModalData([1.0], shapes=[[1.0]], sensors=[mbd.Position("a", "x")], modes=[1]),
            ("modes", [1]),
        ),
        (lambda: mbd.identification.ModalData([1.0], least_mac=2.0), ("least_mac", 2.0)),
        (
            lambda: mbd.identification.ModalData([1.0], spinn=(0, 0, 1)),
            ("options.spinn", "spinn"),
        ),
        (
            lambda: fitted(mbd.identification.ModalData([1.0, 2.0, 3.0]), ["first.stiffness"]),
            ("numbers", 3),
        ),
    ],
)
def test_bad_input_is_named(make, fault):
    with refused(*fault):
        make()


def test_partners_are_decided_where_the_search_begins():
    """The shape of b alone is a mode where the first spring is stiff: that of the start, not that of the system."""
    data = mbd.identification.ModalData([20.0], shapes=[[0.01], [1.0]], sensors=pendulum.ROW_SENSORS, least_mac=0.99)
    experiment = mbd.identification.Experiment(pendulum.row(), data)
    with refused("frequencies", ANY, "MAC is 0."):
        mbd.identification.identify(experiment, ["first.stiffness"])
    stiff = mbd.identification.identify(
        experiment, ["first.stiffness"], start={"first.stiffness": 1e6}, max_evaluations=1
    )
    assert stiff.notes[0].startswith("measured mode 1 (20 Hz) is mode 1 of the model")
    assert "MAC 1.00" in stiff.notes[0]


SENSORS = [mbd.Position("arm", axis, node=node) for node in (2, 4, 7, 9, 14) for axis in "xyz"]
PLIES = "arm.laminate.angles"


@pytest.mark.parametrize(
    ("modes", "designs"),
    [(6, [[0.7, -0.6], [0.7, -0.3], [0.3, 0.9]]), (4, [[0.0, 0.0], [0.7, -0.3], [0.0, 0.0], [0.72, -0.33]])],
    ids=["as many modes in each", "more modes in some"],
)
def test_a_design_of_a_batch_has_the_modes_that_it_has_alone(modes, designs):
    """Pairs by its own shapes, frequencies and their gradients, also of modes that other designs do not have."""
    system, designs = mbd.examples.arm(modes=modes), torch.tensor(designs, dtype=torch.float64)
    shapes = np.random.default_rng(0).normal(size=(len(SENSORS), 4))
    data = mbd.identification.ModalData([1.0, 2.0, 3.0, 4.0], shapes=shapes, sensors=SENSORS)
    simulation = mbd.Simulation(system, 0.01, steps=2)

    def predicted(some: torch.Tensor) -> Prediction:
        variables = some.clone().requires_grad_()
        return data.predict(Run(system, 0.01, {PLIES: variables}, {}, simulation, len(some), True), {})

    batch, alone = predicted(designs), [predicted(design[None]) for design in designs]
    torch.testing.assert_close(batch.value, torch.cat([x.value for x in alone]), rtol=1e-9, atol=0.0)
    gradients = torch.cat([x.by_design for x in alone])
    torch.testing.assert_close(batch.by_design, gradients, rtol=1e-6, atol=1e-6 * float(gradients.abs().max()))


@pytest.mark.thorough
def test_starts_may_retain_different_numbers_of_modes():
    system = mbd.examples.arm(modes=4)
    truth = mbd.equilibrium(system, designs={PLIES: torch.tensor([[0.7, -0.3]], dtype=torch.float64)})
    f = [x for x in truth.frequencies[0].tolist() if x > 1e-3]
    data = mbd.identification.ModalData(f[:4])
    starts = np.array([[0.72, -0.33], [0.0, 0.0]])
    fit = mbd.identification.identify(
        mbd.identification.Experiment(system, data), [PLIES], start={PLIES: [0.7, -0.3]}, starts=starts
    )
    assert fit.status == "converged"


@pytest.mark.thorough
def test_a_start_without_a_state_is_a_start_that_failed():
    """Nothing balances the load without a spring; other starts are searched all the same."""
    ground, mass = mbd.Ground(), mbd.RigidBody("mass", 2.0, (1.0, 1.0, 1.0))
    ends = ground.at(), mass.at()
    spring = mbd.AxialSpringDamper(*ends, axis="x", stiffness=mbd.variable(100.0), name="spring")
    model = mbd.System([mass], [mbd.Prismatic(*ends, axis="x")], [spring, mbd.Force(mass.at(), (5.0, 0.0, 0.0))])
    experiment = mbd.identification.Experiment(
        model, mbd.identification.ModalData([np.sqrt(150.0 / 2.0) / (2.0 * np.pi)])
    )
    arguments = {"bounds": {"spring.stiffness": (0.0, 1e3)}, "start": {"spring.stiffness": 0.0}}
    fit = mbd.identification.identify(experiment, ["spring.stiffness"], **arguments)
    assert fit.status == "failed"
    assert "no static equilibrium" in fit.fit.message
    fit = mbd.identification.identify(experiment, ["spring.stiffness"], **arguments, starts=[[90.0], [0.0]])
    assert [x.status for x in fit.starts] == ["converged", "failed"]
    assert fit["spring.stiffness"] == pytest.approx(150.0)
    unstable = mbd.identification.Experiment(pendulum.row(k1=-9e3), mbd.identification.ModalData([5.0], unstable=True))
    fit = mbd.identification.identify(unstable, ["second.stiffness"])
    assert fit.status == "failed"
    assert "vibrations about the equilibrium grow" in fit.fit.message


def test_a_mode_that_is_damped_more_than_critically_shifts_no_other():
    """The poles of the first mode are real: the damping measured of the second is that of the only pair that oscillates."""
    heavy = {"c1": 800.0, "c2": 0.0}
    f, zeta, _ = pendulum.row_modes(**heavy)
    assert len(zeta) == 1
    data = mbd.identification.ModalData([f[1]], zeta, modes=[2])
    model = pendulum.row(**heavy)
    fit = mbd.identification.identify(mbd.identification.Experiment(model, data), ["first.damping"], max_evaluations=1)
    assert abs(fit.residuals).max() < 1e-6
    with refused("damping", ANY, "mode 1 of the model", kind=mbd.DesignFailure):
        mbd.identification.Experiment(model, mbd.identification.ModalData([f[0]], zeta)).within({}, {}).measurements[
            0
        ].predict(
            mbd.identification.Experiment(model, mbd.identification.ModalData([f[0]], zeta)).run({}, 1, False, None), {}
        )
