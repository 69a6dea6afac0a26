"""Moments of deformed bodies: S, P, G, s and V of equations.py.

C1 and F2 have the same factors in all terms but axial(w' F2 w'), to which C1 adds nothing: the data hold their sum as C1.
F1 and axial(F2) are L V1 (equations.py), so the data hold neither: a third of the products of F1, F2 and V1 apart.
Checked in tests/multibody/equations/test_equations.py (direct nodal sums), tests/physics/ (energy, momentum).
"""

from __future__ import annotations

from typing import Any, NamedTuple

from torchmbd.math.pair import cat, contract, matmul, matvec
from torchmbd.multibody.equations.data import Data
from torchmbd.multibody.equations.topology import Topology


class Moments(NamedTuple):
    """Moments of the deformed bodies; G, SR and V of the flexible ones, or None.

    S [3, bodies], P [3, 3, bodies], G [3, 3, modes, flexible], SR: s above R1 [6, modes, flexible], V [6, modes, flexible]
    of systems with stiffening
    """

    S: Any
    P: Any
    G: Any = None
    SR: Any = None
    V: Any = None


def moments(T: Topology, data: Data, w) -> Moments:
    """Return the moments of bodies with the modal coordinates w."""
    f = T.flexible
    if not f:
        return Moments(data["S0"], data["P0"])
    S, P, C0, SR, V = data["S0"], data["P0"], data["C0"], data["SR"], None
    G = C0 + contract(data["C1"], w, 3)
    S_f, P_f = S[:, :f] + matvec(SR[:3], w), P[:, :, :f] + contract(C0.transpose(0, 1) + G, w, 2)
    if "V1" in data:
        bent = contract(data["V1"], w, 2)
        s = data["L"][0, 0] * bent[:3]
        S_f, P_f = S_f + 0.5 * matvec(s, w), 0.5 * (P_f + P_f.transpose(0, 1))
        SR, V = cat([SR[:3] + s, SR[3:]]), data["V0"] + bent
    if f < T.bodies:
        S_f, P_f = cat([S_f, S[:, f:]], 1), cat([P_f, P[:, :, f:]], 2)
    return Moments(S_f, P_f, G, SR, V)


def frame_terms(data: Data, x):
    """Return F1 and axial(F2) [3, k, flexible] in the contraction that V1 has in x [6, k, flexible]."""
    L = data["L"]
    return L[0, 0] * x[:3], matmul(L[3:], x)


def bent_stiffness(data: Data, w):
    """Return K2 w [modes, modes, flexible], the part of a quadratic stiffness that bending adds."""
    return contract(data["K2"], w, 2)
