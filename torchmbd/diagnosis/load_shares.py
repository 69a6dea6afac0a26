"""The part of loads in the stiffness of bodies without stiffening: where linear elastic displacements cease to hold.

    Kg(t) = sum_i u_i F1_i + sum_ij Z_ij F2_ij + sum_v p_v . f_v       share = max |x' Kg x| / (x' Kr x)

u, Z   acceleration of the body frame less gravity in its axes, ~omega' + ~omega ~omega: loads of inertia
p, f   forces of joints and force elements on attached vectors, and displacements of second order of these
F1, F2, f of the built design, the body held at its reference (multibody/bodies/stiffening.py)

Tension stiffens a body and pressure softens it, with spin or without. At a share of one the body, held at its reference,
buckles; errors of deflections are of the size of the share, and depend on the reference as it does: beside the tangent at its
end a rod turns far, beside the one at its middle hardly.

All loads are means over a quarter of the period of om_1, the lowest frequency of the body with its reference nodes fixed. A
body does not yield to faster ones: after a latch the fastest modes shake at om v, which grows with the number of modes and with
that of the steps that resolve them, and leaves no lasting load.

The multipliers in p take longer than a motion. So the share is computed for a new kind of loads, and otherwise follows from
their size, as it is proportional to loads of one kind:

    size = (sum m |r'' - g| + sum |p| of force elements) / (m om_1^2 length),   om_1, length: of the body

A kind has the loads of one system, and the largest and the least value of each load, as a share of all. A change of temperature
counts by its forces on all nodes.
Bodies whose frames have more than `_MOST_NODES` nodes are not looked at, nor are those of rods, springs and solids.
Checked in tests/diagnosis/test_elastic_limits.py, tests/validation/test_flexible_benchmarks.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import LoadWarning, warn
from torchmbd.fem.elements import GivenElements
from torchmbd.math.pair import matvec_t, value
from torchmbd.math.rotation import skew
from torchmbd.multibody.bodies.rigid import Ground
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.modal_data import frame_nodes
from torchmbd.multibody.forces.contact_law import ContactControl
from torchmbd.multibody.forces.temperature import ExpansionVector
from torchmbd.results.motion_data import has_failed
from torchmbd.results.reaction import in_lanes, placement_at_times
from torchmbd.results.trajectory import Trajectory

_LOADED = 0.05  # share of loads: errors of five percent
_SMALL = 0.005  # size of loads below which no share is large: a force at the end of a rod has a share of 3 to 6 sizes
_GROWN = 1.1  # factor of the size beyond which a share is computed anew
_LIKE = 0.1  # share of the size by which loads of one kind may differ
_KINDS = 8  # of loads that are kept of a body: a search may alternate between load cases
_STATES = 8192  # times x lanes whose loads are computed at once: some kilobytes each
_MOST_NODES = 60  # of frames: there are six unit loads for each


@dataclass(frozen=True)
class _Kind:
    """Loads on a body: their size, their largest and least values (`_sizes`), and their share."""

    size: float
    peaks: Tensor
    share: float

    def has(self, size: float, peaks: Tensor) -> bool:
        """True if loads are of this kind, and not much larger."""
        other = float((peaks - size / self.size * self.peaks).abs().max())
        return size <= _GROWN * self.size and other <= max(_SMALL, _LIKE * size)


def load_shares(motion: Trajectory) -> dict[str, float]:
    """Largest share of every flexible body of plates and beams without stiffening; none where there are controllers."""
    T, shares = motion.dynamics.topology, {}
    if any(not isinstance(link.control, ContactControl) for link in T.links.each):
        return shares  # modules of controllers are called for one state at a time, as they were in the motion
    bodies = [(k, motion.system.body(name)) for k, name in enumerate(T.names[: T.flexible])]
    bodies = [(k, body) for k, body in bodies if body.stiffening is None and body.given_structure is None]
    bodies = [  # whose geometric stiffness is known
        (k, body)
        for k, body in bodies
        if not any(isinstance(part, GivenElements) for part in body.assembly.parts.values())
    ]
    if not bodies:
        return shares
    intervals = [_intervals(motion, name) for name in T.names[: T.flexible]]
    loads = _sizes(motion, intervals)
    known = _known_kinds(motion.system)
    unknown = []
    for k, body in bodies:
        size, _ = loads[k]
        kind = next((x for x in known.get(body.name, []) if x.has(*loads[k])), None)
        shares[body.name] = 0.0 if kind is None else kind.share * size / kind.size
        if kind is None and size > _SMALL and len(frame_nodes(T, k)) <= _MOST_NODES:
            unknown.append((k, body))
    for (k, body), share in zip(unknown, _largest_shares(motion, unknown, intervals), strict=True):
        shares[body.name], (size, peaks) = share, loads[k]
        known[body.name] = [_Kind(size, peaks, share), *known.get(body.name, [])][:_KINDS]
    return shares


def _known_kinds(system: Any) -> dict[str, list[_Kind]]:
    """Name of a body -> kinds of its loads in the motions of a system."""
    return system.diagnosed.setdefault("loads", {})


def warn_of_loads(motion: Trajectory) -> None:
    """Keep the shares in stats["load_share"], and warn of those that are large."""
    motion.stats["load_share"] = load_shares(motion)
    for name, share in motion.stats["load_share"].items():
        if share > _LOADED:
            warn(  # few different texts: Python shows each once in an optimization
                f"body {name!r}: tension and pressure of its loads are {share:.1g} of its stiffness. The body has no geometric "
                "stiffness, so its deflections have a relative error of about this size. Try: stiffening=True, or a reference "
                "in the middle of the body, which reduces the error",
                LoadWarning,
            )


def notes_of_loads(system: Any) -> list[str]:
    """A sentence on each body of a system whose loads were large in its motions of this process."""
    shares = {name: max(kind.share for kind in kinds) for name, kinds in _known_kinds(system).items()}
    return [
        f"linear elastic displacements leave out tension and pressure of the loads of body {name!r}, up to {share:.1g} of its "
        "stiffness in these motions; with stiffening=True they are part of it"
        for name, share in shares.items()
        if share > _LOADED
    ]


def _intervals(motion: Trajectory, name: str) -> int:
    """Intervals between times that a quarter of the longest period of a flexible body has, in its stiffest lane."""
    lowest = torch.linalg.eigvalsh(motion.body(name).stiffness[0].detach())[:, :1].clamp_min(0.0).sqrt()
    count = len(motion.t) - 1
    fastest = float(lowest.nan_to_num(0.0, 0.0, 0.0).amax()) if lowest.numel() else 0.0
    quarter = 0.5 * math.pi * count / (fastest * float(motion.t[-1])) if fastest and count else float(count)
    return round(min(quarter, count))


def _means(x: Tensor, intervals: int, axis: int) -> Tensor:
    """Means of x over all successive times that `intervals` lie between, along its axis; an unknown x counts as zero."""
    if not intervals:
        return x
    x = x.movedim(axis, 0)
    between = (0.5 * (x[1:] + x[:-1])).nan_to_num_(0.0, 0.0, 0.0)
    total = torch.cat([torch.zeros_like(x[:1]), between.cumsum(0)])
    return ((total[intervals:] - total[:-intervals]) / intervals).movedim(0, axis)


def _sizes(motion: Trajectory, intervals: Sequence[int]) -> list[tuple[float, Tensor]]:
    """Size of all loads by that of each flexible body (module header), and the largest and the least value of each [6 loads] in
    the same unit, positive where they are; of all lanes and times.

    intervals   over which the loads on each body are averaged
    """
    T, data = motion.dynamics.topology, motion.dynamics.data
    mass = value(data["mass"])[:, 0]
    weights = [mass[..., None], *([_newtons(T)[:, None, None]] if T.actions else [])]
    loads = list(zip(_by_parts(motion, _loads_of_all, -1), weights, strict=True))
    largest, peaks = _largest_loads(loads, intervals, _known(motion))
    sizes = []
    for k, name in enumerate(T.names[: T.flexible]):
        lowest = torch.linalg.eigvalsh(motion.body(name).stiffness[0].detach())[..., 0].clamp_min(0.0).reshape(-1)
        second = value(data["P0"])[:, :, k, 0].diagonal().sum(-1)  # mass times a square of its length
        unit = lowest * (mass[k] * second).sqrt()
        size, each = ((x / unit).nan_to_num(0.0, 0.0, 0.0).amax(-1) for x in (largest[k], peaks[k]))
        sizes.append((float(size), each))
    return sizes


def _by_parts(motion: Trajectory, function: Callable[[Trajectory], Sequence[Tensor]], times: int) -> list[Tensor]:
    """Numbers at all states, with this axis of times, computed by parts: intermediate numbers take kilobytes for each state."""
    return [torch.cat(x, times) for x in zip(*map(function, motion.parts(_STATES)), strict=True)]


def _loads_of_all(motion: Trajectory) -> list[Tensor]:
    """Accelerations of all bodies, less gravity, and forces on attached vectors if there are any [3, ., lanes, times]."""
    T, data, shape = motion.dynamics.topology, motion.dynamics.data, (motion.lanes, len(motion.t))
    acceleration = in_lanes(motion.a)[: 3 * T.bodies].unflatten(0, (3, -1))
    if "gravity" in data:
        acceleration = acceleration - _at_all_times(motion, data["gravity"])
    vectors = [acceleration[:, :, 0].unflatten(-1, shape)]
    if T.actions:
        wide, at = placement_at_times(motion)
        vectors.append(equations.applied_on_vectors(T, wide, at, in_lanes(motion.v))[:, :, 0].unflatten(-1, shape))
    return vectors


def _largest_loads(
    loads: Sequence[tuple[Tensor, Tensor]], intervals: Sequence[int], known: Tensor
) -> tuple[Tensor, Tensor]:
    """The largest size of all loads by the means of each flexible body [flexible, lanes] [N], and the largest value of each
    load and of its negative [flexible, 6 loads, lanes]; 0 in lanes that failed.

    loads   vectors [3, ., lanes, times] and their weights
    known   as of `_known`
    """
    largest, peaks = {}, {}
    for n in set(intervals):
        means = [(_means(x, n, -1), weight) for x, weight in loads]
        total = torch.stack([(weight * _lengths(x)).sum(0) for x, weight in means]).sum(0)
        largest[n] = (total.nan_to_num(0.0, 0.0, 0.0) * known).amax(1)
        signed = torch.cat(
            [(y * weight[..., 0]).flatten(0, 1) for x, weight in means for y in (x.amax(-1), -x.amin(-1))]
        )
        peaks[n] = signed.clamp_min(0.0).nan_to_num(0.0, 0.0, 0.0) * known[:, 0]
    return torch.stack([largest[n] for n in intervals]), torch.stack([peaks[n] for n in intervals])


def _newtons(T: Any) -> Tensor:
    """Size of the loads of unit pulls on attached vectors [vectors]: of a change of temperature, the forces on all nodes."""
    sizes = torch.ones(len(T.attached), dtype=torch.float64)
    for i, x in enumerate(T.attached):
        if isinstance(x, ExpansionVector):
            sizes[i] = x.load_size()
        elif isinstance(x.body, Ground) and not x.is_point and not bool(x.vector.any()):
            sizes[i] = 0.0  # from which the work of the change is measured
    return sizes


def _at_all_times(motion: Trajectory, x: Any) -> Tensor:
    """A number of the designs [..., lanes or 1] with lanes x times, or one, as its lanes."""
    plain = value(x)
    return plain.repeat_interleave(len(motion.t), -1) if plain.shape[-1] > 1 else plain


def _lengths(x: Tensor) -> Tensor:
    """Lengths [...] of vectors [3, ...]: torch's norm over a first axis takes 25 times as long."""
    return x.square().sum(0).sqrt()


def _largest_shares(motion: Trajectory, bodies: list[tuple[int, Any]], intervals: Sequence[int]) -> list[float]:
    """The largest share of flexible bodies, of each its number and itself."""
    if not bodies:
        return []
    T, loads, shares = motion.dynamics.topology, _by_parts(motion, _loads, 1), []
    for k, body in bodies:
        slopes = _slopes(T, k, body)
        shares.append(0.0 if slopes is None else _share(T, k, slopes, *(_means(x, intervals[k], 1) for x in loads)))
    return shares


def _slopes(T: Any, k: int, body: Any) -> Tensor | None:
    """Geometric stiffness of flexible body k by each of its loads, by its stiffness [loads, modes, modes]; None without one."""
    nodes = frame_nodes(T, k)
    with torch.no_grad():
        second = body.structure(nodes, second_order=True)
    L, singular = torch.linalg.cholesky_ex(second["Kr"])
    if int(singular) or not len(L):
        return None
    slopes = [second["F1"], second["F2"].flatten(0, 1)]
    for i, of in enumerate(T.vector_flexible.tolist()):
        if of == k:
            slopes.append(T.attached[i].quadratic_rows(second["psi"], second["psi2"], nodes).detach())
    inverse = torch.linalg.inv(L)
    return inverse @ torch.cat(slopes) @ inverse.T


def _share(T: Any, k: int, slopes: Tensor, u: Tensor, Z: Tensor, pulls: Tensor) -> float:
    """The largest share of flexible body k; loads as in `_loads`."""
    vectors = [pulls[..., i, :] for i, of in enumerate(T.vector_flexible.tolist()) if of == k]
    loads = torch.cat([u[..., k, :], Z[..., k, :, :].flatten(-2), *vectors], -1).flatten(0, 1)
    largest = 0.0
    for part in loads.split(_STATES):
        Kg = torch.tensordot(part, slopes, 1).nan_to_num(0.0, 0.0, 0.0)
        largest = max(largest, float(torch.linalg.eigvalsh(Kg).abs().amax())) if len(Kg) else largest
    return largest


def _loads(motion: Trajectory) -> tuple[Tensor, Tensor, Tensor]:
    """u [lanes, times, flexible, 3], Z [..., 3, 3], and forces on attached vectors [lanes, times, vectors, 3]."""
    T = motion.dynamics.topology
    f = T.flexible
    data, at = placement_at_times(motion)
    v, a = in_lanes(motion.v), in_lanes(motion.a)
    rdd, omd, _ = equations.split_v(T, a)
    _, om, _ = equations.split_v(T, v)
    gravity = motion.dynamics.data.get("gravity")
    if gravity is not None:
        rdd = rdd - _at_all_times(motion, gravity)
    A = at.A[:, :, :f]
    u = matvec_t(A, rdd[:, :f])
    spin = skew(om[:, :f])
    Z = skew(omd[:, :f]) + torch.einsum("ij...,jk...->ik...", spin, spin)
    pulls = equations.total_on_vectors(T, data, at, v, in_lanes(motion.lam))
    if pulls is None:
        local = u.new_zeros(3, T.attached_flexible, 1, u.shape[-1])
    else:
        local = matvec_t(at.A_of, pulls)[:, : T.attached_flexible]
    shape = (motion.lanes, len(motion.t))

    def last(x: Tensor) -> Tensor:
        return x[..., 0, :].unflatten(-1, shape).movedim((-2, -1), (0, 1))

    loads = last(u).movedim(2, -1), last(Z).movedim((2, 3), (-2, -1)), last(local).movedim(2, -1)
    known = _known(motion).bool()[:, 0]
    return loads[0][known], loads[1][known], loads[2][known]


def _known(motion: Trajectory) -> Tensor:
    """1 for lanes that have not failed, else 0 [lanes, 1]."""
    return torch.tensor([[float(not has_failed(status))] for status in motion.status], dtype=torch.float64)
