"""A flexible arm whose laminate and whose controller are trained together: `python -m experiments.tutorial.codesign`

A motor turns the arm by a quarter turn in 0.4 s. Its torque comes from a PD law and a neural network beside it, which read the
angle and the rate of the hinge and the time. The loss is the mean square distance of the tool from its goal after the move.
One `backward()` gives the gradient with respect to 9,795 weights and the angles of two plies. The cost of the adjoint does not
depend on their number.

The table shows the distance in millimeters; two files show the motion before and after. 28 iterations take some minutes.
Checked in tests/experiments/test_codesign.py.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

import torchmbd as mbd

CARBON = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)
LENGTH, GOAL = 1.0, mbd.deg(90.0)  # [m], [rad]
DURATION, MOVE, STEPS = 0.6, 0.4, 150  # [s]: the arm is to stand still from MOVE on


class Feedback(nn.Module):
    """Torque [N m] of the hinge's angle [rad], its rate [rad/s] and the time [s]: a PD law and a network beside it."""

    def __init__(self, width: int = 96):
        super().__init__()
        self.gains = nn.Parameter(torch.ones(2, dtype=torch.float64))  # of 400 N m/rad and 40 N m s/rad
        last = nn.Linear(width, 1)
        nn.init.normal_(last.weight, std=1e-3)
        nn.init.zeros_(last.bias)
        hidden = nn.Linear(3, width), nn.Tanh(), nn.Linear(width, width), nn.Tanh()
        self.network = nn.Sequential(*hidden, last).double()

    def forward(self, x: Tensor) -> Tensor:
        angle, rate, time = x.unbind(-1)
        s = (time / MOVE).clamp(0.0, 1.0)
        wanted, speed = GOAL * s * s * (3.0 - 2.0 * s), GOAL / MOVE * 6.0 * s * (1.0 - s)
        error = torch.stack([400.0 * (wanted - angle), 40.0 * (speed - rate)], -1)
        correction = s[..., None] * self.network(torch.stack([angle, rate / 10.0, s], -1))  # no jump at the start
        return (error @ self.gains)[..., None] + 20.0 * correction


def build(width: int = 96) -> mbd.System:
    """The arm lies along x, turns about z, and carries a tool below its end, so that turning twists it."""
    torch.manual_seed(1)
    ground = mbd.Ground()
    section = mbd.sections.tube(0.02, CARBON, mbd.deg([45.0, -45.0]), thickness=8e-4, cells=(24, 1))
    arm = mbd.FlexibleBody.beam(
        "arm",
        mbd.BeamLine.straight(LENGTH, 8),
        section,
        reference="start",
        reduction="craig-bampton",
        interface="end",
        modes=0,
        damping=1e-4,
    )
    hub = mbd.RigidBody("hub", mass=1.0, inertia=(1e-3, 1e-3, 1e-3))
    tool = mbd.RigidBody("tool", mass=1.5, inertia=(2e-3, 2e-3, 2e-3), position=(LENGTH, 0, -0.2))
    hinge = mbd.Revolute(ground.at(0, 0, 0), hub.at(0, 0, 0), axis="z", name="hinge")
    joints = [hinge, mbd.Fixed(hub.at(0, 0, 0), arm.at("start")), mbd.Fixed(arm.at("end"), tool.at(0, 0, 0.2))]
    motor = mbd.Controller(
        Feedback(width),
        inputs=[mbd.signals.JointAngle(hinge), mbd.signals.JointRate(hinge), mbd.signals.Time()],
        outputs=[mbd.signals.JointTorque(hinge)],
        name="motor",
    )
    return mbd.System([hub, arm, tool], joints, forces=[motor])


def loss(motion: mbd.Trajectory) -> Tensor:
    """Mean square distance of the tool from where it is to stand [m^2], after the move."""
    after = motion.t >= MOVE
    tool = motion.body("tool").r[:, after]
    goal = torch.tensor([0.0, LENGTH, -0.2], dtype=torch.float64)
    return (tool - goal).square().sum(-1).mean()


def train(system: mbd.System, iterations: int = 28, steps: int = STEPS) -> list[float]:
    """Adam on the weights and the ply angles of the system; the loss before each iteration."""
    weights = [p for name, p in system.named_parameters() if name.startswith("motor")]
    angles = [p for name, p in system.named_parameters() if name.startswith("arm")]
    optimizer = torch.optim.Adam([{"params": weights, "lr": 1e-2}, {"params": angles, "lr": mbd.deg(3.0)}])
    history = []
    for _ in range(iterations):
        optimizer.zero_grad()
        motion = mbd.simulate(system, DURATION, steps=steps).require_ok()
        value = loss(motion)
        value.backward()
        optimizer.step()
        history.append(float(value.detach()))
        print(f"iteration {len(history):3d}   distance {1e3 * history[-1] ** 0.5:6.1f} mm")
    return history


def main() -> None:
    """Train, and animate the motion before and after."""
    system = build()
    for name in ("before", "after"):
        with torch.no_grad():
            motion = mbd.simulate(system, DURATION, steps=STEPS)
        print(mbd.viz.animate(motion, f"codesign_{name}.html"))
        if name == "before":
            train(system)
    for name, x in system.named_parameters():
        if name.startswith("arm"):
            print(name, torch.rad2deg(x.detach()).round(decimals=1).tolist(), "degrees")


if __name__ == "__main__":
    main()
