"""Designs that retain different numbers of modes, in one batch: each moves as it does alone.

A beam that is alike in two planes has pairs of bending modes; its torsional modes pass them as the torsional stiffness grows.
"""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.refused import refused

GJ = "arm.section.stiffness_44"
MIXED = torch.tensor([30.0, 130.0, 316.0, 2500.0], dtype=torch.float64)  # 3, 5, 7, 4 modes for modes=3
CRAIG_BAMPTON = {"reduction": "craig-bampton", "interface": "end"}
BACKENDS = ["eager", pytest.param("native", marks=pytest.mark.slow)]


def system(modes: int, start: float = 900.0, **options) -> mbd.System:
    """A beam that swings on a spring, with a point of mass beside its end; bending and torsion are coupled a little."""
    K = [[0.0] * 6 for _ in range(6)]
    for i, x in enumerate((2e7, 4e6, 4e6, mbd.variable(start), 400.0, 400.0)):
        K[i][i] = x
    K[3][4] = K[4][3] = 25.0
    M = torch.diag(torch.tensor([0.3, 0.3, 0.3, 4.8e-4, 2.4e-4, 2.4e-4], dtype=torch.float64))
    line = mbd.BeamLine.straight(1.0, elements=6)
    section = mbd.GivenSection(K, M)
    arm = mbd.FlexibleBody.beam("arm", line, section, modes=modes, reference="start", damping=1e-4, **options)
    tip = mbd.RigidBody("tip", mass=0.02, inertia=(2e-5, 2e-5, 2e-5), position=(1.0, 0.03, 0.02))
    ground = mbd.Ground()
    joints = [
        mbd.Revolute(ground.at(), arm.at("start"), axis="z", name="hinge"),
        mbd.Fixed(arm.at("end"), tip.at(0, -0.03, -0.02), name="clamp"),
    ]
    spring = mbd.RotationalSpringDamper(
        ground.at(), arm.at("start"), axis="z", stiffness=200.0, damping=0.1, name="lag"
    )
    return mbd.System([arm, tip], joints, [spring], gravity=(0.0, -3.0, -9.81), truncation=None)


def motion(model: mbd.System, designs: torch.Tensor, gradients: str = "none", **options) -> mbd.Trajectory:
    options = {"duration": 0.05, "steps": 40, "backend": "eager"} | options
    return mbd.simulate(model, designs={GJ: designs}, gradients=gradients, **options)


def rows(result: mbd.Trajectory) -> torch.Tensor:
    """Responses [lanes, k]."""
    histories = [mbd.StrainEnergy("arm"), *(mbd.Displacement("arm", axis, node="end") for axis in "yz")]
    return torch.stack([mbd.Integral(history)(result) for history in histories], 1)


def mode_counts(result: mbd.Trajectory) -> list[int]:
    return (result.body("arm").stiffness[0].diagonal(dim1=1, dim2=2) != 0.0).sum(1).tolist()


@pytest.mark.thorough
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("options", [{}, CRAIG_BAMPTON], ids=["vibration", "craig-bampton"])
def test_a_lane_moves_as_it_does_alone(options, backend):
    model = system(3, **options)
    x = MIXED.clone().requires_grad_()
    batch = motion(model, x, "reverse", backend=backend)
    assert batch.status == ["ok"] * 4
    counts = mode_counts(batch)
    assert len(set(counts)) > 2
    w = batch.body("arm").w.detach()
    assert w.shape[-1] == max(counts)
    values = rows(batch)
    slopes = torch.stack([torch.autograd.grad(y.sum(), x, retain_graph=True)[0] for y in values.T], 1)
    for lane, count in enumerate(counts):
        assert not w[lane, :, count:].any()
        y = MIXED[lane : lane + 1].clone().requires_grad_()
        alone = motion(model, y, "reverse", backend=backend)
        assert alone.body("arm").w.shape[-1] == count
        of_lane = rows(alone)
        assert_close(values[lane], of_lane[0], rtol=1e-10, atol=0.0)
        slope = torch.stack([torch.autograd.grad(z.sum(), y, retain_graph=True)[0] for z in of_lane.T], 1)
        assert_close(slopes[lane], slope[0], rtol=1e-8, atol=0.0)
        for measure in (mbd.vibrations.SystemFrequency(3), mbd.Frequency("arm", 3)):
            assert_close(measure(batch)[lane], measure(alone)[0], rtol=1e-9, atol=0.0)


@pytest.mark.thorough
@pytest.mark.parametrize("options", [{}, CRAIG_BAMPTON], ids=["vibration", "craig-bampton"])
def test_forward_reverse_and_differences_agree_in_padded_lanes(options):
    model = system(3, **options)
    slopes = []
    for mode in ("reverse", "forward"):
        x = MIXED.clone().requires_grad_()
        values = rows(motion(model, x, mode, steps=160))
        slopes.append(torch.stack([torch.autograd.grad(y.sum(), x, retain_graph=True)[0] for y in values.T], 1))
    assert_close(slopes[0], slopes[1], rtol=1e-5, atol=0.0)
    h = 1e-4 * MIXED
    near, far = (
        (rows(motion(model, MIXED + k * h, steps=160)) - rows(motion(model, MIXED - k * h, steps=160)))
        / (2 * k * h[:, None])
        for k in (1, 2)
    )
    assert_close(slopes[0][:3], ((4 * near - far) / 3)[:3], rtol=1e-4, atol=0.0)


@pytest.mark.thorough
@pytest.mark.parametrize(("modes", "discarded"), [(3, 121.0), (5, 325.0)])
def test_responses_are_continuous_to_the_truncation_where_torsion_passes_bending(modes, discarded):
    """Along a line of designs the numbers change and none fails. Deflections jump by no more than the first bending modes that
    may be discarded contribute to them: (20 Hz / their frequency)^2, as amplitudes at the end are equal for all modes."""
    line = torch.logspace(1.3, 3.7, 25, dtype=torch.float64)
    result, many = (motion(system(n, start=2000.0), line) for n in (modes, 16))
    assert result.status == ["ok"] * len(line)
    counts = mode_counts(result)
    assert len(set(counts)) > 2
    assert modes <= min(counts) <= max(counts) <= modes + 4
    deflections, exact = (rows(x)[:, 1:] for x in (result, many))
    jumps = (deflections - exact).diff(dim=0).abs() / exact.abs().amax(0)
    assert float(jumps.max()) < (20.135 / discarded) ** 2


@pytest.mark.thorough
def test_rest_vibrations_and_starts_know_no_padding():
    model = system(3)
    rest = mbd.equilibrium(model, designs={GJ: MIXED})
    counts = [len(x.frequencies) for x in rest.vibrations]
    assert counts == [4, 6, 8, 5]  # modes, and the hinge
    for lane, of_lane in enumerate(rest.vibrations):
        alone = mbd.equilibrium(model, designs={GJ: MIXED[lane : lane + 1]}).vibrations[0]
        assert_close(of_lane.frequencies, alone.frequencies, rtol=1e-9, atol=0.0)
        assert_close(of_lane.poles.abs().sort().values, alone.poles.abs().sort().values, rtol=1e-9, atol=0.0)
    first = motion(model, MIXED)
    assert motion(model, MIXED, start="equilibrium").status == ["ok"] * 4
    further = motion(model, MIXED, start=first)
    for lane in range(4):
        x = MIXED[lane : lane + 1]
        alone = motion(model, x, start=motion(model, x))
        assert_close(rows(further)[lane], rows(alone)[0], rtol=1e-9, atol=0.0)


@pytest.mark.thorough
def test_damping_ratios_and_modal_starts_belong_to_the_lowest_modes():
    model = system(3)
    model.body("arm").damped([0.01, 0.02, 0.05])
    model.body("arm").bent([1e-3, 0.0, 2e-3])
    batch = motion(model, MIXED)
    for lane in range(4):
        assert_close(rows(batch)[lane], rows(motion(model, MIXED[lane : lane + 1]))[0], rtol=1e-9, atol=0.0)
    start = {"arm.modal": torch.tensor([0.0, 0.0, 0.0, 0.0, 1e-3], dtype=torch.float64)}
    with refused("start.arm"):
        motion(system(3), MIXED, start=start)


@pytest.mark.thorough
def test_phases_take_the_numbers_of_their_designs():
    model = system(3)
    phases = [mbd.Phase(lock=["hinge"], until=0.02), mbd.Phase()]
    batch = motion(model, MIXED, phases=phases)
    assert batch.status == ["ok"] * 4
    for lane in range(4):
        alone = motion(model, MIXED[lane : lane + 1], phases=phases)
        assert_close(rows(batch)[lane], rows(alone)[0], rtol=1e-9, atol=0.0)


def test_more_modes_than_freedoms_are_refused():
    with refused("arm.modes", 37):
        system(37)


@pytest.mark.thorough
def test_a_ring_of_equal_spokes_says_how_many_modes_it_needs():
    angles = torch.arange(8, dtype=torch.float64) * torch.pi / 4
    nodes = torch.cat(
        [torch.zeros(1, 3), *(r * torch.stack([a.cos(), a.sin(), 0 * a])[None] for a in angles for r in (0.5, 1.0))]
    )
    elements = [pair for k in range(8) for pair in ((0, 1 + 2 * k), (1 + 2 * k, 2 + 2 * k))]
    spoke = mbd.GivenSection.isotropic(210e9, 0.3, 7850.0, 1e-4, 8e-10, 8e-10, 1.4e-9)
    line = mbd.BeamLine(nodes.double(), torch.tensor(elements), {"hub": [0]})
    with refused("ring.modes", 2, "modes = 16"):
        mbd.FlexibleBody.beam("ring", line, spoke, modes=2, reference="hub", orientation=(0.0, 0.0, 1.0))
    ring = mbd.FlexibleBody.beam("ring", line, spoke, modes=16, reference="hub", orientation=(0.0, 0.0, 1.0))
    assert ring.modes == 16
