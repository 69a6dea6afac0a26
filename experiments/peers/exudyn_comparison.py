"""Do torchmbd and Exudyn find the same motion? `python -m experiments.peers.exudyn_comparison` (needs the extra `bench`)

The slider-crank of the paper and a panel on three joints, the same modes in both codes, equal steps. Differences over
time, relative to the largest value: of the strain energy, and of the place of one node, relative to its way. The rod's end at
the slider, the panel's free corner. Exudyn's nodes have no rotary inertia in the Coriolis terms: that is what is left.
"""

from __future__ import annotations

import argparse
from typing import NamedTuple

import numpy as np
import torch

import torchmbd as mbd
from experiments.models import panel
from experiments.peers import exudyn_peer
from torchmbd.examples import slider_crank


class Comparison(NamedTuple):
    """Differences relative to the largest value: of U and of a place; peak [J] and integral [J s] of U in both codes."""

    energy: float
    place: float
    peaks: tuple[float, float]
    integrals: tuple[float, float]


def compare(system: mbd.System, peer: str, name: str, node: str, duration: float, steps: int) -> Comparison:
    """One mechanism in both codes. name, node: of the flexible body and the node that are compared."""
    motion = mbd.simulate(system, duration, steps=steps, gradients="none").require_ok()
    body = motion.body(name)
    U, place = body.strain_energy[0].numpy(), body.at(node).position[0].numpy()
    run = getattr(exudyn_peer, peer)(system, {})[0](duration, steps)
    integrals = tuple(float(np.trapezoid(x, run.t)) for x in (U, run.U))
    return Comparison(
        float(np.abs(run.U - U).max() / U.max()),
        float(np.abs(run.places[0] - place).max() / np.abs(place - place[0]).max()),
        (float(U.max()), float(run.U.max())),
        (integrals[0], integrals[1]),
    )


def both(crank_steps: int = 1200, panel_steps: int = 1500, modes: int = 8) -> dict[str, Comparison]:
    """Both mechanisms in both codes."""
    crank = slider_crank.build(modes=modes, joint="spherical")
    return {
        "slider-crank": compare(crank, "slider_crank", "rod", "right", slider_crank.DURATION, crank_steps),
        "panel": compare(panel.build(modes=modes), "panel", "panel", panel.FREE, panel.DURATION, panel_steps),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.parse_args()
    if not exudyn_peer.available():
        parser.error("the package exudyn is not installed: pip install exudyn")
    torch.set_num_threads(1)
    print("mechanism      max U [J]            integral of U [J s]        largest difference of U, of a place")
    for name, comparison in both().items():
        peaks, integrals = ("  ".join(f"{x:.6g}" for x in pair) for pair in (comparison.peaks, comparison.integrals))
        print(f"{name:13s}  {peaks:20s} {integrals:26s} {comparison.energy:.1e}, {comparison.place:.1e}")


if __name__ == "__main__":
    main()
