"""The arm of three joints with links that bend: steel strips as its authors cut them, our beams, laminates.
`python -m experiments.peers.flexible_arm`

Two links of 500 x 50 x 2 mm carry themselves, turned by two drives in the vertical plane. The authors divide a link into rigid
segments with springs and dampers between them (flexibility_params.yml: EI n / L, and the same times 4.48 ms); ten to a link
are nearly converged. Ours are beams in the place of the two links of the rigid file, of three fixed-interface modes.

FLEXIBLE_ARM_MODELS is the folder `models` of the repository shamilmamedov/flexible_arm. Checked in
tests/experiments/test_flexible_arm.py.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import torch
import yaml
from torch import Tensor

import torchmbd as mbd
from experiments.peers.robots import ARM, folder
from torchmbd.extensions.robots.assembly import robot
from torchmbd.extensions.robots.urdf import urdf_robot

SEGMENTS = {5: "five", 10: "ten"}
POSITIONS = {"active_joint2": 0.4, "active_joint3": -0.8}
TURN, DURATION, STEPS = (0.4, 0.8), 1.2, 480  # [rad] in so many seconds
# flexible_link_params.yml
LENGTH, WIDTH, THICKNESS, E, G, DENSITY, RATE = (
    0.5,
    0.05,
    2e-3,
    190e9,
    74e9,
    7870.0,
    8511e5 / 190e9,
)
LINKS = ("virtual_link2_1", "virtual_link3_1")


def drives() -> dict:
    """The first joint stands still, the others turn upwards."""
    turn = mbd.SmoothStep(*TURN)
    return {"active_joint1": mbd.SmoothStep(0.0, TURN[1]), "active_joint2": turn, "active_joint3": turn}


def segments(models: Path, count: int) -> mbd.System:
    """The arm as its authors cut it; springs and dampers are not in the URDF file."""
    at = models / "three_dof" / f"{SEGMENTS[count]}_segments"
    parts = robot(urdf_robot(at / f"flexible_arm_3dof_{count}s.urdf"), {}, positions=POSITIONS, drives=drives())
    numbers = yaml.safe_load((at / "flexibility_params.yml").read_text())
    passive = [joint for joint in parts["joints"] if joint.name.startswith("passive")]
    for link in "23":
        joints = [joint for joint in passive if joint.name.startswith("passive_joint3_") == (link == "3")]
        for joint, k, c in zip(joints, numbers[f"K{link}"], numbers[f"D{link}"], strict=True):
            name = f"{joint.name}_spring"
            parts["forces"].append(mbd.RotationalSpringDamper(joint.a, joint.b, "z", stiffness=k, damping=c, name=name))
    return mbd.System(**parts)


def beams(models: Path, angles: list[float] | None = None, stiffening: bool = True) -> mbd.System:
    """Links of steel, or of carbon plies of these angles [deg] and the same thickness."""
    flexible = {}
    for number, link in enumerate(LINKS):
        ply = mbd.Ply.isotropic(E, E / (2.0 * G) - 1.0, DENSITY) if angles is None else mbd.examples.carbon()
        plies = [0.0] if angles is None else angles
        section = mbd.sections.strip(WIDTH, ply, mbd.deg(plies), thickness=THICKNESS / len(plies), cells=(8, 1))
        flexible[link] = mbd.FlexibleBody.beam(
            f"strip{number}",
            mbd.BeamLine.straight(LENGTH, elements=20),
            section,
            modes=3,
            reference="start",
            reduction="craig-bampton",
            interface=["end"],
            orientation=(0.0, 0.0, 1.0),
            damping=RATE,
            stiffening=stiffening,
        )
    path = models / "three_dof" / "zero_segments" / "flexible_arm_3dof_0s.urdf"
    return mbd.io.read_urdf(path, flexible=flexible, positions=POSITIONS, drives=drives())


def tip(motion: mbd.Trajectory) -> Tensor:
    """Place of the end of the last link [times, 3]."""
    names = [body.name for body in motion.system.bodies]
    if "strip1" in names:
        return motion.body("strip1").nodes[0, :, -1]
    last = max(
        (name for name in names if name.startswith("virtual_link3")), key=lambda name: int(name.rpartition("_")[2])
    )
    count = sum(name.startswith("virtual_link3") for name in names) - 1
    return motion.body(last).at((0.5 * LENGTH / count, 0.0, 0.0)).position[0]


def report(name: str, system: mbd.System) -> None:
    """Print sag, frequencies and places along the motion."""
    rest = mbd.equilibrium(system)
    motion = mbd.simulate(system, DURATION, steps=STEPS, gradients="none", start="equilibrium").require_ok()
    z = tip(motion)[:, 2]
    sag = 0.15 - float(z[0])  # straight links would end where they begin
    places = "".join(f"{1e3 * float(z[STEPS * k // 6]):9.1f}" for k in (3, 4, 5, 6))
    print(f"{name:26}{1e3 * sag:10.1f}{float(rest.frequencies[0, 0]):9.3f}{places}", flush=True)


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    models = folder(ARM)
    if models is None:
        print(f"{ARM} names no folder; nothing was run")
        return
    times = "".join(f"{f'z({DURATION * k / 6:.1f} s)':>9}" for k in (3, 4, 5, 6))
    print(f"{'links (mm, Hz)':26}{'sag':>10}{'f1':>9}{times}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for count in SEGMENTS:
            report(f"steel, {count} segments each", segments(models, count))
        report("steel, beams", beams(models))
        report("steel, linear beams", beams(models, stiffening=False))
        for angles in ([0.0, 0.0], [20.0, -20.0], [45.0, -45.0]):
            report(f"carbon, {'/'.join(f'{x:.0f}' for x in angles)}", beams(models, angles))


if __name__ == "__main__":
    main()
