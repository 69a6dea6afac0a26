"""Strips of graphite/epoxy bent far by weights: measured curves, a nominal model, and moduli fitted to two of three beams.

    measured   u1 (towards the clamp), u2 (aside), u3 (down) at 500 mm of 550 mm, under weights at the tip of up to 500 g; the
               clamp is turned by 0 or 45 degrees about the beam. P. Minguet, J. Dugundji, Experiments and analysis for
               composite blades under large deflections, part I, AIAA Journal 28 (1990) 1573-1579, doi:10.2514/3.25255, as
               digitized in luizpancini/AeroBeams.jl, test/referenceData/compositeCantileverMD
    nominal    6 x 6 stiffness of the sections, printed in the paper (AeroBeams.jl, test/examples/compositeCantileverMD.jl)
    fitted     E1, E2, G12 of the plies of beams 1 and 2; beam 3 is held out

The paper itself was not at hand: layups, width and the moduli where the fit begins are as commonly quoted for it, unchecked. A
thickness of 0.134 mm of a ply is inferred: with 142 GPa it gives the E A of the sections of beams 1 and 2; the coupling of
extension and torsion of beam 3 comes out twice that of its section. Bending alone sees E h^3: another thickness would scale
the moduli, and predict the same.
`python -m experiments.peers.composite_strips`. Checked in tests/validation/test_composite_strips.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

import torchmbd as mbd

LENGTH, WIDTH, PLY = 0.55, 0.03, 0.134e-3  # [m]
ELEMENTS, NODE, AT = 11, 10, 0.5  # the node at 500 mm
GRAVITY = 9.80665
DEVIATION = 4e-3  # [m], chosen: about what fits leave; all curves weigh alike
SYMMETRIC, HALF = [0, 90] * 3, [20, -70, -70, 20] * 2
LAYUPS = {
    1: SYMMETRIC + SYMMETRIC[::-1],  # [0/90]3s
    2: [45, 0] * 3 + [0, 45] * 3,  # [45/0]3s
    3: HALF + [-angle for angle in HALF[::-1]],  # [20/-70/-70/20]2a
}
# N, V_y, V_z, T, M_y, M_z.
DIAGONALS = {
    1: (3.7e6, 2.6e5, 2.9e5, 0.183, 0.707, 276.0),
    2: (4.0e6, 2.6e5, 5.5e5, 0.368, 0.522, 298.0),
    3: (3.9e6, 1.1e6, 1.2e5, 1.18, 0.983, 290.0),
}
COUPLINGS = {1: {}, 2: {(0, 1): -2.7e5, (3, 4): -0.102}, 3: {(0, 3): -522.0}}
MODULI = {"E1": 142e9, "E2": 9.8e9, "G12": 6.0e9}  # as commonly quoted, where the fit begins
NAMES, FITTED, HELD_OUT = ("u1", "u2", "u3"), ("u2", "u3"), 3
ALL = (20, 50, 100, 200, 300, 400)  # [g]
# Beam, angle of the clamp [deg], direction -> weights [g], displacements [mm].
MEASURED: dict[tuple[int, int, str], tuple[Sequence[float], Sequence[float]]] = {
    (1, 0, "u1"): ((150, 200, 400), (6.3416, 21.143, 61.205)),
    (1, 0, "u2"): ((20, 50, 150, 200, 400), (0, 0, 0, 0, 0)),
    (1, 0, "u3"): ((20, 50, 75, 100, 150, 200, 400), (14.125, 35.861, 53.245, 69.113, 101.43, 130.90, 217.90)),
    (1, 45, "u1"): ((20, 50, 75, 200, 400), (2.3808, 2.3385, 3.1351, 12.976, 45.737)),
    (1, 45, "u2"): ((50, 200, 400), (18.220, 67.814, 114.16)),
    (1, 45, "u3"): ((20, 50, 75, 200, 400), (6.7371, 13.410, 26.327, 73.175, 149.42)),
    (2, 0, "u1"): (ALL, (2.6543, 10.009, 22.540, 55.203, 85.697, 117.00)),
    (2, 0, "u2"): (ALL[1:], (2.2662, 4.8209, 10.209, 20.075, 21.267)),
    (2, 0, "u3"): (ALL, (20.588, 50.971, 97.190, 166.32, 213.43, 244.94)),
    (2, 45, "u1"): (ALL, (1.1221, 3.5066, 8.9373, 24.625, 46.005, 68.483)),
    (2, 45, "u2"): (ALL, (10.741, 26.779, 48.837, 87.056, 116.21, 139.74)),
    (2, 45, "u3"): (ALL, (11.484, 26.358, 49.642, 90.496, 125.63, 154.29)),
    (3, 0, "u1"): ((*ALL[2:], 500), (4.7911, 17.286, 34.247, 50.538, 66.382)),
    (3, 0, "u2"): ((*ALL[2:], 500), (0, 0, 0, 0, 0)),
    (3, 0, "u3"): ((*ALL, 500), (11.276, 27.245, 52.915, 102.04, 145.09, 179.67, 208.79)),
    (3, 45, "u1"): ((*ALL, 500), (0.96421, 2.2754, 2.9817, 8.5289, 18.009, 29.204, 43.020)),
    (3, 45, "u2"): ((*ALL, 500), (6.4094, 13.887, 25.751, 52.968, 76.098, 97.234, 115.28)),
    (3, 45, "u3"): ((*ALL, 500), (6.3917, 13.699, 26.949, 53.838, 80.046, 106.25, 128.76)),
}


def nominal(beam: int) -> mbd.GivenSection:
    """The section of a beam in the paper; its mass does not matter."""
    stiffness = np.diag(DIAGONALS[beam])
    for (i, j), x in COUPLINGS[beam].items():
        stiffness[i, j] = stiffness[j, i] = x
    return mbd.GivenSection(stiffness.tolist(), (1e-3 * np.eye(6)).tolist())


def laminated(beam: int, moduli: Mapping[str, float]) -> Any:
    """The section of a beam as plies, whose moduli are unknowns."""
    unknown: dict[str, Any] = {name: mbd.variable(x) for name, x in moduli.items()}
    ply = mbd.Ply(**unknown, G13=6.0e9, G23=3.4e9, nu12=0.3, density=1580.0)
    return mbd.sections.strip(WIDTH, ply, mbd.deg(LAYUPS[beam]), PLY, cells=(6, 1))


def strip(section: Any, angle: float, elements: int = ELEMENTS) -> mbd.System:
    """A beam whose clamp is turned by an angle [deg] about it, with a weight at its tip: `weight.z`, up [N]."""
    across = (0.0, math.cos(math.radians(angle)), math.sin(math.radians(angle)))
    beam = mbd.FlexibleBeam("strip", mbd.BeamLine.straight(LENGTH, elements), section, orientation=across)
    clamp = mbd.Fixed(mbd.Ground().at(), beam.at("start"), name="clamp")
    return mbd.System([beam], [clamp], [mbd.Force(beam.at("end"), (0, 0, mbd.variable(0.0)), name="weight")])


def channel(name: str) -> mbd.identification.Channel:
    """A displacement at 500 mm [m], with the sign of the paper."""
    axis, gain, offset = {"u1": ("x", -1.0, AT), "u2": ("y", 1.0, 0.0), "u3": ("z", -1.0, 0.0)}[name]
    return mbd.identification.Channel(
        mbd.Position("strip", axis, node=NODE), gain=gain, offset=offset, deviation=DEVIATION
    )


def experiment(section: Any, beam: int, angle: int) -> mbd.identification.Experiment:
    """A beam with u2 and u3 that were measured, those that symmetry makes zero left out."""
    curves = {name: MEASURED[beam, angle, name] for name in FITTED if any(MEASURED[beam, angle, name][1])}
    weights = sorted({x for grams, _ in curves.values() for x in grams})
    table = {"load": [-1e-3 * GRAVITY * x for x in weights]}
    for name, (grams, values) in curves.items():
        by_weight = dict(zip(grams, values, strict=True))
        table[name] = [1e-3 * by_weight.get(x, math.nan) for x in weights]
    channels = {name: channel(name) for name in curves}
    return mbd.identification.Experiment(
        strip(section, angle), mbd.identification.StaticCurve(table, {"weight.z": "load"}, channels)
    )


def fit() -> mbd.identification.Identification:
    """E1, E2, G12 by u2 and u3 of beams 1 and 2; beam 3 is held out."""
    cases = {
        beam: {f"{beam}, {angle} deg": experiment(laminated(beam, MODULI), beam, angle) for angle in (0, 45)}
        for beam in LAYUPS
    }
    unknowns = [f"strip.section.ply.{name}" for name in MODULI]
    return mbd.identification.identify({**cases[1], **cases[2]}, unknowns, validation=cases[HELD_OUT])


def moduli_of(result: mbd.identification.Identification) -> dict[str, float]:
    """E1, E2, G12 of a fit [Pa]."""
    return {name: result[f"strip.section.ply.{name}"] for name in MODULI}


def displacements(section: Any, angle: float, grams: Sequence[float], elements: int = ELEMENTS) -> np.ndarray:
    """u1, u2, u3 at 500 mm under weights [weights, 3] [mm]; elements: a multiple of 11."""
    load = -1e-3 * GRAVITY * torch.tensor(grams, dtype=torch.float64)
    rest = mbd.equilibrium(strip(section, angle, elements), designs={"weight.z": load}, follow=True)
    node = rest.body("strip").nodes[:, 0, NODE * elements // ELEMENTS].detach().numpy()
    return 1e3 * (node - [AT, 0.0, 0.0]) * [-1.0, 1.0, -1.0]


def errors(section: Any, beam: int) -> dict[tuple[int, str], float]:
    """Largest error of a curve over its range [%], by angle and direction; of those that are zero in mm."""
    result = {}
    for angle in (0, 45):
        weights = sorted({x for name in NAMES for x in MEASURED[beam, angle, name][0]})
        model = dict(zip(weights, displacements(section, angle, weights), strict=True))
        for k, name in enumerate(NAMES):
            grams, values = MEASURED[beam, angle, name]
            worst = max(abs(model[x][k] - y) for x, y in zip(grams, values, strict=True))
            result[angle, name] = float(100.0 * worst / np.ptp(values) if any(values) else worst)
    return result


def main() -> None:
    """Print the moduli and the errors of all curves."""
    result = fit()
    moduli = moduli_of(result)
    print(f"{result.status}, {result.evaluations} simulations with Jacobians")
    for (name, x), (low, high) in zip(moduli.items(), result.interval, strict=True):
        print(f"{name:4}{1e-9 * x:6.1f} GPa, 95 %: {1e-9 * low:.1f} to {1e-9 * high:.1f}")
    print(f"{'largest error over the range of the curve [%]':53}{'nominal':>10}{'fit':>10}")
    for beam in LAYUPS:
        before, after = errors(nominal(beam), beam), errors(laminated(beam, moduli), beam)
        role = "held out" if beam == HELD_OUT else "in the fit"
        for (angle, name), x in before.items():
            size = np.ptp(MEASURED[beam, angle, name][1])
            if not size:
                print(f"beam {beam}, {angle:2} deg, {name}: measured as zero, {x:.2f} and {after[angle, name]:.2f} mm")
                continue
            what = f"beam {beam}, {angle:2} deg, {name}, range {size:5.1f} mm"
            print(f"{what + (f', {role}' if name in FITTED else ''):53}{x:10.1f}{after[angle, name]:10.1f}")


if __name__ == "__main__":
    main()
