"""Vibrations of an exact beam about an equilibrium, at rest or steadily rotating.

    M q'' + G q' + K q = 0,    q = Re(phi e^{i w t}):    (K - w^2 M + i w G) phi = 0

M, G   of particles on arms: N' m N and 2 N' m ~spin N with N = (1, -~arm), at the nodes (Coriolis)
K      stiffness of elements and loads under load, with what the centrifugal forces change
q      displacements and rotations of the nodes in space, in the turning frame

K is symmetric and positive at a stable equilibrium under loads that have a potential, so -i (q', q) is an eigenproblem of
Hermitian matrices and all w are real. Derivatives: of w by phi^H (K - w^2 M + i w G) phi = 0 with phi held, forward and
reverse, at the equilibrium that moves with the design; where frequencies coincide each has the mean of their derivatives.
Checked in tests/fem/exact_beam/test_vibrations.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.fem.exact_beam.continuation import Continuation
from torchmbd.fem.exact_beam.data import RANKS, BeamData, Topology, batch_as_lane
from torchmbd.fem.exact_beam.forces import element_tangents, load_tangents, screw_forces
from torchmbd.math.rigid_motion import hat

SMALL = 240  # freedoms; up to this number a dense method costs no more
GUARD = 4  # additional frequencies, so that all members of a cluster are known
CLOSE = 1e-6  # relative distance of frequencies that count as coinciding


def frequencies(
    search: Continuation, data: BeamData, x: Tensor, R: Tensor, number: int
) -> Float[Tensor, "*lanes number"]:
    """Return the lowest circular frequencies w [rad/s] at equilibria x, R; nan where there is none."""
    with torch.no_grad():
        w, real, imaginary = _Modes.apply(search, number, *data, x, R)
    topology = search.topology
    elements = element_tangents(data, topology, x, R, screw_forces(data, topology, x, R))[0][..., None, :, :, :]
    loads = load_tangents(data, x, R, 1.0)[..., None, :, :, :]
    M, G = (A[..., None, :, :, :] for A in inertia(data, R))
    bending, weight = 0.0, 0.0
    for v in (real, imaginary):  # [*lanes, number, n, 6]
        ends = v[..., topology.elements, :].flatten(-2)
        bending = bending + _form(elements, ends, ends) + _form(loads, v, v)
        weight = weight + _form(M, v, v)
    gyroscopic = 2.0 * _form(G, real, imaginary)
    residual = bending - w**2 * weight - w * gyroscopic
    step = residual / (2.0 * w * weight + gyroscopic).detach()
    near = ((w[..., :, None] - w[..., None, :]).abs() <= CLOSE * w[..., None]).to(w.dtype)
    mean = (near @ step[..., None])[..., 0] / near.sum(-1)
    return (w + mean)[..., :number]


def inertia(data: BeamData, R: Tensor) -> tuple[Float[Tensor, "*lanes n 6 6"], Float[Tensor, "*lanes n 6 6"]]:
    """Return M and G of the nodes."""
    eye = torch.eye(3, dtype=torch.float64)
    S = hat((R @ data.first[..., None])[..., 0])
    J = R @ data.second @ R.mT
    spin = hat(data.spin)[..., None, :, :]
    m = data.mass[..., None, None]
    trace = J.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    M = _blocks(m * eye, -S, S, trace * eye - J)
    turned = hat((J @ data.spin[..., None, :, None])[..., 0])
    return M, 2.0 * _blocks(m * spin, -spin @ S, S @ spin, turned)


def _blocks(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    a, b, c, d = torch.broadcast_tensors(a, b, c, d)
    return torch.cat([torch.cat([a, b], -1), torch.cat([c, d], -1)], -2)


def _form(A: Tensor, u: Tensor, v: Tensor) -> Float[Tensor, "*lanes number"]:
    """u' A v, summed over elements or nodes."""
    return (u * (A @ v[..., None])[..., 0]).sum((-2, -1))


class _Modes(torch.autograd.Function):
    """w [*lanes, k], and real and imaginary parts of the modes [*lanes, k, n, 6]; not differentiable."""

    @staticmethod
    def forward(search: Continuation, number: int, *tensors: Tensor) -> tuple[Tensor, ...]:
        *data, x, R = (y.detach() for y in tensors)
        beam = BeamData(*data)
        lanes = torch.Size(np.broadcast_shapes(beam.lanes, x.shape[:-2]))
        x, R = (y.expand(*lanes, *y.shape[-k:]).reshape(-1, *y.shape[-k:]) for y, k in ((x, 2), (R, 3)))
        rows = [_modes(search, *lane, number) for lane in zip(beam.split_lanes(lanes), x, R, strict=True)]
        return tuple(torch.stack(y).reshape((*lanes, *y[0].shape)) for y in zip(*rows, strict=True))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        ctx.mark_non_differentiable(*output)

    @staticmethod
    def jvp(ctx: Any, *_: Any) -> Any:
        return (None,) * 3

    @staticmethod
    def backward(ctx: Any, *_: Any) -> Any:
        return (None,) * (4 + len(RANKS))

    @staticmethod
    def vmap(info: Any, in_dims: tuple, search: Continuation, number: int, *tensors: Tensor) -> Any:
        wide = batch_as_lane(info.batch_size, in_dims[2:], tensors, (*RANKS, 2, 3))
        return _Modes.apply(search, number, *wide), (0,) * 3


def _modes(search: Continuation, data: BeamData, x: Tensor, R: Tensor, number: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return w, and real and imaginary parts of the modes, of one lane."""
    topology, n = search.topology, len(x)
    k = min(number + GUARD, len(topology.free))
    shape = np.zeros((k, 6 * n), dtype=complex)
    w = np.full(k, np.nan)
    if bool(torch.isfinite(x).all()):
        free = topology.free.numpy()
        K = search.stiffness(data, x, R, screw_forces(data, topology, x, R), 1.0)[0][free][:, free]
        M, G = (_sparse(A, topology) for A in inertia(data, R))
        w, vectors = _lowest(0.5 * (K + K.T), M, G, k)
        shape[:, free] = vectors.T
    whole = torch.from_numpy(shape).reshape(k, n, 6)
    return torch.from_numpy(w), whole.real.clone(), whole.imag.clone()


def _sparse(A: Float[Tensor, "n 6 6"], topology: Topology) -> Any:
    free = topology.free.numpy()
    return scipy.sparse.block_diag(list(A.numpy()), format="csc")[free][:, free]


def _lowest(K: Any, M: Any, G: Any, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Solve w B y = -i S y, y = (q', q), B = diag(M, K), S = [[-G, -K], [K, 0]]: the k lowest w > 0, and q [N, k]."""
    N = M.shape[0]
    unit = float(np.sqrt((K.diagonal() / M.diagonal()).min()))  # of w: B has entries of one size
    K, G = K / unit**2, G / unit
    B = scipy.sparse.block_diag([M, K], format="csc")
    H = -1j * scipy.sparse.block_array([[-G, -K], [K, None]], format="csc")
    if N <= SMALL or 2 * k + 2 >= N:
        w, y = scipy.linalg.eigh(H.toarray(), B.toarray())
    else:
        solve = scipy.sparse.linalg.splu(K.tocsc()).solve

        def inverse(r: np.ndarray) -> np.ndarray:
            r = 1j * r
            rate = _complex(solve, r[N:])
            return np.concatenate([rate, -_complex(solve, r[:N] + G @ rate)])

        operator: Any = scipy.sparse.linalg.LinearOperator(H.shape, inverse, dtype=complex)  # pyright: ignore
        start = np.random.default_rng(0).standard_normal(2 * N).astype(complex)
        w, y = scipy.sparse.linalg.eigsh(H, 2 * k, M=B, sigma=0.0, OPinv=operator, v0=start)
    positive = np.flatnonzero(w > 0.0)
    chosen = positive[np.argsort(w[positive])][:k]
    return unit * w[chosen], y[N:, chosen]


def _complex(solve: Any, r: np.ndarray) -> np.ndarray:
    return solve(np.ascontiguousarray(np.real(r))) + 1j * solve(np.ascontiguousarray(np.imag(r)))
