"""Data of the motion from the structures of the flexible bodies: lanes last, bodies side by side, modes padded.

Checked in tests/multibody/system/test_equations.py (bodies with different numbers of modes, with and without stiffening).
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchmbd.multibody.system.topology import Topology


def together(parts: list[Tensor], rank: int) -> Tensor:
    """Stack one quantity of several bodies, lanes leading -> [component..., bodies, 1, lanes]."""
    lanes = max((p.shape[0] for p in parts if p.dim() > rank), default=1)
    full = [p.expand(lanes, *p.shape[p.dim() - rank :]) if p.dim() == rank else p for p in parts]
    return torch.stack(full, -1).movedim(0, -1).unsqueeze(-2)


def pad(x: Tensor, modes: int, axes: tuple[int, ...]) -> Tensor:
    """x with zeros up to so many modes along axes."""
    for axis in axes:
        missing = modes - x.shape[axis]
        if missing:
            shape = list(x.shape)
            shape[axis] = missing
            x = torch.cat([x, x.new_zeros(shape)], axis)
    return x


def modal_data(stages: list[dict[str, Tensor]], damping: list[Tensor | None], modes: int) -> dict[str, Tensor]:
    """Invariants of the modes; padded modes couple to nothing."""
    SR = [pad(torch.cat([s["S1"], s["R1"]], -2), modes, (-1,)) for s in stages]
    C1 = [pad(s["C1"], modes, (-2, -1)) for s in stages]
    # H_k ab = eps_ikj (2 C1 + R2)_ij ab: the Coriolis force on mode a is om_k H_kab w'_b.
    H = []
    for s in stages:
        c = pad(2.0 * s["C1"] + s["R2"], modes, (-2, -1))
        H.append(torch.stack([c[..., j, i, :, :] - c[..., i, j, :, :] for i, j in ((1, 2), (2, 0), (0, 1))], -3))
    data = {
        "SR": together(SR, 2),
        "C0": together([pad(s["C0"], modes, (-1,)) for s in stages], 3),
        "C1": together(C1, 4),
        "H": together(H, 3),
        "Kr": together([pad(s["Kr"], modes, (-2, -1)) for s in stages], 2),
    }
    if any(D is not None for D in damping):
        parts = [torch.zeros_like(s["Kr"]) if D is None else D for D, s in zip(damping, stages, strict=True)]
        data["D"] = together([pad(D, modes, (-2, -1)) for D in parts], 2)
    return data


def vector_modes(T: Topology, stages: list[dict[str, Tensor]]) -> Tensor:
    """Modal rows Y [3, modes, vectors, 1, lanes] of the vectors attached to flexible bodies (multibody/bodies/frame.py)."""
    rows = []
    for attached, body in zip(T.attached[: T.attached_flexible], T.vector_flexible.tolist(), strict=True):
        rows.append(pad(attached.modal_rows(stages[body]["psi"]), T.modes, (-1,)))
    if not rows:
        return stages[0]["psi"].new_zeros(3, T.modes, 0, 1, 1)
    return together(rows, 2)


def carriers(T: Topology, body: int) -> list[int]:
    """Nodes of a flexible body that carry frames."""
    on = T.attached[: T.attached_flexible]
    own = [a.interpolation for a, b in zip(on, T.vector_flexible.tolist(), strict=True) if b == body]
    return sorted({node for where in own if where is not None for node in where.nodes})


def second_order(T: Topology, stages: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """F1, F2 of the bodies and E of the attached vectors; zero of bodies without stiffening."""
    found = {}
    for name, rank in (("F1", 3), ("F2", 4)):
        none = [s["C0"].new_zeros(*[3] * (rank - 2), 1, 1) for s in stages]
        own = [pad(s.get(name, zero), T.modes, (-2, -1)) for s, zero in zip(stages, none, strict=True)]
        found[name] = together(own, rank)
    rows = []
    for attached, body in zip(T.attached[: T.attached_flexible], T.vector_flexible.tolist(), strict=True):
        made = stages[body]
        if "bow" in made:
            own = attached.quadratic_rows(made["psi"], made["bow"], carriers(T, body))
            rows.append(pad(own, T.modes, (-2, -1)))
        else:
            rows.append(made["psi"].new_zeros(3, T.modes, T.modes))
    none = found["F1"].new_zeros(3, T.modes, T.modes, 0, 1, 1)
    return found | {"E": together(rows, 3) if rows else none}
