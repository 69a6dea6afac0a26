"""Tables and splines of SciPy as laws: as torch operations they work, else they are refused by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline, CubicSpline, PchipInterpolator, make_interp_spline

import torchmbd as mbd
from tests.refused import refused

T = np.linspace(0.0, 0.5, 26)
Y = 0.3 * np.sin(10.0 * T) + 0.1 * T  # its slope at t = 0 is not zero
SPLINE = CubicSpline(T, Y)
GROUND = mbd.Ground()
BOB = mbd.RigidBody("bob", 1.0, (1.0, 1.0, 1.0))
BASIS = make_interp_spline(T, Y)
assert isinstance(BASIS, BSpline)

TABLES: dict[str, Any] = {
    "spline": SPLINE,
    "pchip": PchipInterpolator(T, Y),
    "basis": BASIS,
    "interp": lambda t: np.interp(float(t), T, Y),
    "interp as tensor": lambda t: torch.tensor(np.interp(float(t), T, Y), dtype=torch.float64),
    "spline as tensor": lambda t: torch.as_tensor(SPLINE(t.detach().numpy())),
    "array": np.column_stack([T, Y]),
    "tensor": torch.tensor(np.stack([T, Y])),
    "list": [*zip(T.tolist(), Y.tolist(), strict=True)],
}


def _of_motion(law: Any) -> Any:
    """A function of time as one of s, s' and t."""
    return (lambda s, rate, t: law(t)) if type(law) is type(_of_motion) else law


OWNERS: dict[str, Callable[[Any], Any]] = {
    "motor.angle": lambda law: mbd.Drive(GROUND, BOB, axis="z", angle=law, name="motor"),
    "motor.position": lambda law: mbd.Drive(GROUND, BOB, axis="z", position=law, name="motor"),
    "push.vector": lambda law: mbd.Force(BOB.at(), law, name="push"),
    "spring.law": lambda law: mbd.SpringDamper(GROUND.at(-1, 0, 0), BOB.at(), law=_of_motion(law), name="spring"),
}


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize("owner", OWNERS)
def test_tables_are_refused_by_name(owner: str, table: str) -> None:
    with refused(owner) as caught:
        OWNERS[owner](TABLES[table])
    assert ": must " in str(caught.value)
    if owner.startswith("motor"):
        assert "as torch operations on its x and c" in str(caught.value)
        assert len(str(caught.value)) < 400


@pytest.mark.thorough
def test_a_spline_in_torch_drives_a_joint() -> None:
    knots, c = torch.tensor(SPLINE.x), torch.tensor(SPLINE.c)

    def law(t: torch.Tensor) -> torch.Tensor:
        k = torch.searchsorted(knots, t.detach(), right=True).clamp(1, len(knots) - 1) - 1
        s = t - knots[k]
        return ((c[0, k] * s + c[1, k]) * s + c[2, k]) * s + c[3, k]

    hinge = mbd.Revolute(GROUND.at(), BOB.at(), axis="z")
    drive = mbd.Drive(GROUND, BOB, axis="z", angle=law, name="motor")
    motion = mbd.simulate(mbd.System([BOB], [hinge, drive]), 0.5, steps=100, gradients="none", backend="eager")
    angle = mbd.Angle("bob", "z")(motion)[0]
    np.testing.assert_allclose(angle.numpy(), SPLINE(motion.t.numpy()), atol=1e-9)
