"""Exact beams beside published figures: `python -m tests.validation.beam_report`.

Sources: test_exact_beam.py, test_flexible_beam.py, beam_motions.py, tests/fem/exact_beam/test_vibrations.py. Beams in motion,
and those that rotate, are bodies of systems.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch

import torchmbd as mbd
from tests.fem.exact_beam.cases import bend, given, matrix, twisted
from tests.fem.exact_beam.test_vibrations import INCH, blade
from tests.multibody.equilibrium.test_steady_rotation import rotor
from tests.validation.beam_motions import PEAKS, right_angle
from tests.validation.test_flexible_beam import spin_up

Row = tuple[str, str, float, float]


def statics() -> Iterator[Row]:
    """Deflections."""
    rod = mbd.ExactBeam("rod", mbd.BeamLine.straight(1.0, 3), given(1e4, 1e4, 1e4, 1.0, 0.5, 0.5))
    tip = rod.equilibrium({"end": (0.0, 0.0, 0.0, 0.0, 0.5 * math.pi, 0.0)}).nodes[-1]  # half a circle
    yield "roll-up, 3 elements", "z of the tip, half a circle", -2.0 / math.pi, float(tip[2])
    tip = bend(8).equilibrium({"end": (0.0, 0.0, 600.0)}).nodes[-1]
    for axis, expected, result in zip("xyz", (47.23, 15.79, 53.37), tip.tolist(), strict=True):
        yield "45-degree bend, 8 elements (Simo and Vu-Quoc)", f"{axis} of the tip", expected, result
    moved = twisted(32).equilibrium({"end": (0.0, 0.0, -4e6)}).nodes[-1] - torch.tensor([10.0, 0.0, 0.0])
    for axis, expected, result in zip("xyz", (-1.132727, -1.715123, -3.578671), moved.tolist(), strict=True):
        yield "twisted beam of BeamDyn, 32 elements (5th order)", f"{axis} of the tip", expected, result


def motions() -> Iterator[Row]:
    """Bodies of systems."""
    motion = mbd.simulate(right_angle(10), 20.0, steps=400, gradients="none").require_ok()
    across = motion.body("frame").nodes[0, :, :, 2]
    for where, (start, end), expected in PEAKS:
        own = across[(motion.t >= start) & (motion.t <= end), 10 if where == "elbow" else -1]
        yield (
            "right-angle cantilever, 2 x 10 elements",
            f"peak of the {where}",
            expected,
            float(own[own.abs().argmax()]),
        )
    section = given(2.8e7, 1e7, 1e7, 2.8e4, 1.4e4, 1.4e4, mass=matrix(1.2, 1.2, 1.2, 1.2e-3, 6e-4, 6e-4))
    beam = mbd.FlexibleBeam("blade", mbd.BeamLine.straight(10.0, 8), section)
    hinge = mbd.Revolute(mbd.Ground().at(), beam.at("start"), axis="z", name="hinge")
    drive = mbd.Drive(mbd.Ground().at(), beam.at("start"), axis="z", angle=spin_up)
    motion = mbd.simulate(mbd.System([beam], [hinge, drive]), 20.0, steps=2000, gradients="none").require_ok()
    angle, (x, y, _) = spin_up(motion.t), motion.body("blade").nodes[0, :, -1].T
    out, lag = angle.cos() * x + angle.sin() * y - 10.0, angle.sin() * x - angle.cos() * y
    yield "spin-up to 6 rad/s, 8 elements", "largest lag", 0.57, float(lag.max())
    yield "spin-up to 6 rad/s, 8 elements", "stretch", 5.14e-4, float(out[-300:].mean())


def rotating() -> Iterator[Row]:
    """Frequencies that a turning observer sees."""
    for speed, expected in ((4.0, (5.5850, 24.2734)), (12.0, (13.1702, 37.6031))):
        section = given(1e6, 1e6, 1e6, 1e3, 1.0, 1.0, mass=matrix(1.0, 1.0, 1.0, 2e-8, 1e-8, 1e-8))
        beam = mbd.FlexibleBeam("rotor", mbd.BeamLine.straight(1.0, 16), section)
        w = 2.0 * math.pi * mbd.equilibrium(rotor(beam, speed), spin=(0.0, 0.0, speed)).vibrations[0].frequencies[:4]
        for k, value in enumerate(expected):
            name = "rotating cantilever, 16 elements (Wright et al.)"
            yield name, f"speed {speed:g}, flapping {k + 1}", value, _nearest(w, value)
    measured = {
        (0.0, 0.0): (1.4, 10.3, 27.7),
        (0.0, 500.0): (10.2, 25.2, 47.0),
        (0.0, 750.0): (14.8, 36.1, 62.9),
        (45.0, 0.0): (1.6, 10.4, 24.8),
        (45.0, 750.0): (14.7, 26.1, 44.8),
    }
    for (sweep, rpm), expected in measured.items():
        alone, _ = blade(math.radians(sweep))
        speed, offset = rpm * math.pi / 30.0, 2.5 * INCH
        beam = mbd.FlexibleBeam("blade", alone.mesh, alone.section, position=(offset, 0.0, 0.0))
        system = rotor(beam, speed, offset)
        result = mbd.equilibrium(system, spin=(0.0, 0.0, speed)).vibrations[0].frequencies[:6]
        for k, value in enumerate(expected):
            name = f"blade of Epps and Chandra, tip swept by {sweep:g} degrees"
            yield name, f"{rpm:g} rpm, {k + 1} (measured) [Hz]", value, _nearest(result, value)


def _nearest(found: torch.Tensor, wanted: float) -> float:
    return float(found[(found - wanted).abs().argmin()])


def main() -> None:
    torch.set_num_threads(1)
    print(f"{'problem':52s} {'quantity':30s} {'reference':>10s} {'found':>10s}  ratio")
    for part in (statics, motions, rotating):
        for problem, quantity, expected, found in part():
            print(f"{problem:52s} {quantity:30s} {expected:10.5g} {found:10.5g}  {found / expected:.4f}", flush=True)


if __name__ == "__main__":
    main()
