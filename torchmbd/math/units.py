"""Units by name, for files and readers of other formats: each a multiple of an SI unit.

    UNITS["mm"] = (1e-3, "m")     1 mm = 1e-3 m          UNITS["deg"] = (pi / 180, "rad")

Inside torchmbd everything is in SI units and radians. Sources: the inch is 25.4 mm, the pound 0.45359237 kg, standard
gravity 9.80665 m/s2, all by definition. Checked in tests/math/test_units.py.
"""

from __future__ import annotations

import math
import re

INCH, FOOT, POUND, GRAVITY = 0.0254, 0.3048, 0.45359237, 9.80665
NONE = "none"
_NUMBER = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*)")  # and a unit, or ""

#: Name -> (its multiple of the SI unit, SI unit); "" is a plain number.
UNITS: dict[str, tuple[float, str]] = {
    "deg": (math.pi / 180.0, "rad"),
    "rad": (1.0, "rad"),
    "m": (1.0, "m"),
    "cm": (1e-2, "m"),
    "mm": (1e-3, "m"),
    "um": (1e-6, "m"),
    "in": (INCH, "m"),
    "ft": (FOOT, "m"),
    "kg": (1.0, "kg"),
    "g": (1e-3, "kg"),
    "t": (1e3, "kg"),
    "lb": (POUND, "kg"),
    "s": (1.0, "s"),
    "ms": (1e-3, "s"),
    "Hz": (1.0, "Hz"),
    "N": (1.0, "N"),
    "kN": (1e3, "N"),
    "lbf": (POUND * GRAVITY, "N"),
    "Pa": (1.0, "Pa"),
    "kPa": (1e3, "Pa"),
    "MPa": (1e6, "Pa"),
    "GPa": (1e9, "Pa"),
    "psi": (POUND * GRAVITY / INCH**2, "Pa"),
    "kg/m3": (1.0, "kg/m3"),
    "g/cm3": (1e3, "kg/m3"),
    "N/m": (1.0, "N/m"),
    "N/mm": (1e3, "N/m"),
    "J": (1.0, "J"),
    "N m": (1.0, "N m"),
    "m/s": (1.0, "m/s"),
    "mm/s": (1e-3, "m/s"),
    "m/s2": (1.0, "m/s2"),
    "g0": (GRAVITY, "m/s2"),
    "rad/s": (1.0, "rad/s"),
    "deg/s": (math.pi / 180.0, "rad/s"),
    "rpm": (math.pi / 30.0, "rad/s"),
    "K": (1.0, "K"),  # of changes of temperature, as degC and degF: without their zeros
    "degC": (1.0, "K"),
    "degF": (5.0 / 9.0, "K"),
    "K/m": (1.0, "K/m"),
    "K/mm": (1e3, "K/m"),
    "1/K": (1.0, "1/K"),
    "ppm/K": (1e-6, "1/K"),
    NONE: (1.0, ""),
}

_MODULI = ("E", "E1", "E2", "E3", "G12", "G13", "G23", "Xt", "Xc", "Yt", "Yc", "S12", "S13", "S23")
_LENGTHS = ("thickness", "length", "width", "height", "radius", "diameter", "position")
#: SI units that parameters of torchmbd may have, by the last part of their names; others than these may have any.
QUANTITIES: dict[str, tuple[str, ...]] = {
    "angles": ("rad",),
    "density": ("kg/m3",),
    "mass": ("kg",),
    **dict.fromkeys(_MODULI, ("Pa",)),
    **dict.fromkeys(_LENGTHS, ("m",)),
    **dict.fromkeys("xyz", ("m", "N", "N m")),  # of a point, a force, a torque
    "stiffness": ("N/m", "N m"),  # of a spring along a line, about an axis
    "damping": ("s",),  # of a body; that of a damper, N s/m or N m s/rad, has no name here
    **dict.fromkeys(("rest", "lower", "upper"), ("m", "rad")),  # of a spring, of a stop
    **dict.fromkeys(("delay", "duration"), ("s",)),
    "velocity": ("m/s",),
    "angular_velocity": ("rad/s",),
    "speed": ("rad/s", "m/s"),
    "temperature": ("K",),  # its change (multibody/forces/temperature.py)
    **dict.fromkeys(("alpha", "alpha1", "alpha2"), ("1/K",)),
}


def factor(name: str) -> float:
    """The factor from a unit to the SI unit."""
    return UNITS[name][0]


def units_of(si: str) -> list[str]:
    """The names of the units of a quantity, such as those of "m"."""
    return [name for name, (_, base) in UNITS.items() if base == si]


def misfit(parameter: str, unit: str) -> str | None:
    """The reason why a parameter cannot have a unit, None if it can; `none` is the SI unit."""
    units = QUANTITIES.get(parameter.rpartition(".")[2])
    return None if units is None or unit == NONE or UNITS[unit][1] in units else fitting(parameter)


def fitting(parameter: str) -> str:
    """The units that a parameter may have, as words for an error: "must be one of deg, rad, none (SI)".

    A parameter whose name does not tell its quantity may have any unit.
    """
    units = QUANTITIES.get(parameter.rpartition(".")[2])
    names = [name for si in units for name in units_of(si)] if units else [name for name in UNITS if name != NONE]
    return f"must be one of {', '.join(names)}, none (SI)"


def quantity(parameter: str) -> str | None:
    """The SI unit of a parameter, None if its name does not tell it."""
    units = QUANTITIES.get(parameter.rpartition(".")[2], ())
    return units[0] if len(units) == 1 else None


def shown(parameter: str, x: float) -> str:
    """A value [SI] of a parameter, or of an entry of it, for a message: of an angle "0.785398 rad (45 deg)"."""
    is_angle = quantity(parameter.partition("[")[0]) == "rad"
    return f"{x:g} rad ({math.degrees(x):g} deg)" if is_angle else f"{x:g}"


def number_with_unit(text: object) -> tuple[float, str] | None:
    """The number and the unit of a text such as "1 mm"; the unit of "12" is "none". None for anything else."""
    match = _NUMBER.fullmatch(text.strip()) if isinstance(text, str) else None
    if match is None or (match[2] or NONE) not in UNITS:
        return None
    return float(match[1]), match[2] or NONE


def in_si(text: object) -> str:
    """The remedy for a text in place of a number in SI units: "0.001 (m)" for "1 mm"; "" if it is no number with a unit."""
    written = number_with_unit(text)
    if written is None:
        return ""
    number, unit = written
    multiple, si = UNITS[unit]
    return f"{multiple * number:.12g} ({si})" if si else f"{number:.12g}"
