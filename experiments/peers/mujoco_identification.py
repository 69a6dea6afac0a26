"""A rigid double pendulum identified by two programs from the same data. `python -m experiments.peers.mujoco_identification`

    unknown    the masses of both links and the damping of both hinges, from 30 % off
    data       both angles, 3 s at 100 Hz, of MuJoCo's motion with steps of 0.1 ms, with noise of 1 mrad
    MuJoCo     steps of 1 ms, Jacobians by forward differences of scipy.optimize.least_squares, as its `sysid` makes them
    torchmbd   mbd.identification.identify, 600 steps

Both searches are SciPy's "trf" with tolerances of 1e-5. Chosen, no publication. Needs the package `mujoco`.
"""

from __future__ import annotations

import importlib
import time
from typing import Any

import numpy as np
import torch
from scipy.optimize import least_squares

import torchmbd as mbd

LENGTH, INERTIA, SPEEDS = 0.5, 0.02, (2.0, -1.0)  # [m], [kg m2], of the hinges [rad/s]
TRUTH = np.array([1.0, 0.7, 0.05, 0.03])  # [kg], [kg], [N m s/rad] twice
OFF = np.array([1.3, 0.7, 1.3, 0.7])
TIMES = 0.01 * np.arange(1, 301)  # [s]
NOISE = 1e-3  # [rad]
MODEL = f"""
<mujoco>
  <option timestep="{{step}}" gravity="0 0 -9.81" integrator="RK4"/>
  <worldbody>
    <body>
      <joint type="hinge" axis="0 1 0" damping="1"/>
      <inertial pos="0 0 {-LENGTH / 2}" mass="1" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>
      <body pos="0 0 {-LENGTH}">
        <joint type="hinge" axis="0 1 0" damping="1"/>
        <inertial pos="0 0 {-LENGTH / 2}" mass="1" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def of_mujoco(mujoco: Any, x: np.ndarray, step: float) -> np.ndarray:
    """Angles [2, times] of masses and dampings x [4]."""
    model = mujoco.MjModel.from_xml_string(MODEL.format(step=step))
    model.body_mass[1:], model.dof_damping[:] = x[:2], x[2:]
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    mujoco.mj_resetData(model, data)
    data.qvel[:] = SPEEDS
    rows, every = [], round(0.01 / step)
    for _ in TIMES:
        mujoco.mj_step(model, data, every)
        rows.append(data.qpos.copy())
    return np.array(rows).T


def build(x: np.ndarray) -> mbd.System:
    """The pendulum of masses and dampings x [4]."""
    ground, links, joints, dampers = mbd.Ground(), [], [], []
    before, spin, top, speed = ground.at(), 0.0, 0.0, 0.0
    for k in range(2):
        spin += SPEEDS[k]
        motion = {"velocity": (speed - 0.5 * LENGTH * spin, 0, 0), "angular_velocity": (0, spin, 0)}
        inertia = torch.full((3,), INERTIA, dtype=torch.float64)
        link = mbd.RigidBody(f"link{k + 1}", mbd.variable(x[k]), inertia, position=(0, 0, top - 0.5 * LENGTH), **motion)
        upper = link.at(0, 0, 0.5 * LENGTH)
        joints.append(mbd.Revolute(before, upper, axis="y", name=f"hinge{k + 1}"))
        damping = mbd.variable(x[2 + k])
        dampers.append(mbd.RotationalSpringDamper(before, upper, "y", damping=damping, name=f"damper{k + 1}"))
        speed, top, before = speed - LENGTH * spin, top - LENGTH, link.at(0, 0, -0.5 * LENGTH)
        links.append(link)
    return mbd.System(links, joints, dampers, gravity=(0, 0, -9.81))


def main() -> None:
    """Print simulations, time and errors of both."""
    mujoco = importlib.import_module("mujoco")
    clean = of_mujoco(mujoco, TRUTH, 1e-4)
    shown = clean + NOISE * np.random.default_rng(0).standard_normal(clean.shape)
    count = 0

    def residuals(y: np.ndarray) -> np.ndarray:
        nonlocal count
        count += 1
        return ((of_mujoco(mujoco, y * TRUTH * OFF, 1e-3) - shown) / NOISE).ravel()

    begin = time.perf_counter()
    ending = least_squares(residuals, np.ones(4), bounds=(0.0, np.inf), ftol=1e-5, xtol=1e-5, gtol=1e-5)
    _say("MuJoCo, differences", count, time.perf_counter() - begin, ending.x * TRUTH * OFF)
    responses = {"first": mbd.Angle("link1", "y"), "second": mbd.Angle("link2", "y", seen_from="link1")}
    channels = {name: mbd.identification.Channel(response, deviation=NOISE) for name, response in responses.items()}
    data = {"t": TIMES, "first": shown[0], "second": shown[1]}
    experiment = mbd.identification.Experiment(
        build(TRUTH * OFF), mbd.identification.TimeSeries(data, channels), steps=600
    )
    unknowns = ["link1.mass", "link2.mass", "damper1.damping", "damper2.damping"]
    mbd.identification.identify(experiment, unknowns, max_evaluations=1)  # compiles
    begin = time.perf_counter()
    fit = mbd.identification.identify(experiment, unknowns)
    _say("torchmbd, exact Jacobians", fit.evaluations, time.perf_counter() - begin, fit.x)
    print(f"deviations of the unknowns by torchmbd [%]: {(100.0 * fit.deviation / fit.x).round(2).tolist()}")


def _say(name: str, simulations: int, seconds: float, x: np.ndarray) -> None:
    error = (100.0 * (x / TRUTH - 1.0)).round(2).tolist()
    print(f"{name}: {simulations} simulations, {seconds:.2f} s, errors {error} %")


if __name__ == "__main__":
    main()
