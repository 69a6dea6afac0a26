"""Robots of public URDF files, unedited, against the recursion of Newton and Euler.
`python -m experiments.peers.robots [arm] [all]`

    arm   the arm of three joints of the repository shamilmamedov/flexible_arm; FLEXIBLE_ARM_MODELS is its folder `models`
    all   every URDF file of the repository Gepetto/example-robot-data; EXAMPLE_ROBOT_DATA is its folder `robots`

Positions within the limits and velocities are drawn; compared are the accelerations of all links, of their origins and of
their angular velocities. Checked in tests/experiments/test_robots.py.
"""

from __future__ import annotations

import os
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

import torchmbd as mbd
from experiments.peers.newton_euler import Tree
from torchmbd.extensions.robots.urdf import urdf_robot

ARM, ALL = "FLEXIBLE_ARM_MODELS", "EXAMPLE_ROBOT_DATA"
ARM_FILES = tuple(
    Path("three_dof") / f"{name}_segments" / f"flexible_arm_3dof_{count}s.urdf"
    for name, count in (("zero", 0), ("one", 1), ("five", 5))
)
SHOWN = ("ur5_robot.urdf", "panda.urdf", "a1.urdf", "pr2.urdf", "talos_full_v2.urdf", "tiago_dual.urdf")
STEP = 1e-6  # [s] of the one step whose start is compared


def folder(variable: str) -> Path | None:
    """The folder that a variable names."""
    named = os.environ.get(variable)
    return Path(named) if named and Path(named).is_dir() else None


@dataclass(frozen=True)
class Compared:
    """Largest difference of accelerations, over the largest one or 1 m/s2, 1 rad/s2; numbers of coordinates and stops."""

    coordinates: int
    stops: int
    turning: float
    moving: float


def draw(tree: Tree, seed: int) -> tuple[dict[str, float], dict[str, float]]:
    """Positions in the middle parts of the limits, and velocities of about 1 rad/s or 0.1 m/s."""
    generator = np.random.default_rng(seed)
    q, rate = {}, {}
    for joint in (joint for joint in tree.joints if joint.kind != "fixed"):
        lower, upper = (max(joint.limits[0], -3.0), min(joint.limits[1], 3.0))
        middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
        q[joint.name] = middle + 0.8 * half * generator.uniform(-1.0, 1.0)
        if joint.coordinate >= 0:
            rate[joint.name] = generator.normal() * (0.1 if joint.kind == "prismatic" else 1.0)
    return q, rate


def compared(path: Path, seed: int = 1) -> Compared:
    """The system of a file next to the recursion; joints that mimic others are locked. InputError where it is refused."""
    locked = [joint.name for joint in urdf_robot(path).joints if joint.mimics]
    tree = Tree(path, locked)
    q, rate = draw(tree, seed)
    system = mbd.io.read_urdf(path, positions=q, velocities=rate, locked=locked)
    motion = mbd.simulate(system, STEP, steps=1, gradients="none", backend="eager")
    expected, links = tree.accelerations(q, rate)
    by_name = {"".join(c if c.isalnum() else "_" for c in name): x for name, x in links.items()}
    turning, moving, largest = 0.0, 0.0, [1.0, 1.0]
    for body in system.bodies:
        place, spin = by_name[body.name.removeprefix("_") if body.name not in by_name else body.name]
        view = motion.body(body.name)
        ours = view.at((0.0, 0.0, 0.0)).acceleration[0, 0].numpy(), view.omega_rate[0, 0].numpy()
        moving = max(moving, float(np.abs(ours[0] - place).max()))
        turning = max(turning, float(np.abs(ours[1] - spin).max()))
        largest = [max(x, float(np.abs(y).max())) for x, y in zip(largest, (place, spin), strict=True)]
    stops = sum(isinstance(force, (mbd.RotationalStop, mbd.AxialStop)) for force in system.forces)
    return Compared(len(expected), stops, turning / largest[1], moving / largest[0])


def row(name: str, comparison: Compared) -> str:
    """A line of the table."""
    return (
        f"{name:34}{comparison.coordinates:12}{comparison.stops:7}{comparison.turning:14.1e}{comparison.moving:15.1e}"
    )


def run(files: list[Path]) -> tuple[dict[str, Compared], list[str]]:
    """Files that are read, and lines about those that are refused."""
    read, refused = {}, []
    for path in files:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                read[str(path.relative_to(path.parents[2]))] = compared(path)
            except mbd.InputError as error:
                refused.append(f"  {path.name}: {str(error).removeprefix(f'{path.name}: ').partition(': must ')[0]}")
    return read, refused


def main(words: list[str]) -> None:
    """Compare all files that are found."""
    torch.set_num_threads(1)
    print(f"{'file':34}{'coordinates':>12}{'stops':>7}{'spin rates':>14}{'accelerations':>15}")
    for word in words or ("arm", "all"):
        variable = ARM if word == "arm" else ALL
        base = folder(variable)
        if base is None:
            print(f"{variable} names no folder; nothing was run")
            continue
        read, refused = run([base / name for name in ARM_FILES] if word == "arm" else sorted(base.rglob("*.urdf")))
        for name, comparison in read.items():
            if word == "arm" or Path(name).name in SHOWN:
                print(row(Path(name).name, comparison))
        if word == "all":
            largest = [
                max(getattr(x, key) for x in read.values()) for key in ("coordinates", "stops", "turning", "moving")
            ]
            print(row(f"largest of {len(read)} files", Compared(*largest)))
            print(f"refused, {len(refused)} files:", *refused, sep="\n")


if __name__ == "__main__":
    main(sys.argv[1:])
