"""Loads on a flexible body along a motion, in its axes: of its inertia as a rigid body, of gravity, of joints and
forces, and of changes of temperature and moisture.

Joints and forces act on attached vectors (system/equations.py). Those of frames on the same node, or on the same mean of
several nodes (an InterpolationConstraint), add up to a force and a moment at its center.
Differentiable as the motion is.
Checked in tests/extensions/buckling/test_buckling_index.py.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.pair import matvec_t, value
from torchmbd.math.rotation import skew
from torchmbd.multibody.bodies import FlexibleBody
from torchmbd.multibody.bodies.expansion import Load
from torchmbd.multibody.bodies.interpolation import InterpolationConstraint
from torchmbd.multibody.equations import equations
from torchmbd.multibody.system import System
from torchmbd.results.body_motion import BodyMotion
from torchmbd.results.motion_data import MotionData
from torchmbd.results.ply_history import amounts, changes_of
from torchmbd.results.reaction import at_times, in_lanes, placement_at_times


class BodyLoads(NamedTuple):
    """Loads of a body in body axes.

    inertia        minus the acceleration field u + Z x of the undeformed body, less gravity, as factors of the twelve unit
                   loads of inertia (bodies/stiffening.py) [lanes, times, 12]
    concentrated   force [N] and moment [N m] at each of the `interpolations` of the body [lanes, times, interpolations, 6]
    changes        amounts of the `changes` of temperature and moisture of the body [lanes, times, changes]
    """

    inertia: Float[Tensor, "lanes times 12"]
    concentrated: Float[Tensor, "lanes times interpolations 6"]
    changes: Float[Tensor, "lanes times changes"]


def interpolations(system: System, body: FlexibleBody) -> list[InterpolationConstraint]:
    """Nodes, or means of nodes, of a body on which its frames for joints and forces are."""
    constraints = [a.interpolation for a in system.topology.attached if a.body is body and a.interpolation is not None]
    return list(dict.fromkeys(constraints))


def body_loads(motion: MotionData, body: FlexibleBody) -> BodyLoads:
    """The loads on one body. Raises InputError if phases of the motion have laws of forces of their own."""
    laws = [law for kind in motion.system.topology.actions for law in kind.laws]
    for kinds in motion.actions:  # of each phase
        phase_laws = [law for kind in kinds for law in kind.laws]
        if any(x is not y for x, y in zip(phase_laws, laws, strict=True)):
            raise InputError(
                "phases",
                allowed="phases without laws={...}",
                state="replace laws of forces",
                noun=f"loads on {body.name!r}: phases of this motion",
            )
    of_body = changes_of(motion, body)
    grown = motion.of_designs(lambda: amounts(of_body, motion.t, motion.lanes))
    return BodyLoads(_inertia(motion, body), _concentrated(motion, body), grown)


def changes(motion: MotionData, body: FlexibleBody) -> list[Load]:
    """Zone and kind of each change of temperature and moisture of a body."""
    return [(force.zone, change) for force in changes_of(motion, body) for change in force.laws]


def _inertia(motion: MotionData, body: FlexibleBody) -> Tensor:
    view = BodyMotion(motion, body.name)
    field = view.at().acceleration
    if "gravity" in motion.dynamics.data:
        field = field - value(motion.dynamics.data["gravity"])[:, 0, 0].movedim(-1, 0)[:, None]
    u = torch.einsum("ltji,ltj->lti", view.A, field)
    om, omd = (x.movedim(-1, 0) for x in (view.omega, view.omega_rate))
    spin = skew(om).movedim((0, 1), (-2, -1))
    Z = skew(omd).movedim((0, 1), (-2, -1)) + spin @ spin
    return torch.cat([u, Z.mT.flatten(-2)], -1)


def _concentrated(motion: MotionData, body: FlexibleBody) -> Tensor:
    T, x = motion.dynamics.topology, body.mesh.nodes.detach() - body.origin.detach()
    data, at = placement_at_times(motion)
    gradients = equations.total_on_vectors(T, data, at, in_lanes(motion.v), in_lanes(motion.lam))
    of_body = interpolations(motion.system, body)
    if gradients is None or not of_body:
        return motion.q.new_zeros(motion.lanes, len(motion.t), 0, 6)
    total = [motion.q.new_zeros(motion.lanes, len(motion.t), 6) for _ in of_body]
    local = -matvec_t(at.A_of, gradients)
    for i, attached in enumerate(T.attached):
        if attached.body is body and attached.interpolation is not None:
            k = of_body.index(attached.interpolation)
            f = at_times(motion, local[:, i])
            lever = attached.vector - attached.interpolation.center(x)
            if not attached.is_point:
                lever = at_times(motion, data["x"][:, i].expand(-1, -1, local.shape[-1]))
            moment = torch.linalg.cross(lever.expand_as(f), f, dim=-1)
            total[k] = total[k] + torch.cat([f if attached.is_point else torch.zeros_like(f), moment], -1)
    return torch.stack(total, 2)
