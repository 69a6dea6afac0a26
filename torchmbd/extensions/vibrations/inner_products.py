"""l^H P(s) r of the linearized equations as a function of the state and the data, from which derivatives of vibrations follow.

    P(s) = [s^2 M + s C + K, Phi_q'; Phi_q, 0]        l, r: constant vectors

P r is one derivative of the residual: along x = r, x' = s r, x'' = s^2 r and the multipliers of r. So l^H P r is written in the
functions of the equations, once: K, C and M are not differentiated one by one.
Checked in tests/extensions/vibrations/test_eigenvalues.py, tests/extensions/vibrations/measures/test_frequency_response.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.math.pair import Pair
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.equilibrium.linearized import Linearization
from torchmbd.multibody.equilibrium.steady_rotation import Observer
from torchmbd.multibody.saddle.rank import RELATIVE


class Vectors(NamedTuple):
    """Complex vectors [n, 1, lanes]: l and r, increments of the coordinates, with their multipliers."""

    left: Tensor
    slip: Tensor
    right: Tensor
    force: Tensor


def inner_products(
    T: Topology,
    data: Any,
    q: Tensor,
    t: Tensor,
    observer: Observer,
    balance: Sequence[Linearization],
    s: Tensor,
    vectors: Vectors,
) -> list[Tensor]:
    """Real and imaginary part [1, lanes] of l^H P(s) r at q [n_q, 1, lanes]; balance: the states."""
    excitation = T.prescribed(t, data)
    zero = q.new_zeros(T.n_v, 1, q.shape[-1])
    at, *rates = observer.perturbed(T, q, zero, zero, zero)
    lam = _multipliers(T, data, equations.placement(T, data, at, excitation), rates, observer, q, balance)
    x, xd, xdd = (Pair.of(zero, real_and_imaginary(s**k * vectors.right)) for k in range(3))
    near, v, a = observer.perturbed(T, q, x, xd, xdd)
    moved = equations.placement(T, data, near, excitation)
    z = equations.dynamic_residual(T, data, moved, v, a, Pair.of(lam, real_and_imaginary(vectors.force)))
    products = inner(vectors.left, observer.rows(T, q, z).tangent)
    if T.rows:
        more = inner(vectors.slip, equations.constraints(T, moved).tangent)
        products = [x + y for x, y in zip(products, more, strict=True)]
    return products


def _multipliers(
    T: Topology, data: Any, at: Any, rates: Any, observer: Observer, q: Tensor, balance: Sequence[Linearization]
) -> Tensor:
    """Multipliers [rows, 1, lanes] that balance the state: the known ones, by a Newton step that carries derivatives."""
    backs = {}
    lam = torch.stack([rest.lam for rest in balance], -1)[:, None]
    forces = observer.rows(T, q, equations.dynamic_residual(T, data, at, rates[0], rates[1], lam))[:, 0]
    for rest in balance:  # lanes may share one
        if id(rest) not in backs:
            back = torch.linalg.pinv(rest.Phi_q[:, rest.active].T, rtol=RELATIVE)
            backs[id(rest)] = back.new_zeros(T.rows, T.n_v).index_copy(1, rest.active, back)
    back = torch.stack([backs[id(rest)] for rest in balance], -1)
    return lam - torch.einsum("rvl,vl->rl", back, forces)[:, None]


def real_and_imaginary(x: Tensor) -> Tensor:
    """Both parts [n, 2, lanes] of x [n, 1, lanes]."""
    return torch.cat([x.real, x.imag], 1)


def inner(left: Tensor, z: Tensor) -> list[Tensor]:
    """Real and imaginary part [1, lanes] of l^H z for z [n, 2, lanes] as in `real_and_imaginary`."""
    real, imag = z.chunk(2, 1)
    return [(left.real * real + left.imag * imag).sum(0), (left.real * imag - left.imag * real).sum(0)]
