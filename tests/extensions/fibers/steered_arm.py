"""The arm of the examples with fibers that steer."""

from __future__ import annotations

import torchmbd as mbd


def steered_arm() -> mbd.System:
    """Six controls, straight at the start: "arm.laminate.angles" [6, 2]."""
    field = mbd.fibers.FiberField(mbd.examples.arm().body("arm").mesh, controls=(3, 2), degree=1)
    laminate = mbd.fibers.SteeredLaminate(mbd.examples.carbon(), mbd.deg([45.0, -45.0]), 1e-3, field)
    return mbd.examples.arm(laminate=laminate)
