"""Whirl of shafts: the frequencies that a fixed observer sees, out of those of an observer who turns with the machine.

    x(phi, t) = Re(r exp(i (w t - m phi)))        phi: angle about the axis in turning axes
    w_ground = |w + m speed|                      phi = phi_ground - speed t;  m = 1: forward, -1: backward, 0: neither

A displacement of a point on the axis, and a rotation, has the parts (e1 - i e2) for m = 1, (e1 + i e2) for m = -1 and one
along the axis for m = 0. Nodes beside the axis are taken ring by ring: m is the order of their Fourier series, in cylindrical
components. A vibration of a machine that is the same after any turn has one m. Those of blades and flat shafts have several: a
fixed observer sees several frequencies, and none is named here.
Checked in tests/extensions/vibrations/measures/test_critical_values.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchmbd.extensions.vibrations.spectrum import Spectrum
from torchmbd.extensions.vibrations.steady_states import Shaft
from torchmbd.math.rotation import rotation_matrix
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.equilibrium.linearized import Linearization
from torchmbd.multibody.equilibrium.steady_rotation import TURNING
from torchmbd.multibody.system import System

_ORDERS = (-3, -2, -1, 0, 1, 2, 3)  # of rings of nodes; points on the axis have the middle three
_ON_AXIS = 1e-2  # distance from the axis, of the length of the machine, at which a node is on it
_SURE = 0.05  # variance of m over a vibration that has a single one


class Whirl:
    """How the vibrations of a system about an axis go around it.

    topology, modes   of the system, modes [nodes, 6, modes] of its flexible bodies by their names
    shaft             its axis, and the observer: rotations are in axes of the bodies, or of the ground for one in the ground
    """

    def __init__(self, system: System, topology: Topology, modes: Mapping[str, Tensor], shaft: Shaft):
        self.topology, self.modes, self.direction = topology, modes, shaft.direction
        self.center = torch.as_tensor(shaft.center, dtype=torch.float64)
        self.in_body_axes = shaft.observer == TURNING
        direction = self.direction
        self.nodes = {name: _nodes(system.body(name)) for name in topology.names[: topology.flexible]}
        least = int(direction.abs().argmin())
        first = torch.linalg.cross(direction, torch.eye(3, dtype=direction.dtype)[least])
        self.across = torch.stack([first / first.norm(), torch.linalg.cross(direction, first / first.norm())])

    def orders(self, spectrum: Spectrum, q: Tensor, size: float) -> Tensor:
        """m [k] of the vibrations about q [n_q] of a machine of a size [m]; nan for one that has several."""
        parts = self._parts(spectrum.right, q, size)
        m = torch.tensor(_ORDERS, dtype=q.dtype)
        result = torch.full((len(spectrum.values),), torch.nan, dtype=q.dtype)
        for number in spectrum.cluster.unique():
            members = (spectrum.cluster == number).nonzero()[:, 0]
            of = [x[:, members] for x in parts[:-1]]
            grams = torch.stack([x.mH @ x for x in of])
            total = parts[-1][:, members].mH @ parts[-1][:, members]
            first, second = ((m**k).to(total.dtype)[:, None, None] * grams for k in (1, 2))
            if not float(total.diagonal().abs().min()) > 0.0:
                continue  # a vibration without a shape
            inverse = torch.linalg.pinv(total, hermitian=True)
            mean, vectors = torch.linalg.eig(inverse @ first.sum(0))
            back = torch.linalg.pinv(vectors)
            missing = (back @ inverse @ (total - grams.sum(0)) @ vectors).diagonal().real
            spread = (back @ inverse @ second.sum(0) @ vectors).diagonal().real - mean.real.square() + missing
            result[members] = torch.where(spread < _SURE, mean.real.round(), torch.nan)
        return torch.where(spectrum.values == 0.0, 0.0, result)  # free motions along the axis and about it

    def _parts(self, x: Tensor, q: Tensor, size: float) -> list[Tensor]:
        """Parts [rows, k] of increments x [n_v, k] for each order, and all of them together [rows, k]."""
        T = self.topology
        r, p, _ = equations.split_q(T, q[:, None, None])
        r, A = r[..., 0, 0].T, rotation_matrix(p)[..., 0, 0].permute(2, 0, 1)
        dr, dth, dw = (y.movedim(1, 0) for y in equations.split_v(T, x[:, None]))
        turns = A.to(x.dtype) if self.in_body_axes else torch.eye(3, dtype=x.dtype)
        dr, dth, dw = dr[:, :, 0], turns @ dth[:, :, 0], dw[:, :, 0]
        along = (r - self.center) @ self.direction
        places = [r, *(r[b] + s @ A[b].T for b, s in enumerate(self.nodes.values()))]
        ends = torch.cat([(y - self.center) @ self.direction for y in places])
        length = max(float(ends.max() - ends.min()), size)
        foot = self.center + along[:, None] * self.direction - r
        rows: dict[int | None, list[Tensor]] = {m: [] for m in (*_ORDERS, None)}
        for b in range(T.bodies):
            if b < T.flexible:
                name = T.names[b]
                s, psi = self.nodes[name] @ A[b].T, self.modes[name].to(x.dtype)
                w = dw[b][: psi.shape[-1]]
                turn = dth[b].expand(len(s), -1, -1) + A[b].to(x.dtype) @ (psi[:, 3:] @ w)
                shift = dr[b] + torch.linalg.cross(dth[b].expand(len(s), -1, -1), s.to(x.dtype)[..., None], dim=1)
                self._add_nodes(rows, r[b] + s, shift + A[b].to(x.dtype) @ (psi[:, :3] @ w), turn * length, length)
            else:
                shift = dr[b] + torch.linalg.cross(dth[b], foot[b].to(x.dtype)[:, None], dim=0)
                self._add_vectors(rows, torch.stack([shift, dth[b] * length]))
        zero = x.new_zeros(1, x.shape[1])
        return [torch.cat([zero, *rows[m]]) for m in rows]

    def _add_vectors(self, rows: dict[int | None, list[Tensor]], d: Tensor) -> None:
        """Vectors d [n, 3, k] of points on the axis."""
        a, b = (torch.einsum("i,nik->nk", e.to(d.dtype), d) for e in self.across)
        rows[1].append((a + 1j * b) / 2.0**0.5)
        rows[-1].append((a - 1j * b) / 2.0**0.5)
        rows[0].append(torch.einsum("i,nik->nk", self.direction.to(d.dtype), d))
        rows[None].append(d.flatten(0, 1))

    def _add_nodes(
        self, rows: dict[int | None, list[Tensor]], places: Tensor, shift: Tensor, turn: Tensor, length: float
    ) -> None:
        """Displacements and rotations times the length [n, 3, k] of nodes at places [n, 3]."""
        arm = places - self.center
        y, z = (arm @ e for e in self.across)
        radius, angle = torch.hypot(y, z), torch.atan2(z, y)
        near = radius <= _ON_AXIS * length
        self._add_vectors(rows, torch.cat([shift[near], turn[near]]))
        keys = torch.stack([arm @ self.direction, radius], 1)[~near] / (1e-6 * length)
        rings = keys.round().unique(dim=0, return_inverse=True)[1]
        c, s = angle.cos(), angle.sin()
        outward, around = (u[:, None] * self.across[0] + v[:, None] * self.across[1] for u, v in ((c, s), (-s, c)))
        axes = torch.stack([outward, around, self.direction.expand_as(outward)], 1)
        local = (axes.to(shift.dtype) @ shift)[~near]
        rows[None].append(local.flatten(0, 1))
        for ring in range(int(rings.max()) + 1 if len(rings) else 0):
            of, n = local[rings == ring], int((rings == ring).sum())
            for m in (m for m in _ORDERS if 2 * abs(m) < n):
                wave = torch.exp(1j * m * angle[~near][rings == ring])
                rows[m].append(torch.einsum("n,nik->ik", wave, of) / n**0.5)


def _nodes(body: Any) -> Tensor:
    """Positions of the nodes from the origin, in body axes [nodes, 3] [m]."""
    return (body.mesh.nodes - body.origin).detach()


class SeenFromGround:
    """A `Choice` of all vibrations, or of one by its number from 0 in rising order of what a fixed observer sees.

    q, speeds, sizes   of all lanes: coordinates [n_q, 1, lanes], speeds [rad/s], sizes of the machine [m]
    orders      m of the vibrations that are chosen [lanes, k];  chosen: their numbers in turning axes, of all lanes
    places      of the chosen vibration of each lane among these numbers [lanes, 1], or None: all
    """

    def __init__(self, whirl: Whirl, q: Tensor, speeds: Tensor, sizes: Sequence[float], number: int | None = None):
        self.whirl, self.q, self.speeds, self.sizes, self.number = whirl, q.detach(), speeds.detach(), sizes, number
        self.orders, self.chosen, self.places = torch.zeros(0, 0), [0], torch.zeros(0, 0, dtype=torch.long)

    def __call__(self, spectra: Sequence[Spectrum], states: Sequence[Linearization]) -> Sequence[int]:
        lanes = zip(spectra, self.q[:, 0].unbind(-1), self.sizes, strict=True)
        self.orders = torch.stack([self.whirl.orders(*lane) for lane in lanes])
        self.chosen = list(range(self.orders.shape[1]))
        if self.number is not None:
            w = (torch.stack([x.values for x in spectra]) + self.orders * self.speeds[:, None]).abs()
            numbers = w.nan_to_num(torch.inf).argsort(dim=1, stable=True)[:, self.number]
            self.orders = self.orders.gather(1, numbers[:, None])
            self.chosen = numbers.unique().tolist()
            self.places = torch.searchsorted(torch.tensor(self.chosen), numbers.contiguous())[:, None]
        return self.chosen
