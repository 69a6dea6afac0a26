"""Forward sensitivities against reverse mode through plain torchdiffeq: the same discrete map, two ways to differentiate.

Forward: direct differentiation in an augmented state, structure tangents by jvp. Reverse: system() as it is, backward().
"""

from __future__ import annotations

import pytest
import torch
import torchdiffeq
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import laminate, pendulum, plate, soft_slider_crank
from torchmbd.multibody.equations.topology import Topology

DURATION, STEPS = 0.004, 16


def shared() -> mbd.System:
    """Two plates that share one laminate: its angles act through both."""
    both = laminate((20.0, -50.0))
    one = plate("one", made_of=both, angular_velocity=(5.0, 8.0, -3.0))
    two = plate("two", 2, made_of=both, position=(0.3, 0.0, 0.0), velocity=(0.5, 1.5, 0.2))
    return mbd.System([one, two], [mbd.Spherical(one.at("right"), two.at("left"))])


SYSTEMS = {"slider_crank": soft_slider_crank, "pendulum": pendulum, "shared": shared}


def weights(T: Topology) -> torch.Tensor:
    make = torch.Generator().manual_seed(3)
    return torch.randn(2, T.n_q + T.n_v, generator=make, dtype=torch.float64)


@pytest.mark.thorough
@pytest.mark.parametrize("name", SYSTEMS)
def test_reverse_mode_through_plain_torchdiffeq_is_the_forward_sensitivity(name):
    system = SYSTEMS[name]()
    (angles,) = (x for x in system.parameters() if x.requires_grad)
    times = torch.linspace(0.0, DURATION, STEPS + 1, dtype=torch.float64)
    dynamics = system()
    z = torchdiffeq.odeint(dynamics, dynamics.initial_state(), times, method="rk4")[[STEPS // 2, -1], 0]
    functional = (weights(system.topology) * z).sum() + (z * z).sum()
    functional.backward()

    motion = mbd.simulate(system, DURATION, "rk4", steps=STEPS, gradients="forward")
    y = torch.cat([motion.q, motion.v], -1)[0, [STEPS // 2, -1]]
    slopes = torch.cat([motion.dq_db, motion.dv_db], -2)[0, [STEPS // 2, -1]]
    assert_close(y, z.detach(), rtol=1e-11, atol=1e-11)
    forward = torch.einsum("ti,tib->b", weights(system.topology) + 2 * y, slopes)
    assert float(forward.abs().min()) > 0
    assert_close(angles.grad, forward, rtol=1e-8, atol=0)


@pytest.mark.thorough
def test_a_batch_in_forward_mode_is_each_design_in_reverse_mode():
    """Lanes do not leak into each other's gradients."""
    system = pendulum()
    designs = mbd.deg([[20.0, -50.0], [75.0, 10.0]])
    motion = mbd.simulate(
        system, DURATION, "rk4", steps=8, gradients="forward", designs={"rod.laminate.angles": designs}
    )
    times = torch.linspace(0.0, DURATION, 9, dtype=torch.float64)
    U = mbd.StrainEnergy("rod").series(motion)
    for lane, angles in enumerate(designs):
        alone = pendulum(angles=(angles * 180 / torch.pi).tolist())
        dynamics = alone()
        q = torchdiffeq.odeint(dynamics, dynamics.initial_state(), times, method="rk4")[-1, 0, : system.topology.n_q]
        w, Kr = q[alone.topology.w_slice(0)], dynamics.dynamics.data["Kr"][:, :, 0, 0, 0]
        energy = 0.5 * w @ Kr @ w
        (gradient,) = torch.autograd.grad(energy, alone.body("rod").laminate.angles)
        assert_close(U.value[lane, -1], energy.detach(), rtol=1e-8, atol=0)
        assert_close(U.gradient[lane, -1], gradient, rtol=1e-7, atol=1e-8 * float(gradient.abs().max()))


@pytest.mark.thorough
def test_adaptive_methods_run_in_reverse_mode_too():
    system = pendulum()
    dynamics = system()
    end = torchdiffeq.odeint(
        dynamics, dynamics.initial_state(), torch.tensor([0.0, 0.01]).double(), rtol=1e-9, atol=1e-11
    )[-1, 0]
    end[: system.topology.n_q].square().sum().backward()
    motion = mbd.simulate(system, 0.01, "dopri5", steps=1, gradients="forward", rtol=1e-9, atol=1e-11)
    forward = 2 * torch.einsum("i,ib->b", motion.q[0, -1], motion.dq_db[0, -1])
    assert_close(system.body("rod").laminate.angles.grad, forward, rtol=1e-5, atol=0)
