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
    C1 = [pad(s["C1"] + s["F2"] if "F2" in s else s["C1"], modes, (-2, -1)) for s in stages]
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
    if any("K2" in s for s in stages):
        own = [s["K2"] if "K2" in s else s["Kr"].new_zeros(1, 1, 1) for s in stages]
        data["K2"] = together([pad(K2, modes, (-3, -2, -1)) for K2 in own], 3)
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
    """V0, V1, L of the bodies and E of the attached vectors (equations.py); V1 and E are zero of bodies without stiffening."""
    found, rows = {}, []
    for attached, body in zip(T.attached[: T.attached_flexible], T.vector_flexible.tolist(), strict=True):
        made = stages[body]
        if "bow" in made:
            own = attached.quadratic_rows(made["psi"], made["bow"], carriers(T, body))
            rows.append(pad(own, T.modes, (-2, -1)))
        else:
            rows.append(made["psi"].new_zeros(3, T.modes, T.modes))
    shares = [_frame_shares(s) for s in stages]
    for k, (name, axes) in enumerate((("V0", (-1,)), ("V1", (-2, -1)), ("L", ()))):
        own = [pad(share[k], T.modes, axes) for share in shares]
        found[name] = together(own, (2, 3, 2)[k])
    none = found["V1"].new_zeros(3, T.modes, T.modes, 0, 1, 1)
    return found | {"E": together(rows, 3) if rows else none}


def _frame_shares(made: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """V0 [..., 6, m], V1 [..., 6, m, m] and L [..., 6, 6] of equations.py."""
    S, P, R1 = made["S0"], made["P0"], made["R1"]
    if "F1" not in made:
        return torch.zeros_like(torch.cat([made["S1"], R1], -2)), S.new_zeros(6, 1, 1), S.new_zeros(6, 6)
    eye = torch.eye(3, dtype=S.dtype)
    lever = torch.linalg.cross(S[..., None, :].expand(*S.shape[:-1], 3, 3), eye.expand(*S.shape[:-1], 3, 3), dim=-1)
    J = (P.diagonal(dim1=-2, dim2=-1).sum(-1) + made["mu"])[..., None, None] * eye - P
    mass = made["mass"][..., None, None] * eye
    R = torch.cat([torch.cat([mass, lever], -1), torch.cat([lever.mT, J], -1)], -2)
    size = R.diagonal(dim1=-2, dim2=-1).detach()
    small = torch.cat([size[..., :3], size[..., 3:].amax(-1, keepdim=True).expand_as(size[..., 3:])], -1)
    L = torch.linalg.cholesky(R + 1e-10 * torch.diag_embed(small))
    X0 = torch.cat([made["S1"], _axial(made["C0"], -2) + R1], -2)
    X1 = torch.cat([made["F1"], _axial(made["F2"], -3)], -3)
    V1 = torch.linalg.solve_triangular(L, X1.flatten(-2), upper=False).unflatten(-1, X1.shape[-2:])
    return torch.linalg.solve_triangular(L, X0, upper=False), V1, L


def _axial(Y: Tensor, dim: int) -> Tensor:
    """Axial vectors eps_kij Y_ji of matrices on the axes dim - 1 and dim."""
    y = Y.movedim((dim - 1, dim), (0, 1))
    found = torch.stack([y[2, 1] - y[1, 2], y[0, 2] - y[2, 0], y[1, 0] - y[0, 1]])
    return found.movedim(0, dim)
