"""Blocks of the saddle-point matrix: of all bodies and all rows at once.

    mass, r_om, om_r, inertia           forces by r'', forces by omega', torques by r'', torques by omega'
    r_w, w_r, om_w, w_om                forces by w'', modal forces by r'', torques by w'', modal forces by omega'
    modal                               modal forces by w''
    row_force, row_torque, row_modal    Phi_q' by pairs (row, body);  row_turn: torques in Phi_q
    beam                                forces and torques of beam elements by both ends; of an iteration matrix only

With `Slopes`, the derivatives of all other forces by coordinates and rates, the same text makes the iteration matrix of an
implicit integrator.
Checked in tests/multibody/equations/test_equations.py: every column is the difference of the residual that it stands for.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.math.pair import cat, cross, matmul, matvec, matvec_t
from torchmbd.math.rotation import axial, increment_torque, skew
from torchmbd.multibody.equations import beams
from torchmbd.multibody.equations.data import Data
from torchmbd.multibody.equations.equations import (
    Placement,
    beam_rates,
    split_v,
    total_on_vectors,
    turns_of_vectors,
)
from torchmbd.multibody.equations.index_maps import SegmentSum
from torchmbd.multibody.equations.moments import Moments, bent_stiffness, frame_terms, moments
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.equations.unit_forces import Block, UnitForces

# Blocks below the diagonal that are, without rates and accelerations, those above it.
MIRRORED = {"r_om": "om_r", "r_w": "w_r", "om_w": "w_om"}


class Slopes(NamedTuple):
    """What an iteration matrix has beside the masses: derivatives of the other forces by coordinates and rates.

    stiffness, damping  factors of Kr and D; `damping` also multiplies the gyroscopic matrix of the rates `v`, `stiffness` that
                        of the inertia forces of the rates and accelerations `a`, and the geometric stiffness of the
                        multipliers `lam`, if they are given [n, 1, lanes]
    turn                rotations [3, bodies, 1, lanes] of an increment: Phi_q is then the derivative with respect to the
                        increment
    """

    stiffness: Any = 0.0
    damping: Any = 0.0
    v: Any = None
    a: Any = None
    lam: Any = None
    turn: Any = None


MASSES = Slopes()  # none: the matrix of the accelerations


class SaddleBlocks:
    """The blocks of one topology, of unit multipliers of its rows and unit strengths of its actions."""

    def __init__(self, T: Topology, rows: UnitForces, actions: UnitForces):
        self.T, self.rows, self.actions = T, rows, actions
        self._body_sum = SegmentSum([b if b < T.bodies else -1 for b in T.vector_body.tolist()], T.bodies)

    def shapes(self) -> list[Block]:
        """Names and shapes, in the order of the entries."""
        n, f, m = self.T.bodies, self.T.flexible, self.T.modes
        shapes = [
            ("mass", (n,)),
            ("r_om", (3, 3, n)),
            ("om_r", (3, 3, n)),  # [r'', torque]
            ("inertia", (3, 3, n)),
            ("r_w", (3, m, f)),
            ("w_r", (3, m, f)),  # [r'', mode]
            ("om_w", (3, m, f)),
            ("w_om", (3, m, f)),  # [omega', mode]
            ("modal", (m, m, f)),
        ]
        rows = self.rows.shapes(m, "row") if self.T.rows else []
        rows += [("row_turn", rows[1][1])] if rows else []
        return shapes + rows + self._beam_shapes()

    def _beam_shapes(self) -> list[Block]:
        beams = self.T.beams
        return [] if beams is None else [("beam", (12, 12, len(beams.ends) // 2))]

    def action_shapes(self) -> list[Block]:
        """Of the directions of the actions."""
        return self.actions.shapes(self.T.modes, "action")

    def __call__(self, data: Data, at: Placement, slopes: Slopes = MASSES) -> dict[str, Any]:
        """The blocks [component..., 1, lanes] by name."""
        T, (stiffness, damping, v, a, lam, turn) = self.T, slopes
        body = moments(T, data, at.w)
        blocks = self._mass_blocks(data, at, body, stiffness, damping)
        blocks |= {mirrored: blocks[name] for name, mirrored in MIRRORED.items() if name in blocks}
        if v is not None:
            _, om, wd = split_v(T, v)
            spin = skew(om)
            self._add_gyroscopic(blocks, data, at, body, damping, (om, wd, spin))
            if a is not None:
                self._add_inertial(blocks, data, at, body, stiffness, (wd, spin), split_v(T, a))
        if body.V is not None:
            self._add_second_order(blocks, data, at, body.V, slopes)
        if lam is not None:
            pulls = total_on_vectors(T, data, at, v, lam)
            if pulls is not None:
                self._add_geometric(blocks, data, at, stiffness, pulls)
        if T.beams is not None and v is not None:
            turned = None if turn is None else turns_of_vectors(T, turn)
            blocks["beam"] = beams.stiffness(T, data, at, beam_rates(T, data, at, v), stiffness, damping, turned)
        if T.rows:
            blocks |= self._row_blocks(data, at)
            torque, pair_body = blocks["row_torque"], self.rows.pair_body
            blocks["row_turn"] = torque if turn is None else increment_torque(turn.index_select(1, pair_body), torque)
        # A system without flexible bodies has no modal blocks yet.
        missing, like = {name: shape for name, shape in self.shapes() if name not in blocks}, blocks["mass"]
        return blocks | {name: like.new_zeros(*shape, *like.shape[-2:]) for name, shape in missing.items()}

    def action_slopes(
        self, data: Data, at: Placement, states: list[tuple], slopes: Slopes
    ) -> tuple[dict[str, Any], Any]:
        """Directions of the actions, as blocks, and what their laws add to the matrix along them [actions, 1, lanes].

        states: of the actions (equations.action_states).
        """
        forces, weights = [], []
        for action, (s, rate, direction) in zip(self.T.actions, states, strict=True):
            forces += direction
            by_s, by_rate = action.slopes(s, rate, at.t, data)
            weights.append(-(slopes.stiffness * by_s + slopes.damping * by_rate))
        blocks = self.actions.blocks(data, at, cat(forces, 1), "action")
        if "action_modal" not in blocks:
            blocks["action_modal"] = blocks["action_force"].new_zeros(0, 1, 1)
        return blocks, cat(weights)

    def _mass_blocks(self, data: Data, at: Placement, body: Moments, stiffness: Any, damping: Any) -> dict[str, Tensor]:
        T = self.T
        n, f = T.bodies, T.flexible
        eye = torch.eye(3, dtype=at.A.dtype, device=at.A.device)[:, :, None, None, None]
        A = at.A[:, :, :n]
        S, P, G, SR, _ = body
        trace = P[0, 0] + P[1, 1] + P[2, 2]
        blocks = {
            "mass": data["mass"],
            "r_om": -matmul(A, skew(S)),
            "inertia": eye * (trace + data["mu"]) - P,
        }
        if G is not None:
            A_f = A[:, :, :f]
            blocks["r_w"] = (A_f[:, :, None] * SR[:3][None]).sum(1)
            blocks["om_w"] = axial(G) + SR[3:]
            modal = T.modal_identity(data["Kr"]) + stiffness * data["Kr"]
            if "K2" in data:
                modal = modal + stiffness * bent_stiffness(data, at.w)
            blocks["modal"] = modal + damping * data["D"] if "D" in data else modal
        return blocks

    def _add_gyroscopic(
        self,
        blocks: dict[str, Tensor],
        data: Data,
        at: Placement,
        body: Moments,
        factor: Any,
        rates: tuple[Tensor, Tensor, Tensor],
    ) -> None:
        """Add the derivatives of the inertia forces by om and w' (equations.py)."""
        T, (om, wd, spin), (S, _, G, SR, _) = self.T, rates, body
        f = T.flexible
        A, J = at.A[:, :, : T.bodies], blocks["inertia"]
        drift = cross(om, S)
        if G is not None:
            bending = drift[:, :f] + 2.0 * matvec(SR[:3], wd)
            drift = cat([bending, drift[:, f:]], 1) if f < T.bodies else bending
        blocks["r_om"] = blocks["r_om"] - factor * matmul(A, skew(drift) + matmul(spin, skew(S)))
        blocks["inertia"] = J + factor * (matmul(spin, J) - skew(matvec(J, om)))
        if G is not None:
            om_f, spin_f = om[:, :f], spin[:, :, :f]
            twice = 2.0 * factor * spin_f
            coriolis = matmul(twice, SR[:3])
            R1, X = SR[3:], (G * wd).sum(2)
            turning = matmul(factor * spin_f, R1) + axial((twice[:, :, None, None] * G[None]).sum(1))
            blocks["r_w"] = blocks["r_w"] + matmul(A[:, :, :f], coriolis)
            blocks["om_w"] = blocks["om_w"] + turning
            eye = torch.eye(3, dtype=om.dtype, device=om.device)[:, :, None, None, None]
            stirred = 2.0 * (eye * (X[0, 0] + X[1, 1] + X[2, 2]) - X) - skew(matvec(R1, wd))
            blocks["inertia"] = cat([blocks["inertia"][:, :, :f] + factor * stirred, blocks["inertia"][:, :, f:]], 2)
            both = G + G.transpose(0, 1)
            trace = G[0, 0] + G[1, 1] + G[2, 2]
            centrifugal = (both * om_f[None, :, None]).sum(1) - 2.0 * om_f[:, None] * trace[None]
            coriolis = (data["H"] * wd).sum(2)
            blocks["w_om"] = blocks["w_om"] + factor * (centrifugal + coriolis)
            blocks["modal"] = blocks["modal"] + factor * (data["H"] * om_f[:, None, None]).sum(0)

    def _add_inertial(
        self,
        blocks: dict[str, Tensor],
        data: Data,
        at: Placement,
        body: Moments,
        factor: Any,
        rates: tuple[Tensor, Tensor],
        accelerations: tuple[Tensor, Tensor, Tensor],
    ) -> None:
        """Add the derivatives of the inertia forces by the rotations and by w (equations.py)."""
        T, (wd, spin), (rdd, omd, wdd), (S, _, G, SR, _) = self.T, rates, accelerations, body
        f = T.flexible
        A = at.A[:, :, : T.bodies]
        Z = skew(omd) + matmul(spin, spin)
        u = matvec_t(A, rdd - data["gravity"] if "gravity" in data else rdd)
        h = matvec(Z, S)
        if G is not None:
            S1, C1 = SR[:3], data["C1"]
            Z_f, spin_f, u_f = Z[:, :, :f], spin[:, :, :f], u[:, :f]
            bending = h[:, :f] + matvec(S1, wdd) + 2.0 * matvec(spin_f, matvec(S1, wd))
            h = cat([bending, h[:, f:]], 1) if f < T.bodies else bending
            blocks["r_w"] = blocks["r_w"] + factor * matmul(A[:, :, :f], matmul(Z_f, S1))
            slow, fast = ((C1 * x[:, None]).sum(2) for x in (wd, wdd))  # [3, 3, modes, flexible]
            dP = G + G.transpose(0, 1)  # C1_ijab = C1_jiba
            turned = _times(Z_f, dP) + fast + 2.0 * _times(spin_f, slow)
            pulled = matmul(skew(u_f), S1)
            blocks["om_w"] = blocks["om_w"] + factor * (axial(turned) - pulled)
            blocks["w_om"] = blocks["w_om"] - factor * pulled
            blocks["modal"] = blocks["modal"] + factor * (Z_f[:, :, None, None] * C1).flatten(0, 1).sum(0)
        blocks["r_om"] = blocks["r_om"] - factor * matmul(A, skew(h))
        blocks["inertia"] = blocks["inertia"] + factor * matmul(skew(S), skew(u))

    def _add_second_order(
        self, blocks: dict[str, Tensor], data: Data, at: Placement, V: Tensor, slopes: Slopes
    ) -> None:
        """Add the mass of V, and d/dw' and d/dw of the terms with F1, axial F2 and V (equations.py)."""
        stiffness, damping, v, a, *_ = slopes
        T, f, V0, V1, root = self.T, self.T.flexible, data["V0"], data["V1"], data["L"][0, 0]
        modal = -(V0[:, :, None] * V0[:, None]).sum(0)
        moved = V  # with what w'' and w' add to it
        if v is not None:
            _, om, wd = (x[:, :f] for x in split_v(T, v))
            slow = (V1 * wd[:, None]).sum(1)  # [6, modes, flexible]
            moved = moved + 2.0 * damping * slow
            pull, twist = frame_terms(data, 2.0 * damping * slow)
            if a is not None:
                rdd, _, wdd = (x[:, :f] for x in split_v(T, a))
                u = matvec_t(at.A[:, :, :f], rdd - data["gravity"] if "gravity" in data else rdd)
                fast = (V1 * wdd[:, None]).sum(1)
                moved = moved + stiffness * fast
                pull = pull + stiffness * root * (fast[:3] + 2.0 * matmul(skew(om), slow[:3]))
                rate = matvec(V, wdd) + matvec(slow, wd)
                modal = modal + stiffness * (cat([rate[:3] + root * u, rate[3:]])[:, None, None] * V1).sum(0)
            blocks["r_w"] = blocks["r_w"] + matmul(at.A[:, :, :f], pull)
            blocks["om_w"] = blocks["om_w"] + twist
        blocks["modal"] = blocks["modal"] + modal + (V[:, :, None] * moved[:, None]).sum(0)

    def _add_geometric(self, blocks: dict[str, Tensor], data: Data, at: Placement, factor: Any, pulls: Tensor) -> None:
        """Add what the forces on attached vectors change by when bodies turn and bend under them, forces held in ground axes.

        A rod under tension has a mode of small inertia in which its frame turns against its bending; there this
        matters as much as the inertia.
        """
        T = self.T
        local = matvec_t(at.A_of, pulls)
        turned = matmul(skew(at.rho), skew(local))
        torque = self._body_sum(turned.flatten(0, 1)).unflatten(0, (3, 3))
        blocks["inertia"] = blocks["inertia"] + factor * torque
        if T.attached_flexible:
            local = local[:, : T.attached_flexible]
            bent = -matmul(skew(local), at.Y)
            twist = factor * T.modal_sum(bent.flatten(0, 1)).unflatten(0, (3, T.modes))
            blocks["om_w"], blocks["w_om"] = blocks["om_w"] + twist, blocks["w_om"] + twist
            if "E" in data:
                pulled = (data["E"] * local[:, None, None]).sum(0)
                modal = T.modal_sum(pulled.flatten(0, 1)).unflatten(0, (T.modes, T.modes))
                blocks["modal"] = blocks["modal"] + factor * modal

    def _row_blocks(self, data: Data, at: Placement) -> dict[str, Any]:
        forces = []
        for primitive, arguments, drive in zip(self.T.primitives, at.arguments, at.drives, strict=True):
            vectors = [x.unsqueeze(1) for x in arguments]
            eye = torch.eye(primitive.rows, dtype=at.g.dtype, device=at.g.device)
            lam = eye[:, :, None, None, None] + torch.zeros_like(vectors[0][:1])
            forces += [force.flatten(1, 2) for force in primitive.forces(vectors, lam, drive)]
        return self.rows.blocks(data, at, cat(forces, 1), "row")


def _times(A: Tensor, B: Tensor) -> Tensor:
    """Matrix [3, 3, n] times matrices [3, 3, modes, n]."""
    return (A[:, :, None, None] * B[None]).sum(1)
