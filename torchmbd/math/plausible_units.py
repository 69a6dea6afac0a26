"""Checks for numbers that are most likely not in meters, kilograms, seconds and radians.

An angle of more than a whole turn is an error: it is probably in degrees, and every fibre direction has a smaller angle. A
bound in degrees that is pi / 4, pi / 2, pi or 2 pi to three digits is an error: it is probably in radians. An unusual length,
modulus or density is a warning, as some structure may have it.

    length, width, extent of a mesh            10 um to 200 m
    dimension of a section                     1 um to 20 m
    thickness of a ply or a wall               10 nm to 0.5 m
    thickness of a plate                       2e-5 to 0.5 of its size
    density                                    10 to 25,000 kg/m3
    speed of sound, of the largest modulus     20 to 30,000 m/s
    modulus                                    1e-6 of the largest at least; as a design or bound 1 kPa to 2 TPa
    strength                                   10 kPa at least; along the fibre 1e-5 of the modulus
    stiffness, damping of a spring             not negative
    damping time of a body                     below that of critical damping of its first mode
    radius of gyration of a rigid body         up to 20 m
    gravity                                    not 9810, 981, 386 or 32.2 m/s2, which is that of the earth in mm, cm, in, ft
    turn of a drive                            from 30 to 360 rad not exactly a multiple of 15 or 20 rad, such as 45, 90, 100

The quantity of a parameter is known from its name: `angles`, `thickness`, `width`, `E1`, `density`.
Checked in tests/math/test_plausible_units.py.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import torch
from torch import Tensor

from torchmbd.errors import InputError, Path, warn

EXTENT = (1e-5, 200.0)  # m
DIMENSION = (1e-6, 20.0)  # m
THICKNESS = (1e-8, 0.5)  # m
SLENDER = (2e-5, 0.5)  # thickness by size
DENSITY = (10.0, 25e3)  # kg/m3
SOUND = (20.0, 30e3)  # m/s
SOFTEST = 1e-6  # modulus by the largest
STRAIN = 1e-5  # strength by modulus
GYRATION = (0.0, 20.0)  # m
MODULUS = (1e3, 2e12)  # Pa
_USUAL = {
    "thickness": ("m", THICKNESS),
    **dict.fromkeys(("radius", "width", "height"), ("m", DIMENSION)),
    **dict.fromkeys(("E", "E1", "E2", "G12", "G13", "G23"), ("Pa", MODULUS)),
    "density": ("kg/m3", DENSITY),
}
_TURNS = {"pi / 4": math.pi / 4.0, "pi / 2": math.pi / 2.0, "pi": math.pi, "2 pi": 2.0 * math.pi}
_LENGTHS = {"mm": 1e-3, "cm": 1e-2, "in": 0.0254, "ft": 0.3048}  # unit -> m
_EARTH, _NEAR_EARTH = 9.807, 0.03  # m/s2: standard gravity, and its range from the equator (9.780) to the poles (9.832)
_IN_DEGREES = (30.0, 360.0)  # multiples of 15 or 20 between them
STRENGTH = (1e4, math.inf)  # Pa
WHOLE_TURN = 2.0 * math.pi * (1.0 + 1e-12)  # 360 degrees, rounded


def check_angles(name: str, values: Iterable[float], outer: str = "", path: Path = ()) -> None:
    """InputError for the first angle [rad] of more than a whole turn or nan.

    outer  text before its name
    path   the keys to the angles; default: the name
    """
    for k, value in enumerate(values):
        if not abs(value) <= WHOLE_TURN:
            hint = f"mbd.deg({value!r}), if it is in degrees" if abs(value) > WHOLE_TURN else ""
            noun, allowed = f"{outer}{name}[{k}]", "must lie in the range -2 pi to 2 pi"
            raise InputError((*(path or (name,)), k), value, allowed, hint, noun=noun, shown=f"{value!r} rad")


def warn_degrees(name: str, value: float) -> None:
    """Warn if a turn of a drive [rad], which may be many turns, is a common number of degrees such as 90."""
    if _IN_DEGREES[0] <= abs(value) <= _IN_DEGREES[1] and (value % 15.0 == 0.0 or value % 20.0 == 0.0):
        warn(f"{name} = {value:g} rad: is this angle in degrees? Try: mbd.deg({value:g}), if it is in degrees")


def warn_gravity(values: Tensor) -> None:
    """Warn if the size of an acceleration of gravity [3], m/s2, is that of the earth in another unit of length."""
    size = float(values.detach().norm())
    for unit, meters in _LENGTHS.items():
        if abs(size * meters - _EARTH) < _NEAR_EARTH:
            warn(f"units of gravity = {size:.6g} m/s2: this is that of the earth in {unit}/s2. Try: numbers in m/s2")


def warn_negative(name: str, value: float, unit: str, consequence: str) -> None:
    """Warn of a negative number of a spring or damper, and of what it does."""
    if value < 0.0:
        warn(f"{name} = {value:g} {unit} is negative: it {consequence}. Try: {-value:g}, if this is a mistake")


def turn_in_radians(degrees: Iterable[float]) -> str | None:
    """The text "1.57 is pi / 2 in radians" for a number of degrees that is a part of a turn to three digits; None if none is.

    The parts are pi / 4, pi / 2, pi and 2 pi: 1.57 degrees is an unlikely bound of an angle; 1.5 or 2 degrees are allowed.
    """
    for value in degrees:
        for name, part in _TURNS.items():
            if f"{abs(value):.3g}" in (f"{part:.3g}", f"{int(part * 100) / 100:.3g}"):
                return f"{value:g} is {name} in radians"
    return None


def check_parameter(what: str, name: str, values: Tensor, path: Path = ()) -> None:
    """Check values of a parameter by the last part of its name; infinite values are missing bounds and ignored.

    what  text before the name in a message
    path  the keys to the values; default: the name
    """
    kind, x = name.rpartition(".")[2], values.detach().flatten()
    finite = torch.where(x.isfinite(), x, 0.0)
    if kind == "angles":
        check_angles(name, finite.tolist(), f"{what} ", path)
    elif kind in _USUAL and bool(finite.any()):
        unit, usual = _USUAL[kind]
        warn_unusual(f"{what} {name}", float(finite.max()), unit, usual)


def warn_unusual(name: str, value: float, unit: str, usual: tuple[float, float]) -> None:
    """Warn with argument, value and usual range if a number is outside of this range."""
    if value < 0.0 < usual[0]:
        warn(f"{name} = {value:.6g} {unit}: must be positive, usually {usual[0]:g} to {usual[1]:g} {unit}".rstrip())
    elif not usual[0] <= value <= usual[1]:
        values = f"at least {usual[0]:g} {unit}" if usual[1] == math.inf else f"{usual[0]:g} to {usual[1]:g} {unit}"
        number = f"{value:.6g} {unit}".rstrip()
        warn(f"units of {name} = {number}, usually {values.rstrip()}. Try: numbers in m, kg, s, N, Pa")


def warn_unusual_material(kind: str, moduli: Mapping[str, float], density: float, strength: float | None) -> None:
    """Warn if moduli [Pa], density [kg/m3] and strength along the fibre [Pa] of a material do not fit each other."""
    largest = max(moduli, key=lambda name: moduli[name])
    softest = min(moduli, key=lambda name: moduli[name])
    high, low = moduli[largest], moduli[softest]
    if not DENSITY[0] <= density <= DENSITY[1]:
        warn_unusual(f"{kind}: density", density, "kg/m3", DENSITY)
    elif not SOUND[0] <= math.sqrt(high / density) <= SOUND[1]:
        usual = (density * SOUND[0] ** 2, density * SOUND[1] ** 2)
        warn_unusual(f"{kind}: {largest}", high, "Pa", usual)
    warn_unusual(f"{kind}: {softest}", low, "Pa", (SOFTEST * high, high))
    if strength is not None and strength >= STRENGTH[0]:  # Strength tells smaller ones
        warn_unusual(f"{kind}: strength along the fibre", strength, "Pa", (STRAIN * moduli["E1"], math.inf))
