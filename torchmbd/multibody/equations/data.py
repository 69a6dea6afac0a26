"""Data of a design: the numbers of its reduced model by name, from the structure stage to the equations, tangents and adjoint.

Each is a tensor or pair [component..., 1 + n_b, lanes or 1]; the axes below come before these two.

    every body       mass [bodies] kg, S0 [3, bodies] kg m, P0 [3, 3, bodies] kg m2, mu [bodies] kg m2
    flexible ones    SR [6, modes, flexible] (S1 above R1), C0 [3, 3, modes, flexible], C1 [3, 3, modes, modes, flexible],
                     H [3, modes, modes, flexible], Kr [modes, modes, flexible] 1/s2, D [modes, modes, flexible] 1/s
    quadratic        K2 [modes, modes, modes, flexible]
    stiffening       V0 [6, modes, flexible], V1 [6, modes, modes, flexible], L [6, 6, flexible]
    vectors          x [3, vectors] m or -, Y [3, modes, vectors of flexible bodies], E [3, modes, modes, the same]
    exact beams      beam_stiffness [6, 6, n], beam_rest [6, n], beam_start, beam_end [3, 3, n], beam_damping [n] s
    gravity          gravity [3, 1] m/s2
    the start        q0 [n_q], v0 [n_v], where they vary with the design
    laws, factors    "law NAME" [n]: numbers of the joint or force NAME that vary with the design
    times            the duration and the times of phases that gradients are wanted by (integrate/phases/segment.py) s
    steady states    spin [3] rad/s

The symbols stand in equations.py and beams.py. A system without exact beams, gravity or stiffening has no such names. Data
are a mapping by name, not a tuple, because laws add their names, and because much of the code treats all numbers alike: as
leaves of torch, as lanes, as inputs of compiled code.
Checked in tests/multibody/equations/test_data.py.
"""

from __future__ import annotations

from typing import Any

Data = dict[str, Any]

INERTIA = {"mass": 0, "S0": 1, "P0": 2, "mu": 0}  # of every body: the rank of one body's number
ATTACHED = {"x": 1, "Y": 2, "E": 3}  # of attached vectors: the axis of these
