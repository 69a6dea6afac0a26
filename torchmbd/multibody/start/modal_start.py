"""Initial modal coordinates of the modes of each design, in the basis whose derivatives a motion has.

    u = Psi_b w      Psi_b   single modes of the design b, by growing frequency (`structure`)
                     w       numbers that were given to all designs

Derivatives hold for a basis that moves with the span of the modes (fem/reduction/transport.py), in which single modes turn:

    Psi_b = Psi R,     R = 1,  dR_ji = dKr_ji / (lambda_i - lambda_j)     at the design at hand (fem/reduction/eigenpairs.py)

so the coordinates in this basis are R w: equal numbers, whose derivative with respect to the design is dR w.
The last state of a motion has coordinates R_0 w in the basis of its own designs: it starts another one as R R_0' R_0 w.
Where modes of one frequency turn in themselves there is no dR: InputError, unless their coordinates are zero.
Checked in tests/sensitivity/test_modal_start.py.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.reduction.basis import CLUSTER
from torchmbd.fem.reduction.padding import is_padding, with_stiff_padding
from torchmbd.fem.reduction.spectral import chained
from torchmbd.math.gradients import all_true, is_differentiated
from torchmbd.multibody.equations.modal_data import pad
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.start.initial import START_DATA


def in_moving_basis(
    T: Topology, stiffness: Mapping[str, Tensor], before: Tensor | None, start: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """Initial coordinates and rates whose modal ones have their derivatives with respect to the design.

    stiffness   Kr [..., m, m] of the flexible bodies, by name in the order of the topology
    before      Kr [modes, modes, bodies, 1, lanes] of the designs of the motion whose last state this is; None: of none
    start       coordinates [n_q, 1, lanes] and rates [n_v, 1, lanes] by the names of START_DATA
    """
    q, v = (start[name] for name in START_DATA)
    for i, (name, Kr) in enumerate(stiffness.items()):
        m, rows = Kr.shape[-1], T.w_slice(i)
        rate_rows = [row - T.bodies for row in rows]
        for x in (q[rows], v[rate_rows]):
            _refuse_padding(name, Kr, x[:, 0].mT)
        if not is_differentiated(Kr):
            continue
        origin = None if before is None else pad(before[:m, :m, i, 0], m, (0, 1)).movedim(-1, 0)
        q = _turned(name, Kr, origin, q, rows)
        v = _turned(name, Kr, origin, v, rate_rows)
    return dict(zip(START_DATA, (q, v), strict=True))


def _turned(name: str, Kr: Tensor, origin: Tensor | None, x: Tensor, rows: list[int]) -> Tensor:
    """x [n, 1, lanes] with the derivatives of some rows by Kr [..., m, m], relative to those by `origin` [lanes, m, m]."""
    index = torch.tensor(rows)
    w = x[index, 0].mT  # [lanes, m]
    values = with_stiff_padding(Kr).diagonal(dim1=-2, dim2=-1).detach()
    same = chained(values, CLUSTER * values[..., 1:].abs())
    if origin is None or not is_differentiated(origin):
        _refuse_turned(name, same, w)
    change = Kr - Kr.detach() if origin is None else (Kr - Kr.detach()) - (origin - origin.detach())
    gaps = values[..., None, :] - values[..., :, None]
    turn = torch.where(same, 0.0, change / torch.where(same, 1.0, gaps))
    turned = w + (turn @ w[..., None]).squeeze(-1)
    lanes = turned.shape[0]
    return x.expand(*x.shape[:-1], lanes).index_copy(0, index, turned.mT[:, None])


def _refuse_padding(name: str, Kr: Tensor, w: Tensor) -> None:
    """InputError if coordinates w [lanes, m] belong to modes that a design does not retain."""
    if not all_true(~is_padding(Kr) | (w == 0.0)):
        raise InputError(
            ("start", name),
            allowed="zero for these modes",
            state="gives an initial value to modes that the reduced body of a design does not have",
            noun=f"start of {name!r}",
        )


def _refuse_turned(name: str, same: Tensor, w: Tensor) -> None:
    """InputError if coordinates w [lanes, m] of modes of one frequency are not zero."""
    single = same.sum(-1) == 1
    if all_true(single | (w == 0.0)):
        return
    raise InputError(
        ("start", name),
        allowed="zero for these modes",
        state="gives an initial value to modes of equal frequency, whose shapes cannot be differentiated",
        noun=f"start of {name!r}",
        hint="variables that do not change this body, or start=motion, which continues a motion with gradients",
    )
