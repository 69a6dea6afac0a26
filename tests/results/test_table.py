"""A motion as a table: bodies, joints, strains of beams and histories, each heading with its unit."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.refused import refused

GROUND = mbd.Ground()


@pytest.fixture(scope="module")
def motion() -> mbd.Trajectory:
    angles = torch.tensor([[0.0, 0.0], [0.3, -0.3]], dtype=torch.float64, requires_grad=True)
    return mbd.simulate(mbd.examples.arm(), 0.01, steps=5, designs={"arm.laminate.angles": angles}, backend="eager")


@pytest.mark.thorough
def test_bodies_joints_and_histories_have_columns_with_units(motion):
    assert motion.q.requires_grad  # a table has values alone
    energy = mbd.StrainEnergy("arm")
    frame = motion.to_dataframe("arm", "hinge", histories={"energy of the arm [J]": energy})
    assert frame.index.names == ["lane", "t [s]"]
    assert len(frame) == motion.lanes * len(motion.t)
    assert all(heading.endswith("]") for heading in frame.columns)
    view = motion.body("arm")

    def columns(*headings: str) -> np.ndarray:
        return frame[list(headings)].to_numpy().reshape(motion.lanes, len(motion.t), -1)

    np.testing.assert_array_equal(columns("arm x [m]", "arm y [m]", "arm z [m]"), view.r.detach())
    np.testing.assert_array_equal(columns("arm vx [m/s]", "arm vy [m/s]", "arm vz [m/s]"), view.at().velocity.detach())
    np.testing.assert_array_equal(columns("arm wx [rad/s]", "arm wy [rad/s]", "arm wz [rad/s]"), view.omega.detach())
    np.testing.assert_array_equal(columns(*(f"arm e{k} [1]" for k in range(4))), view.p.detach())
    np.testing.assert_array_equal(columns(*(f"arm w{k + 1} [1]" for k in range(view.w.shape[-1]))), view.w.detach())
    np.testing.assert_array_equal(columns("energy of the arm [J]")[..., 0], energy(motion).detach())
    for kind, unit in (("force", "N"), ("torque", "N m")):
        for axis in "xyz":
            expected = mbd.Reaction("hinge", axis, kind)(motion).detach()
            np.testing.assert_allclose(
                columns(f"hinge {kind} {axis} [{unit}]")[..., 0], expected, rtol=1e-12, atol=1e-12
            )


@pytest.mark.thorough
def test_strains_of_a_beam_are_its_section_forces_over_its_stiffness():
    """A cantilever with a load at its tip, at rest: mean strains by the mean of both ends' forces."""
    section = mbd.GivenSection.isotropic(E=2e11, nu=0.3, density=7850.0, area=1e-4, Iyy=1e-9, Izz=2e-9, J=2e-9)
    beam = mbd.FlexibleBeam("beam", mbd.BeamLine.straight(1.0, 3), section)
    wall = mbd.Fixed(GROUND.at(), beam.at("start"), name="wall")
    system = mbd.System([beam], [wall], [mbd.Force(beam.at("end"), (40.0, 0.05, 0.03), name="load")])
    result = mbd.simulate(system, 1e-4, steps=2, start="equilibrium", gradients="none", backend="eager")
    row = result.to_dataframe("beam", "wall").iloc[0]
    with torch.no_grad():
        flexibility = torch.linalg.inv(section.stiffness()).numpy()
    forces = ("N [N]", "V_y [N]", "V_z [N]", "T [N m]", "M_y [N m]", "M_z [N m]")
    strains = ("strain x [1]", "shear y [1]", "shear z [1]", "twist x [1/m]", "curvature y [1/m]", "curvature z [1/m]")
    for k in range(3):
        ends = [row[[f"beam element {k} {end} {key}" for key in forces]].to_numpy(float) for end in ("start", "end")]
        expected = flexibility @ (0.5 * (ends[0] + ends[1]))
        mean = row[[f"beam element {k} {key}" for key in strains]].to_numpy(float)
        np.testing.assert_allclose(mean, expected, rtol=2e-3, atol=1e-9)
    assert row["beam node 3 x [m]"] == pytest.approx(1.0 + 40.0 / (2e11 * 1e-4), abs=2e-6)
    np.testing.assert_allclose(
        row[[f"wall force {x} [N]" for x in "xyz"]].to_numpy(float), (-40.0, -0.05, -0.03), rtol=1e-6
    )


@pytest.mark.parametrize(
    ("names", "histories", "path"),
    [
        ((), None, "names"),
        (("hing",), None, "body, beam or joint"),
        (("arm", "arm"), None, "names.arm x [m]"),
        (
            (),
            {"peak [J]": mbd.Max(mbd.StrainEnergy("arm"))},
            "histories.peak [J]",
        ),
        ((), {"x": 3.0}, "histories.x"),
    ],
)
def test_tables_that_are_refused(motion, names, histories, path):
    with refused(path):
        motion.to_dataframe(*names, histories=histories)


def test_a_name_of_a_body_and_of_a_joint_is_refused():
    body = mbd.RigidBody("wheel", 1.0, (1.0, 1.0, 1.0))
    system = mbd.System([body], [mbd.Revolute(GROUND.at(), body.at(), name="wheel")])
    result = mbd.simulate(system, 0.01, steps=1, gradients="none", backend="eager")
    with refused("names", "wheel"):
        result.to_dataframe("wheel")
