"""The saddle-point matrix of the equations of motion, and constraint Jacobians.

    [ M   Phi_q' ] [ a   ]   [ forces ]
    [ Phi_q   0  ] [ lam ] = [ gamma  ]          eqs. (7), (9)

Values only: sensitivities use the same matrix with the right-hand sides of eqs. (31)-(33), which come from pairs.
Blocks are computed for all bodies and all rows at once and gathered into a dense matrix by one index, so the number
of operators does not grow with the number of bodies or joints. Matrices are returned lanes first, ready for LAPACK.

`stiffness`, `damping`: factors of Kr and D added to the modal mass, and derivatives of all other forces by coordinates
and rates, make the iteration matrix of an implicit integrator out of the same text.
Checked in tests/system/test_equations.py: every column is the difference of the residual that it stands for.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchmbd.numerics.pair import cross, matmul, matvec, matvec_t
from torchmbd.numerics.rotation import axial, skew
from torchmbd.system.equations import (
    Data,
    Placement,
    action_states,
    generalized_forces,
    moments,
    split_v,
    total_on_vectors,
)
from torchmbd.system.topology import Fold, Topology

Moments = tuple[Tensor, Tensor, Tensor | None]  # S, P and G of equations.moments


class Saddle:
    """Gathers the blocks of one topology; index tensors made once."""

    def __init__(self, T: Topology):
        self.T = T
        self._row_index()
        self._body_fold = Fold([b if b < T.bodies else -1 for b in T.vector_body.tolist()], T.bodies)
        self._blocks: list[tuple[str, tuple[int, ...]]] = self._shapes()
        index, zero = self._dense_index()
        # With independent rates the matrix is P' K P: sums over the few entries of K that each of its entries has.
        self._project = None if T.rates is None else Projection(index, zero, T.rates)
        self._index = torch.from_numpy(index.reshape(-1))

    def _row_index(self) -> None:
        """Slots (row, vector) of unit multipliers, folded to pairs (row, body)."""
        T = self.T
        slot_vector, slot_row = [], []
        for primitive, rows in T.row_slices():
            n = len(primitive.members[0])
            for member in primitive.members:
                for component in range(primitive.rows):
                    slot_vector += member.tolist()
                    slot_row += [rows.start + component * n + i for i in range(n)]
        body = T.vector_body.tolist()
        keys = sorted({(r, body[v]) for r, v in zip(slot_row, slot_vector, strict=True) if body[v] < T.bodies})
        self.pairs = keys
        self.pair_body = torch.tensor([b for _, b in keys], dtype=torch.long)
        place = {key: i for i, key in enumerate(keys)}
        pair_of = [place.get((r, body[v]), -1) for r, v in zip(slot_row, slot_vector, strict=True)]
        is_point = [T.attached[v].is_point for v in slot_vector]
        self.slot_vector = torch.tensor(slot_vector, dtype=torch.long)
        self.turn_fold = Fold(pair_of, len(keys))
        self.force_fold = Fold([p if point else -1 for p, point in zip(pair_of, is_point, strict=True)], len(keys))
        self.flexible_slots = torch.tensor(
            [i for i, v in enumerate(slot_vector) if v < T.attached_flexible], dtype=torch.long
        )
        self.flexible_pairs = [key for key in keys if key[1] < T.flexible]
        bent = {key: i for i, key in enumerate(self.flexible_pairs)}
        self.modal_fold = Fold([bent[keys[pair_of[i]]] for i in self.flexible_slots.tolist()], len(bent))

    def _shapes(self) -> list[tuple[str, tuple[int, ...]]]:
        n, f, m = self.T.bodies, self.T.flexible, self.T.modes
        shapes = [
            ("mass", (n,)),
            ("turn", (3, 3, n)),  # forces by omega'
            ("turn_back", (3, 3, n)),  # torques by r'', [r'', torque]
            ("inertia", (3, 3, n)),  # torques by omega'
            ("pull", (3, m, f)),  # forces by w''
            ("pull_back", (3, m, f)),  # modal forces by r'', [r'', mode]
            ("twist", (3, m, f)),  # torques by w''
            ("twist_back", (3, m, f)),  # modal forces by omega', [omega', mode]
            ("modal", (m, m, f)),
            ("row_force", (3, len(self.pairs))),
            ("row_torque", (3, len(self.pairs))),
            ("row_turn", (3, len(self.pairs))),  # the same in Phi_q
            ("row_modal", (m, len(self.flexible_pairs))),
        ]
        return [(name, shape) for name, shape in shapes if 0 not in shape]

    def _dense_index(self) -> tuple[np.ndarray, int]:
        """For every entry of the dense matrix its place among all block entries; the last place is zero."""
        T = self.T
        n, f, m, nv = T.bodies, T.flexible, T.modes, T.n_rates
        places, start = {}, 0
        for name, shape in self._blocks:
            size = int(np.prod(shape))
            places[name] = np.arange(start, start + size).reshape(shape)
            start += size
        index = np.full((nv + T.rows, nv + T.rows), start)
        r = np.arange(3 * n).reshape(3, n)
        om = r + 3 * n
        w = 6 * n + np.arange(m * f).reshape(m, f)

        def put(rows: np.ndarray, cols: np.ndarray, block: np.ndarray) -> None:
            index[rows, cols] = block
            index[cols, rows] = block

        for i in range(3):
            put(r[i], r[i], places["mass"])
            for j in range(3):
                index[r[i], om[j]] = places["turn"][i, j]
                index[om[j], r[i]] = places["turn_back"][i, j]
                index[om[i], om[j]] = places["inertia"][i, j]
            for a in range(m):
                index[r[i, :f], w[a]] = places["pull"][i, a]
                index[w[a], r[i, :f]] = places["pull_back"][i, a]
                index[om[i, :f], w[a]] = places["twist"][i, a]
                index[w[a], om[i, :f]] = places["twist_back"][i, a]
        for a in range(m):
            for b in range(m):
                index[w[a], w[b]] = places["modal"][a, b]
        if self.pairs:
            row, body = np.array(self.pairs).T
            for i in range(3):
                put(nv + row, r[i][body], places["row_force"][i])
                index[om[i][body], nv + row] = places["row_torque"][i]
                index[nv + row, om[i][body]] = places["row_turn"][i]
        if self.flexible_pairs:
            row, body = np.array(self.flexible_pairs).T
            for a in range(m):
                put(nv + row, w[a][body], places["row_modal"][a])
        return index, start

    def matrix(
        self,
        data: Data,
        at: Placement,
        stiffness: float = 0.0,
        damping: float = 0.0,
        v: Tensor | None = None,
        a: Tensor | None = None,
        lam: Tensor | None = None,
        turn: Tensor | None = None,
    ) -> Tensor:
        """Dense saddle-point matrix [lanes, n_v + rows, n_v + rows].

        stiffness, damping  factors of Kr and D; `damping` also multiplies the gyroscopic matrix of the rates `v`,
                            `stiffness` that of the inertia forces of the rates and accelerations `a`, and the geometric
                            stiffness of the multipliers `lam`, if they are given
        turn                rotations [3, bodies, 1, lanes] of an increment: Phi_q is then the derivative by the increment
        """
        T = self.T
        body = moments(T, data, at.w) if T.flexible else (data["S0"], data["P0"], None)
        blocks = self._mass_blocks(data, at, body, stiffness, damping)
        blocks |= {f"{name}_back": blocks[name] for name in ("turn", "pull", "twist") if name in blocks}
        if v is not None:
            _, om, wd = split_v(T, v)
            spin = skew(om)
            self._add_gyroscopic(blocks, data, at, body, damping, (om, wd, spin))
            if a is not None:
                self._add_inertial(blocks, data, at, body, stiffness, (wd, spin), split_v(T, a))
        if lam is not None:
            pulls = total_on_vectors(T, data, at, v, lam)
            if pulls is not None:
                self._add_geometric(blocks, data, at, stiffness, pulls)
        if self.T.rows:
            blocks |= self._row_blocks(data, at)
            blocks["row_turn"] = self._by_increment(blocks["row_torque"], turn)
        lanes = at.g.shape[-1] if at.g.numel() else at.A.shape[-1]
        flat = torch.cat([blocks[name].expand(*shape, 1, lanes).reshape(-1, lanes) for name, shape in self._blocks])
        flat = torch.cat([flat, flat.new_zeros(1, lanes)])
        size = self.T.n_v + self.T.rows
        flat = flat.index_select(0, self._index) if self._project is None else self._project(flat)
        K = flat.reshape(size, size, lanes).permute(2, 0, 1)
        if v is not None and T.actions:
            K = K + pad(self._action_slopes(data, at, v, stiffness, damping), (0, T.rows, 0, T.rows))
        return K

    def _action_slopes(self, data: Data, at: Placement, v: Tensor, stiffness: float, damping: float) -> Tensor:
        """Derivatives of the applied forces through their laws [lanes, n_v, n_v]."""
        T = self.T
        total = sum(len(action.laws) for action in T.actions)
        slots, weights, start = [], [], 0
        states = action_states(T, data, at, v)
        for action, (s, rate, direction) in zip(T.actions, states, strict=True):
            n = len(action.laws)
            unit = torch.eye(total, dtype=s.dtype, device=s.device)[
                start : start + n, :, None
            ]  # one slot for each action
            slots += [d * unit for d in direction]
            by_s, by_rate = action.slopes(s, rate, at.t, data)
            weights.append(-(stiffness * by_s + damping * by_rate)[:, 0])
            start += n
        force = T.action_fold(*slots)  # pyright: ignore[reportOptionalCall]
        D = torch.cat([x.flatten(0, 1) for x in generalized_forces(T, data, at, force)])
        D = (D if T.gather is None else T.gather(D)).permute(2, 0, 1)
        K = (D * torch.cat(weights).T[:, None]) @ D.transpose(1, 2)
        coupled = T.links.slopes(states, at.t, data, stiffness, damping)
        return K if coupled is None else K - D @ coupled @ D.transpose(1, 2)

    def _by_increment(self, torque: Tensor, turn: Tensor | None) -> Tensor:
        """A change d of the increment th turns a body by (1 - ~th/2 + ~th~th/6) d, here to the third order."""
        if turn is None:
            return torque
        th = turn.index_select(1, self.pair_body)
        half = cross(th, torque)
        return torque + 0.5 * half + (1.0 / 6.0) * cross(th, half)

    def _mass_blocks(
        self, data: Data, at: Placement, body: Moments, stiffness: float, damping: float
    ) -> dict[str, Tensor]:
        T = self.T
        n, f = T.bodies, T.flexible
        eye = torch.eye(3, dtype=at.A.dtype, device=at.A.device)[:, :, None, None, None]
        A = at.A[:, :, :n]
        S, P, G = body
        trace = P[0, 0] + P[1, 1] + P[2, 2]
        blocks = {
            "mass": data["mass"],
            "turn": -matmul(A, skew(S)),
            "inertia": eye * (trace + data["mu"]) - P,
        }
        if G is not None:
            m = T.modes
            A_f = A[:, :, :f]
            blocks["pull"] = (A_f[:, :, None] * data["SR"][:3][None]).sum(1)
            blocks["twist"] = axial(G) + data["SR"][3:]
            modal = torch.eye(m, dtype=A.dtype, device=A.device)[:, :, None, None, None] + stiffness * data["Kr"]
            blocks["modal"] = modal + damping * data["D"] if "D" in data else modal
        return blocks

    def _add_gyroscopic(
        self,
        blocks: dict[str, Tensor],
        data: Data,
        at: Placement,
        body: Moments,
        factor: float,
        rates: tuple[Tensor, Tensor, Tensor],
    ) -> None:
        """Add the derivatives of the inertia forces by om and w' (equations.py)."""
        T, (om, wd, spin), (S, _, G) = self.T, rates, body
        f = T.flexible
        A, J = at.A[:, :, : T.bodies], blocks["inertia"]
        drift = cross(om, S)
        if G is not None:
            bending = drift[:, :f] + 2.0 * matvec(data["SR"][:3], wd)
            drift = torch.cat([bending, drift[:, f:]], 1) if f < T.bodies else bending
        blocks["turn"] = blocks["turn"] - factor * matmul(A, skew(drift) + matmul(spin, skew(S)))
        blocks["inertia"] = J + factor * (matmul(spin, J) - skew(matvec(J, om)))
        if G is not None:
            om_f, spin_f = om[:, :f], spin[:, :, :f]
            twice = 2.0 * factor * spin_f
            coriolis = matmul(twice, data["SR"][:3])
            blocks["pull"] = blocks["pull"] + matmul(A[:, :, :f], coriolis)
            R1, X = data["SR"][3:], (G * wd).sum(2)
            turning = matmul(factor * spin_f, R1) + axial((twice[:, :, None, None] * G[None]).sum(1))
            blocks["twist"] = blocks["twist"] + turning
            eye = torch.eye(3, dtype=om.dtype, device=om.device)[:, :, None, None, None]
            stirred = 2.0 * (eye * (X[0, 0] + X[1, 1] + X[2, 2]) - X) - skew(matvec(R1, wd))
            blocks["inertia"] = torch.cat(
                [blocks["inertia"][:, :, :f] + factor * stirred, blocks["inertia"][:, :, f:]], 2
            )
            both = G + G.transpose(0, 1)
            trace = G[0, 0] + G[1, 1] + G[2, 2]
            centrifugal = (both * om_f[None, :, None]).sum(1) - 2.0 * om_f[:, None] * trace[None]
            coriolis = (data["H"] * wd).sum(2)
            blocks["twist_back"] = blocks["twist_back"] + factor * (centrifugal + coriolis)
            blocks["modal"] = blocks["modal"] + factor * (data["H"] * om_f[:, None, None]).sum(0)

    def _add_inertial(
        self,
        blocks: dict[str, Tensor],
        data: Data,
        at: Placement,
        body: Moments,
        factor: float,
        rates: tuple[Tensor, Tensor],
        accelerations: tuple[Tensor, Tensor, Tensor],
    ) -> None:
        """Add the derivatives of the inertia forces by the rotations and by w (equations.py)."""
        T, (wd, spin), (rdd, omd, wdd), (S, _, G) = self.T, rates, accelerations, body
        f = T.flexible
        A = at.A[:, :, : T.bodies]
        Z = skew(omd) + matmul(spin, spin)
        u = matvec_t(A, rdd - data["gravity"] if "gravity" in data else rdd)
        h = matvec(Z, S)
        if G is not None:
            S1, C1 = data["SR"][:3], data["C1"]
            Z_f, spin_f, u_f = Z[:, :, :f], spin[:, :, :f], u[:, :f]
            bending = h[:, :f] + matvec(S1, wdd) + 2.0 * matvec(spin_f, matvec(S1, wd))
            h = torch.cat([bending, h[:, f:]], 1) if f < T.bodies else bending
            blocks["pull"] = blocks["pull"] + factor * matmul(A[:, :, :f], matmul(Z_f, S1))
            slow, fast = ((C1 * x[:, None]).sum(2) for x in (wd, wdd))  # [3, 3, modes, flexible]
            dP = G + G.transpose(0, 1)  # C1_ijab = C1_jiba
            turned = _times(Z_f, dP) + fast + 2.0 * _times(spin_f, slow)
            pulled = matmul(skew(u_f), S1)
            blocks["twist"] = blocks["twist"] + factor * (axial(turned) - pulled)
            blocks["twist_back"] = blocks["twist_back"] - factor * pulled
            blocks["modal"] = blocks["modal"] + factor * (Z_f[:, :, None, None] * C1).flatten(0, 1).sum(0)
        blocks["turn"] = blocks["turn"] - factor * matmul(A, skew(h))
        blocks["inertia"] = blocks["inertia"] + factor * matmul(skew(S), skew(u))

    def _add_geometric(
        self, blocks: dict[str, Tensor], data: Data, at: Placement, factor: float, pulls: Tensor
    ) -> None:
        """Add what the forces on attached vectors change by when bodies turn and bend under them, forces held in ground axes.

        A rod under tension has a mode of small inertia in which its frame turns against its bending; there this
        matters as much as the inertia.
        """
        T = self.T
        local = matvec_t(at.A_of, pulls)
        turned = matmul(skew(at.rho), skew(local))
        torque = self._body_fold(turned.flatten(0, 1)).unflatten(0, (3, 3))
        blocks["inertia"] = blocks["inertia"] + factor * torque
        if T.attached_flexible:
            bent = -matmul(skew(local[:, : T.attached_flexible]), data["Y"])
            twist = factor * T.modal_fold(bent.flatten(0, 1)).unflatten(0, (3, T.modes))
            blocks["twist"], blocks["twist_back"] = blocks["twist"] + twist, blocks["twist_back"] + twist

    def _row_blocks(self, data: Data, at: Placement) -> dict[str, Tensor]:
        T = self.T
        slots = []
        for primitive, arguments, drive in zip(T.primitives, at.arguments, at.drives, strict=True):
            vectors = [x.unsqueeze(1) for x in arguments]
            k, n = primitive.rows, len(primitive.members[0])
            lam = torch.eye(k, dtype=at.g.dtype, device=at.g.device)[:, :, None, None, None]
            lam = lam.expand(k, k, n, 1, at.g.shape[-1])
            slots += [
                force.expand(3, k, n, *lam.shape[-2:]).flatten(1, 2) for force in primitive.forces(vectors, lam, drive)
            ]
        force = torch.cat(slots, 1)
        local = matvec_t(at.A_of.index_select(2, self.slot_vector), force)
        blocks = {
            "row_force": self.force_fold(force),
            "row_torque": self.turn_fold(cross(at.rho.index_select(1, self.slot_vector), local)),
        }
        if self.flexible_pairs:
            Y = data["Y"].index_select(2, self.slot_vector[self.flexible_slots])
            blocks["row_modal"] = self.modal_fold(matvec_t(Y, local.index_select(1, self.flexible_slots)))
        return blocks

    def jacobian(self, data: Data, at: Placement) -> Tensor:
        """Phi_q [lanes, rows, n_v]."""
        return self.matrix(data, at)[:, self.T.n_v :, : self.T.n_v]


def _times(A: Tensor, B: Tensor) -> Tensor:
    """Matrix [3, 3, n] times matrices [3, 3, modes, n]."""
    return (A[:, :, None, None] * B[None]).sum(1)


class Projection:
    """P' K P with P = diag(rates, 1), from the flat entries of K's blocks."""

    def __init__(self, index: np.ndarray, zero: int, rates: Tensor):
        N = rates.numpy()
        rows = len(index) - len(N)
        P = np.block([[N, np.zeros((len(N), rows))], [np.zeros((rows, N.shape[1])), np.eye(rows)]])
        i, a = np.nonzero(P)
        factor = P[i, a]
        I, J = (x.ravel() for x in np.meshgrid(np.arange(len(i)), np.arange(len(i)), indexing="ij"))
        used = index[i[I], i[J]] < zero  # a place that holds zero adds nothing
        I, J = I[used], J[used]
        target = a[I] * P.shape[1] + a[J]
        order = np.argsort(target, kind="stable")
        I, J, target = I[order], J[order], target[order]
        first = np.searchsorted(target, target)
        depth = np.arange(len(target)) - first  # how many entries of the sum came before
        self.width, size = int(depth.max()) + 1, P.shape[1] ** 2
        table, weights = np.full((self.width, size), zero), np.zeros((self.width, size))
        table[depth, target], weights[depth, target] = index[i[I], i[J]], factor[I] * factor[J]
        self.table, self.weights = torch.from_numpy(table.ravel()), torch.from_numpy(weights)[..., None]
        self.plain = self.width == 1 and bool((weights[0][table[0] < zero] == 1.0).all())  # the last place is zero

    def __call__(self, flat: Tensor) -> Tensor:
        entries = flat.index_select(0, self.table)
        return entries if self.plain else (entries.unflatten(0, self.weights.shape[:2]) * self.weights).sum(0)
