"""Data of the motion from the structures of the flexible bodies: lanes last, bodies on one axis, modes padded.

Checked in tests/multibody/equations/test_equations.py (bodies with different numbers of modes, with and without stiffening).
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchmbd.multibody.equations.topology import Topology


def stack_bodies(parts: list[Tensor], rank: int) -> Tensor:
    """Stack one quantity of several bodies [lanes, component...] to [component..., bodies, 1, lanes]; rank: of a component."""
    lanes = max((p.shape[0] for p in parts if p.dim() > rank), default=1)
    full = [p.expand(lanes, *p.shape[p.dim() - rank :]) if p.dim() == rank else p for p in parts]
    return torch.stack(full, -1).movedim(0, -1).unsqueeze(-2)


def pad(x: Tensor, modes: int, axes: tuple[int, ...]) -> Tensor:
    """Return x with zeros up to so many modes along axes."""
    for axis in axes:
        missing = modes - x.shape[axis]
        if missing:
            shape = list(x.shape)
            shape[axis] = missing
            x = torch.cat([x, x.new_zeros(shape)], axis)
    return x


def modal_data(structures: list[dict[str, Tensor]], damping: list[Tensor | None], modes: int) -> dict[str, Tensor]:
    """Return the invariants of the modes of all bodies; padded modes couple to nothing."""
    SR = [pad(torch.cat([s["S1"], s["R1"]], -2), modes, (-1,)) for s in structures]
    C1 = [pad(s["C1"] + s["F2"] if "F2" in s else s["C1"], modes, (-2, -1)) for s in structures]
    # H_k ab = eps_ikj (2 C1 + R2)_ij ab: the Coriolis force on mode a is om_k H_kab w'_b.
    H = []
    for s in structures:
        c = pad(2.0 * s["C1"] + s["R2"], modes, (-2, -1))
        H.append(torch.stack([c[..., j, i, :, :] - c[..., i, j, :, :] for i, j in ((1, 2), (2, 0), (0, 1))], -3))
    data = {
        "SR": stack_bodies(SR, 2),
        "C0": stack_bodies([pad(s["C0"], modes, (-1,)) for s in structures], 3),
        "C1": stack_bodies(C1, 4),
        "H": stack_bodies(H, 3),
        "Kr": stack_bodies([pad(s["Kr"], modes, (-2, -1)) for s in structures], 2),
    }
    if any("K2" in s for s in structures):
        K2 = [s["K2"] if "K2" in s else s["Kr"].new_zeros(1, 1, 1) for s in structures]
        data["K2"] = stack_bodies([pad(x, modes, (-3, -2, -1)) for x in K2], 3)
    if any(D is not None for D in damping):
        parts = [torch.zeros_like(s["Kr"]) if D is None else D for D, s in zip(damping, structures, strict=True)]
        data["D"] = stack_bodies([pad(D, modes, (-2, -1)) for D in parts], 2)
    return data


def vector_modes(T: Topology, structures: list[dict[str, Tensor]]) -> Tensor:
    """Return the modal rows Y [3, modes, vectors, 1, lanes] of vectors on flexible bodies (multibody/bodies/frame.py)."""
    rows = []
    for attached, body in zip(T.attached[: T.attached_flexible], T.vector_flexible.tolist(), strict=True):
        rows.append(pad(attached.modal_rows(structures[body]["psi"]), T.modes, (-1,)))
    if not rows:
        return structures[0]["psi"].new_zeros(3, T.modes, 0, 1, 1)
    return stack_bodies(rows, 2)


def frame_nodes(T: Topology, body: int) -> list[int]:
    """Return the nodes of a flexible body that frames are fixed to."""
    attached = zip(T.attached[: T.attached_flexible], T.vector_flexible.tolist(), strict=True)
    interpolations = [vector.interpolation for vector, of in attached if of == body]
    return sorted({node for constraint in interpolations if constraint is not None for node in constraint.nodes})


def second_order_data(T: Topology, structures: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Return V0, V1, L of the bodies and E of the attached vectors (equations.py); V1 and E are zero without stiffening."""
    data, E = {}, []
    for attached, body in zip(T.attached[: T.attached_flexible], T.vector_flexible.tolist(), strict=True):
        structure = structures[body]
        if "psi2" in structure:
            rows = attached.quadratic_rows(structure["psi"], structure["psi2"], frame_nodes(T, body))
            E.append(pad(rows, T.modes, (-2, -1)))
        else:
            E.append(structure["psi"].new_zeros(3, T.modes, T.modes))
    factors = [_momentum_factors(structure) for structure in structures]
    for k, (name, axes, rank) in enumerate((("V0", (-1,), 2), ("V1", (-2, -1), 3), ("L", (), 2))):
        data[name] = stack_bodies([pad(of_body[k], T.modes, axes) for of_body in factors], rank)
    no_vectors = data["V1"].new_zeros(3, T.modes, T.modes, 0, 1, 1)
    return data | {"E": stack_bodies(E, 3) if E else no_vectors}


def _momentum_factors(structure: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Return V0 [..., 6, m], V1 [..., 6, m, m] and L [..., 6, 6] of equations.py."""
    S, P, R1 = structure["S0"], structure["P0"], structure["R1"]
    if "F1" not in structure:
        return torch.zeros_like(torch.cat([structure["S1"], R1], -2)), S.new_zeros(6, 1, 1), S.new_zeros(6, 6)
    eye = torch.eye(3, dtype=S.dtype)
    lever = torch.linalg.cross(S[..., None, :].expand(*S.shape[:-1], 3, 3), eye.expand(*S.shape[:-1], 3, 3), dim=-1)
    J = (P.diagonal(dim1=-2, dim2=-1).sum(-1) + structure["mu"])[..., None, None] * eye - P
    mass = structure["mass"][..., None, None] * eye
    R = torch.cat([torch.cat([mass, lever], -1), torch.cat([lever.mT, J], -1)], -2)
    # A line of mass points has no inertia about itself: a small part of the diagonal keeps R definite.
    size = R.diagonal(dim1=-2, dim2=-1).detach()
    size = torch.cat([size[..., :3], size[..., 3:].amax(-1, keepdim=True).expand_as(size[..., 3:])], -1)
    L = torch.linalg.cholesky(R + 1e-10 * torch.diag_embed(size))
    X0 = torch.cat([structure["S1"], _axial(structure["C0"], -2) + R1], -2)
    X1 = torch.cat([structure["F1"], _axial(structure["F2"], -3)], -3)
    V1 = torch.linalg.solve_triangular(L, X1.flatten(-2), upper=False).unflatten(-1, X1.shape[-2:])
    return torch.linalg.solve_triangular(L, X0, upper=False), V1, L


def _axial(Y: Tensor, dim: int) -> Tensor:
    """Return the axial vectors eps_kij Y_ji of matrices on the axes dim - 1 and dim."""
    y = Y.movedim((dim - 1, dim), (0, 1))
    return torch.stack([y[2, 1] - y[1, 2], y[0, 2] - y[2, 0], y[1, 0] - y[0, 1]]).movedim(0, dim)
