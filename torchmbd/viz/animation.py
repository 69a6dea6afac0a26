"""Animation of a mechanism in one self-contained HTML file: play, time, deformation scale, mouse rotation, histories.

The file needs no network and no library (viewer.html, a canvas). Displacements of a flexible body are stored as few shapes
with weights over time,

    u(t) = sum_j weight_j(t) shape_j            singular value decomposition of the displacements, cut at 1e-5

Exaggerated is the deformation relative to the joints: displacements less the affine field through those of the body's joint
nodes. So bodies stay joined at any scale, and at scale 1 the picture is the true motion.

    plates    triangles, colored by the size of that deformation
    beams     lines, colored the same way
    rigid     a link through the joint frames of the body; a box at the center of mass where there is only one
    joints    white disks; a triangle where a joint is on the ground

Below are the histories of the responses of a problem with names, units and limits; without a problem the strain energies.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchmbd.design.problem import Problem
from torchmbd.design.words import unit
from torchmbd.errors import InputError
from torchmbd.fem.mesh import Mesh, cut_quads
from torchmbd.multibody.bodies.flexible_beam import BeamNode
from torchmbd.viz.panels import display_unit, full_name, panels_of, require_problem

_VIEWER = Path(__file__).with_name("viewer.html")
_NONE = np.empty(0, dtype=int)  # no elements
_TOLERANCE = 1e-5  # of the largest displacement: below a pixel at any useful scale


def animate(
    motion: Any,
    path: str | Path,
    lane: int = 0,
    title: str | None = None,
    scale: float | None = None,
    max_frames: int = 1000,
    problem: Problem | None = None,
) -> Path:
    """Write the motion of one lane as an HTML file and return its path.

    motion      a Trajectory
    lane        which design of the batch
    scale       factor of the deformation at first; None: the largest deformation is drawn as 5 % of the picture
    max_frames  largest number of times; of a longer motion every n-th time is kept
    problem     its objective and constraints are drawn over time; None: strain energies

    >>> motion = mbd.simulate(mbd.examples.arm(), 0.1, steps=40)
    >>> mbd.viz.animate(motion, "arm.html", title="An arm swings").name
    'arm.html'
    """
    path = page_path(path)
    require_motion(motion)
    require_lane(motion, lane)
    frames = spread_frames(motion, max_frames)
    if problem is not None:
        require_problem(problem)
    scene = scene_of(motion, lane, frames)
    scene["strips"] = _strips(problem, motion, lane, frames, scene)
    scene["title"] = title or " - ".join(body["name"] for body in scene["bodies"])
    if scale is not None:
        scene["scale"] = float(scale)
    return write_scene(scene, path)


def page_path(path: str | Path) -> Path:
    """The path of a page; InputError for another ending."""
    path = Path(path)
    if path.suffix not in (".html", ".htm"):
        raise InputError("path", str(path), "a name that ends in .html")
    return path


def write_scene(scene: dict[str, Any], path: Path) -> Path:
    """Write a scene with its strips and its title as an HTML file."""
    text = json.dumps(scene, allow_nan=False).replace("<", "\\u003c")  # no text ends or opens an element
    path.write_text(_VIEWER.read_text(encoding="utf-8").replace("__SCENE__", text), encoding="utf-8")
    return path


def require_motion(motion: Any) -> None:
    """InputError unless the argument is a motion."""
    if not hasattr(motion, "status"):
        raise InputError("motion", motion, "a motion, the result of mbd.simulate(...)")


def require_lane(motion: Any, lane: int) -> None:
    """InputError unless a motion has this lane, and the lane has not failed."""
    if not 0 <= lane < len(motion.status):
        raise InputError("lane", lane, f"0 to {len(motion.status) - 1}, the lanes of the motion", shown=f"{lane}")
    if motion.status[lane].startswith("failed"):
        raise InputError(
            "lane",
            lane,
            noun=f"lane {lane}",
            allowed="a lane whose motion could be computed",
            state=f"has no motion to show, because it {motion.status[lane]}",
        )


def lane_labels(motion: Any, labels: Sequence[str] | None) -> list[str]:
    """A name for each lane of a motion, "design 1", ... for None; InputError for other arguments."""
    require_motion(motion)
    if labels is None:
        return [f"design {k + 1}" for k in range(motion.lanes)]
    if isinstance(labels, str) or len(labels) != motion.lanes:
        raise InputError(
            "labels", labels, f"{motion.lanes}, one for each design of the motion, or None", state=f"are {labels!r}"
        )
    return list(labels)


def spread_frames(motion: Any, max_frames: int) -> np.ndarray:
    """Return the indices of every n-th time, the first and the last among them, `max_frames` at most."""
    if max_frames < 2:
        raise InputError("max_frames", max_frames, "2 or more", shown=f"{max_frames}")
    last = len(motion.t) - 1
    return np.unique([*range(0, last + 1, max(1, -(-last // (max_frames - 1)))), last])


def scene_of(motion: Any, lane: int, frames: np.ndarray) -> dict[str, Any]:
    """Return the data that viewer.html and film.py draw: bodies, joints and view at the times of these indices."""
    t = _array(motion.t)
    drawn = [body for body in motion.system.bodies if not isinstance(body, BeamNode)] + list(motion.system.beams)
    index = {body.name: k for k, body in enumerate(drawn)}
    index |= {node.name: index[beam.name] for beam in motion.system.beams for node in beam.node_bodies}
    joints = list(motion.system.joints)
    sides = [side for joint in joints for side in (joint.a, joint.b)]
    bodies, visited, largest = [], [], 0.0
    for body in drawn:
        state = motion.body(body.name)
        own_frames = [side for side in sides if index.get(side.body.name) == index[body.name]]
        r, A = _array(state.r)[lane][frames], _array(state.A)[lane][frames]
        entry: dict[str, Any] = {"name": body.name, "r": _packed(r), "A": _packed(A)}
        if state.mesh is None:
            ends = [_array(side.point).tolist() for side in own_frames]
            # Each once.
            points = np.array(list({tuple(np.round(end, 12)): end for end in ends}.values())).reshape(-1, 3)
            center = _array(body.center.detach()).reshape(1, 3)
            entry |= {"points": points.tolist(), "center": center[0].tolist()}
            local = (points if len(points) > 1 else np.concatenate([points, center]))[None]
        else:
            local, size = _flexible(entry, state, lane, frames, {node for side in own_frames for node in _nodes(side)})
            largest = max(largest, size)
        visited.append(r[:, None] + np.einsum("tij,tnj->tni", A, np.broadcast_to(local, (len(r), *local.shape[1:]))))
        bodies.append(entry)
    visited.append(np.array([_array(s.point) for s in sides if s.body.name not in index]).reshape(1, -1, 3))
    box = np.concatenate([points.reshape(-1, 3) for points in visited])
    low, high = box.min(0), box.max(0)
    extent = float(np.linalg.norm(high - low)) or 1.0
    return {
        "t": _packed(t[frames]),
        "bodies": bodies,
        "joints": [marker for joint in joints for marker in _markers(joint, index)],
        "center": ((low + high) / 2).tolist(),
        "extent": extent,
        "size": (high - low).tolist(),
        "view": "xyz"[int((high - low).argmin())],  # look along the shortest side of the space that is visited
        "largest": largest,
        "scale": _round(0.05 * extent / largest) if largest else 1.0,
    }


def _strips(
    problem: Problem | None, motion: Any, lane: int, frames: np.ndarray, scene: dict[str, Any]
) -> list[dict[str, Any]]:
    """Return a strip for each history of the responses of a problem; if there is none, one of all strain energies."""
    strips = []
    for panel in [] if problem is None else panels_of(problem):
        factor, name = display_unit(unit(panel.history))
        y = factor * _array(panel.history(motion))[lane][frames]
        limits = [factor * limit for limit, _ in panel.limits]
        label = f"{full_name(panel.history)} ({'; '.join(panel.goals)})"
        strips.append({"label": label, "unit": name, "limits": limits, "curves": [{"name": "", "y": _packed(y)}]})
    curves = [{"name": body["name"], "y": body["energy"]} for body in scene["bodies"] if "energy" in body]
    if curves and not strips:
        strips.append({"label": "strain energy", "unit": "J", "limits": [], "curves": curves})
    return strips


def _flexible(
    entry: dict[str, Any], state: Any, lane: int, frames: np.ndarray, joint_nodes: set[int]
) -> tuple[np.ndarray, float]:
    """Add mesh, shapes and energy to the entry; return the deformed nodes in body axes and the largest deformation."""
    u = _array(state.displacements)[lane][frames]
    r, A, nodes = (_array(x)[lane][frames[0]] for x in (state.r, state.A, state.nodes))
    x = (nodes - r) @ A - u[0]
    shapes, weights = _low_rank(u.reshape(len(frames), -1))
    modes = shapes.reshape(len(shapes), -1, 3)
    relative = modes - through_joints(x, modes, sorted(joint_nodes))
    mesh, triangles = state.mesh, _NONE
    if isinstance(mesh, Mesh):
        triangles = torch.cat([mesh.triangles, cut_quads(mesh.nodes, mesh.quads).flatten(0, 1)])
    entry.update(
        x=_packed(x),
        triangles=triangles.flatten().tolist(),
        lines=_array(getattr(mesh, "elements", getattr(mesh, "lines", _NONE))).reshape(-1).tolist(),
        modes=_packed(shapes),
        relative=_packed(relative),
        weights=_packed(weights),
        energy=_packed(_array(state.strain_energy)[lane][frames]),
    )
    deformation = np.einsum("tk,knc->tnc", weights, relative)
    return x + u, float(np.linalg.norm(deformation, axis=-1).max())


def through_joints(x: np.ndarray, u: np.ndarray, joints: list[int]) -> np.ndarray:
    """Return the affine fields of least norm that agree (in least squares) with u [k, n, 3] at the joint nodes."""
    if not joints:
        return np.zeros_like(u)
    center = x[joints].mean(0)
    spread = np.linalg.pinv(x[joints] - center, rcond=1e-9)  # [3, joints]
    mean = u[:, joints].mean(1, keepdims=True)
    return mean + np.einsum("ni,ij,kjc->knc", x - center, spread, u[:, joints] - mean)


def _low_rank(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return shapes [k, n] and weights [t, k] with u [t, n] = weights @ shapes, up to 1e-5 of the largest singular value."""
    U, s, Vt = np.linalg.svd(u, full_matrices=False)
    k = max(1, int((s > _TOLERANCE * s[0]).sum()))
    return Vt[:k], U[:, :k] * s[:k]


def _markers(joint: Any, index: dict[str, int]) -> list[dict[str, Any]]:
    """Return the markers of a joint: on its second body, and on the ground if it is there, with a line between both."""
    if type(joint).__name__ in ("Drive", "JointCoupling"):
        return []  # they have no point; the joints beside them are drawn
    sides = sorted((joint.a, joint.b), key=lambda side: side.body.name in index)  # the ground first
    drawn = sides if sides[0].body.name not in index else [joint.b]
    markers = [
        {"body": index.get(side.body.name, -1), "point": _array(side.point).tolist(), "node": _node(side)}
        for side in drawn
    ]
    if len(markers) == 2:
        markers[1]["rail"] = markers[0]["point"]
    return markers


def _nodes(side: Any) -> tuple[int, ...]:
    """Return the mesh nodes to which a frame is attached."""
    return (side.body.index,) if isinstance(side.body, BeamNode) else side.interpolation.nodes


def _node(side: Any) -> int | None:
    """Return the mesh node at which a frame is drawn."""
    if isinstance(side.body, BeamNode):
        return side.body.index
    if side.interpolation is None:
        return None
    return side.interpolation.nearest(side.body.mesh.nodes - side.body.origin, side.point)


def _round(x: float) -> float:
    """Return x rounded down to 1, 2 or 5 times a power of ten, at least 1."""
    power = 10.0 ** np.floor(np.log10(x))
    return max(1.0, float(power * max(step for step in (1, 2, 5) if step * power <= x)))


def _array(x: Any) -> np.ndarray:
    return x.detach().cpu().numpy() if isinstance(x, torch.Tensor) else np.asarray(x)


def _packed(x: np.ndarray) -> str:
    if not np.isfinite(x).all():
        raise InputError(
            "motion",
            hint="motion.status, which says why a lane failed",
            state="has numbers that are not finite",
            allowed="finite to be shown",
        )
    return base64.b64encode(np.ascontiguousarray(x, dtype="<f4").tobytes()).decode("ascii")
