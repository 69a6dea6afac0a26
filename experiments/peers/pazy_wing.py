"""The Pazy wing with skin, measured: a root spring fitted to its bending and torsion, and the frequencies that it predicts.
`python -m experiments.peers.pazy_wing [deck] [statics] [vibrations]`

    deck         fem_noskin.bdf, unedited, of the repository UM-A2SRL/AePW3-LDWG, whose folder AEPW3_LDWG names: its frequencies
                 beside those that MSC Nastran printed (sol103_noskin.f06 there)
    statics      an exact beam of the equivalent sections; the stiffness of its root against flapping by both measured curves
    vibrations   the ground vibration test, held out; then the stiffness of the root in the plane by the frequency that is off

Sections, masses, frequencies and curves are those of that repository (00_Models/01_Pazy_Technion/02_Models_Beam and
03_2023_JA_Riso_Cesnik): C. Riso, C. E. S. Cesnik, Journal of Aircraft 2023, measured by O. Avin et al., AIAA Journal 2022,
doi:10.2514/1.J060621. x along the span from the root, y to the leading edge, z up; the line is at 44 % of the chord.
Checked in tests/validation/test_pazy_wing.py.
"""

from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torchmbd as mbd

VARIABLE = "AEPW3_LDWG"
DECK = Path("00_Models/01_Pazy_Technion/01_Models_GFEM/01_Skin0_FlexibleTip")
PRINTED = (4.218742, 28.24921, 40.36126, 81.26779, 107.5089, 132.8187)  # [Hz], sol103_noskin.f06
NODES = [*(0.0382499984 * k for k in range(14)), 0.530718683, 0.549843728]  # [m]
SPAN, CHORD, LINE, SPACING = NODES[-1], 0.1, 0.044, NODES[1]  # [m]; LINE: behind the leading edge
TORSION = [*[7.5826] * 4, *[6.5118] * 4, *[6.5158] * 4, *[7.1189] * 2, 17.373]  # [N m2]
FLAP = [5.2474, 4.5045, 4.4782, 4.4744, 4.4748, *[4.4749] * 5, 4.4747, 4.4762, 4.4892, 4.5482, 4.7704]
LAG = [
    3317.6,
    3278.6,
    3282.9,
    3286.5,
    3288.8,
    3290.1,
    *[3290.7] * 2,
    3290.2,
    3288.9,
    3286.9,
    3283.5,
    3279,
    3271.6,
    3373.7,
]
# [N], [N m], all elements within 4 %; rigid in shear, which is not listed.
AXIAL, AXIAL_LAG, SHEAR = (
    9.65e6,
    5.304e4,
    1e6,
)
MASS, SPREAD, BEHIND = 0.020683 / SPACING, (10.86e-6 / SPACING, 0.114e-6 / SPACING), 0.913e-3  # [kg/m], [kg m], [m]
#: What the last two nodes have beyond the sections: node, mass [kg], center [m], moments of inertia [kg m2].
EXTRA = (
    (14, 0.025448 - 0.01422, (0.0013, 0.0008, 0.0), (7.0e-6, 0.9e-6, 7.0e-6)),
    (15, 0.043156 - 0.00517, (0.0033, -0.0051, 0.0), (1.195e-4, 8.8e-7, 1.2e-4)),
)
UM_NAST = (4.190634, 28.49324, 41.87893, 83.06459, 105.8919)  # [Hz], the beam program of the source, without gravity
UM_NAST_BENT = {1.0: 20.0095, 2.0: 35.4441, 3.0: 46.2444}  # tip mass [kg] -> how far the tip goes down [% of the span]
GROUND_TEST = (4.26, 28.5, 42.0, 60.7, 81.5)  # [Hz]: bending 1, 2, torsion, in the plane, bending 3
ORDER = (1, 2, 3, 5, 4)  # the modes of the model that they are, by their shapes in the source
BEHIND_TRAILING_EDGE = 0.08  # [m], where the mass of the torsion test hangs
#: Tip mass [kg]; how far the middle of the tip goes down [% of the span]; twist [deg]. Digitized from the source's figures.
BENDING = (
    [0.2 * k for k in range(16)],
    [
        0.0, 4.2519, 8.4216, 12.4874, 16.4542, 21.1515, 24.4658, 28.4852, 31.8348, 34.9030, 37.7337, 40.3940, 43.5865, 45.8958,
        48.0686, 50.0870,
    ],
)  # fmt: skip
TWISTING = (
    [0.2 * k for k in range(15) if k != 8],
    [
        0.0, 4.8146, 9.5055, 13.9742, 18.3299, 22.1648, 26.0141, 29.4053, 35.5869, 38.2087, 40.7148, 43.0704, 45.1028, 47.0015,
    ],
    [
        0.0, 1.0435, 2.0585, 2.9951, 3.9460, 4.8356, 5.6058, 6.2688, 7.4033, 8.0056, 8.4102, 8.7658, 9.0239, 9.2185,
    ],
)  # fmt: skip
DEVIATION, ZERO = 5e-3, 5e-4  # [m] or [-], chosen; the first number of a curve is zero by definition
WEIGHTLESS = 1e-4  # [kg] for no mass
RIGID = 1e6  # [N m/rad]


def section(k: int) -> mbd.GivenSection:
    """The section of element k."""
    K = np.diag([AXIAL, SHEAR, SHEAR, TORSION[k], FLAP[k], LAG[k]])
    K[0, 5] = K[5, 0] = AXIAL_LAG
    across, up = SPREAD[0] + MASS * BEHIND**2, SPREAD[1]
    M = np.diag([MASS, MASS, MASS, across + up, up, across])
    M[0, 5] = M[5, 0] = MASS * BEHIND
    M[2, 3] = M[3, 2] = -MASS * BEHIND
    return mbd.GivenSection(K.tolist(), M.tolist())


def wing(flap: Any, lag: Any = RIGID, gravity: float = 9.80665, weight: Any = None, behind: float = 0.0) -> mbd.System:
    """The wing on a root that turns about y against `flap` and about z against `lag` [N m/rad].

    weight   mass at the tip [kg], `behind` the line [m]; None: there is none
    """
    elements = torch.tensor([[k, k + 1] for k in range(len(TORSION))])
    line = mbd.BeamLine(torch.tensor([[x, 0.0, 0.0] for x in NODES], dtype=torch.float64), elements)
    beam = mbd.FlexibleBeam("wing", line, [section(k) for k in range(len(TORSION))])
    ground, bodies = (
        mbd.Ground(),
        [mbd.RigidBody(f"extra_{k}", m, I, center=c, position=(NODES[k], 0, 0)) for k, m, c, I in EXTRA],
    )
    places = [k for k, *_ in EXTRA]
    if weight is not None:
        bodies.append(mbd.RigidBody("weight", weight, (1e-6,) * 3, center=(0, -behind, 0), position=(SPAN, 0, 0)))
        places.append(len(TORSION))
    fixed = [mbd.Fixed(beam.at(k), body.at(), name=f"{body.name}_on") for k, body in zip(places, bodies, strict=True)]
    root = mbd.Spherical(ground.at(), beam.at(0), name="root")
    spring = mbd.Bushing(ground.at(), beam.at(0), stiffness=0.0, turning_stiffness=(RIGID, flap, lag), name="clamp")
    return mbd.System([beam, *bodies], [root, *fixed], [spring], gravity=(0, 0, -gravity))


def height(behind: float) -> mbd.Position:
    """The height of a point of the tip behind its leading edge [m]."""
    return mbd.Position(f"wing_{len(TORSION)}", "z", point=(0, LINE - behind, 0))


def statics() -> dict[str, mbd.identification.Experiment]:
    """Both curves; displacements are those since the wing hung by itself, which is an unknown offset."""

    def channel(response: Any, count: int) -> mbd.identification.Channel:
        deviation = np.array([ZERO, *[DEVIATION] * (count - 1)])
        return mbd.identification.Channel(response, offset=mbd.variable(0.0), deviation=deviation)

    middle = height(0.5 * CHORD)
    sine = (height(0.0) - height(CHORD)) * (1.0 / CHORD)  # of the twist, as the source has it from both edges
    result = {}
    for name, (masses, down, *twist), behind in (
        ("bending", BENDING, 0.5 * CHORD - LINE),
        ("torsion", TWISTING, CHORD - LINE + BEHIND_TRAILING_EDGE),
    ):
        table: dict[str, Any] = {"mass": np.maximum(masses, WEIGHTLESS), "down": -0.01 * SPAN * np.array(down)}
        channels = {"down": channel(middle, len(masses))}
        if twist:
            table["sine"], channels["sine"] = np.sin(np.deg2rad(twist[0])), channel(sine, len(masses))
        system = wing(mbd.variable(1e3), weight=mbd.variable(0.5), behind=behind)
        result[name] = mbd.identification.Experiment(
            system, mbd.identification.StaticCurve(table, {"weight.mass": "mass"}, channels)
        )
    return result


def ground_test(flap: Any, lag: Any = RIGID) -> mbd.identification.Experiment:
    """The measured frequencies, of the wing upright."""
    return mbd.identification.Experiment(
        wing(flap, lag, gravity=0.0), mbd.identification.ModalData(GROUND_TEST, modes=ORDER)
    )


def fit() -> mbd.identification.Identification:
    """The stiffness of the root by both curves; the frequencies are held out."""
    held_out = {"ground test": ground_test(mbd.variable(1e3))}
    return mbd.identification.identify(statics(), ["clamp.turning_stiffness_y"], validation=held_out)


def fit_in_the_plane() -> mbd.identification.Identification:
    """The stiffness of the root in the plane by its frequency."""
    data = mbd.identification.ModalData(GROUND_TEST[3:4], modes=[4])
    experiment = mbd.identification.Experiment(wing(RIGID, mbd.variable(1e4), gravity=0.0), data)
    return mbd.identification.identify(experiment, ["clamp.turning_stiffness_z"])


def frequencies(flap: float = RIGID, lag: float = RIGID) -> np.ndarray:
    """The lowest five [Hz], in the order of the model."""
    return mbd.equilibrium(wing(flap, lag, gravity=0.0)).frequencies[0, :5].detach().numpy()


def bent(mass: float, flap: float = RIGID) -> float:
    """How far the middle of the tip goes down under a mass there [% of the span]."""
    behind = 0.5 * CHORD - LINE
    z = [float(height(0.5 * CHORD)(mbd.equilibrium(wing(flap, weight=m, behind=behind)))) for m in (WEIGHTLESS, mass)]
    return 100.0 * (z[0] - z[1]) / SPAN


def deck() -> Path | None:
    """The folder of the deck, where AEPW3_LDWG says so."""
    folder = os.environ.get(VARIABLE)
    return Path(folder) / DECK if folder and (Path(folder) / DECK / "fem_noskin.bdf").is_file() else None


def deck_frequencies(folder: Path) -> np.ndarray:
    """The lowest six of the deck as it is [Hz]."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a material of its rods has hardly any mass
        body = mbd.io.read_bdf(folder / "sol103_noskin.dat", "wing", modes=6)
    return mbd.natural_frequencies(body, None, len(PRINTED)).frequencies.detach().numpy()


def compare(title: str, reference: Any, model: Any) -> None:
    """Print numbers of the model beside others."""
    pairs = "  ".join(f"{x:.2f} ({100.0 * (x / y - 1.0):+.1f} %)" for x, y in zip(model, reference, strict=True))
    print(f"{title:30}{pairs}")


def main(words: list[str]) -> None:
    """Print what is asked for; all without words."""
    words = words or ["deck", "statics", "vibrations"]
    if "deck" in words:
        if (folder := deck()) is None:
            print(f"{VARIABLE} is not the folder of the repository UM-A2SRL/AePW3-LDWG; its deck was not read")
        else:
            compare("deck, beside MSC Nastran", PRINTED, deck_frequencies(folder))
    if "statics" in words:
        compare("beam, clamped, beside UM/NAST", UM_NAST, frequencies())
        compare("bent by 1, 2, 3 kg", UM_NAST_BENT.values(), [bent(mass) for mass in UM_NAST_BENT])
        print(result := fit())
        if "vibrations" in words:
            hertz = result.validation_problem.predictions(result.validation_residuals.values)  # type: ignore[union-attr]
            compare("held out, root of the fit", GROUND_TEST, hertz)
    if "vibrations" in words:
        compare("held out, clamped", GROUND_TEST, frequencies()[np.array(ORDER) - 1])
        lag = fit_in_the_plane()["clamp.turning_stiffness_z"]
        compare(f"{lag:.0f} N m/rad in the plane", GROUND_TEST, frequencies(lag=lag))


if __name__ == "__main__":
    main(sys.argv[1:])
