"""Checks of the arguments of a laminate: angles (of a section too), plies, thicknesses and the correction of shear.

Checked in tests/fem/materials/test_laminate.py.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.fem.materials.ply import Lamina
from torchmbd.math.checked_numbers import is_real, parameter
from torchmbd.math.plausible_units import THICKNESS, check_angles, warn_unusual


def checked_angles(owner: str, angles: Sequence[float] | Tensor) -> nn.Parameter:
    theta = parameter("angles", angles)
    if theta.ndim != 1 or theta.numel() == 0:
        raise InputError(
            "angles",
            theta,
            "one angle per layer, [layers] rad",
            noun=f"{owner}: angles",
            state=f"has shape {tuple(theta.shape)}",
        )
    check_angles("angles", theta.tolist(), f"{owner}: ")
    return theta


def checked_plies(ply: Lamina | Sequence[Lamina], layers: int) -> list[Lamina]:
    if not isinstance(ply, (Lamina, Sequence)) or isinstance(ply, str):
        raise InputError("ply", ply, "a Ply, or one Ply per layer", noun="Laminate: ply")
    plies = [ply] * layers if isinstance(ply, Lamina) else list(ply)
    for k, p in enumerate(plies):
        if not isinstance(p, Lamina):
            noun = f"Laminate: ply[{k}]"
            raise InputError(("ply", k), p, "a Ply, or one Ply per layer", noun=noun)
    if len(plies) != layers:
        state = f"has {len(plies)} plies for {layers} angles"
        raise InputError("ply", ply, "must have one Ply, or one per angle", noun="Laminate", state=state)
    return plies


def checked_thickness(thickness: float | Sequence[float] | Tensor, layers: int) -> nn.Parameter:
    t = parameter("thickness", thickness)
    if t is thickness and t.ndim == 0:
        raise InputError(
            "thickness",
            thickness,
            "a torch.nn.Parameter of one number per angle [layers] [m], which `links` of a problem may keep equal",
            noun="Laminate: thickness",
            state="is one variable",
        )
    if t is not thickness:  # numbers
        t = nn.Parameter(t.detach().repeat(layers) if t.ndim == 0 else t.detach(), requires_grad=False)
    if t.shape != (layers,):
        state = f"has {t.numel()} thicknesses for {layers} angles"
        raise InputError(
            "thickness", thickness, "must have one number, or one per angle [m]", noun="Laminate", state=state
        )
    for k, value in enumerate(t.tolist()):
        if not 0.0 < value < float("inf"):
            noun = f"Laminate: thickness[{k}]"
            raise InputError(("thickness", k), value, "a finite number > 0", noun=noun, shown=f"{value!r} m")
    warn_unusual("Laminate: thickness", float(t.detach().max()), "m", THICKNESS)
    return t


def checked_correction(value: float | str) -> float | str:
    if value == "energy":
        return "energy"
    if isinstance(value, str) or not is_real(value) or not 0.0 < value <= 1.0:
        raise InputError(
            "shear_correction",
            value,
            "above 0 and at most 1, or the word 'energy'",
            noun="Laminate: shear_correction",
        )
    return float(value)
