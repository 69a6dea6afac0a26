"""A motion as a table: a row for each lane and time, a column for each number, whose heading has its unit.

    body     x y z [m]  vx vy vz [m/s]  e0 to e3 [1]  wx wy wz [rad/s] in body axes, w1 w2 ... [1] modal coordinates
    beam     node 0 x [m] ...  element 0 strain x [1] ...  element 0 start N [N] ...
    joint    force x y z [N]  torque x y z [N m]    on the joint's second body, about its point, in ground axes

Each heading begins with the name of the body, beam or joint. Values only: a table has no gradients.
Checked in tests/results/test_table.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchmbd.errors import InputError, unknown
from torchmbd.results.beam_motion import BeamMotion
from torchmbd.results.body_motion import BodyMotion
from torchmbd.results.motion_data import MotionData
from torchmbd.results.reaction import frame_point, joint_named, reaction_on

if TYPE_CHECKING:
    from pandas import DataFrame

Columns = dict[str, Tensor]  # heading -> [lanes, times]
_STRAINS = ("strain x [1]", "shear y [1]", "shear z [1]", "twist x [1/m]", "curvature y [1/m]", "curvature z [1/m]")
_FORCES = ("N [N]", "V_y [N]", "V_z [N]", "T [N m]", "M_y [N m]", "M_z [N m]")


def table(
    motion: MotionData, names: Sequence[str], histories: Mapping[str, Callable[[Any], Tensor]] | None = None
) -> DataFrame:
    """Return the data frame, indexed by lane and t [s]; InputError names what does not exist or is there twice.

    names      of bodies, flexible beams and joints
    histories  heading -> history of the motion, such as mbd.StrainEnergy("arm"): a function that returns [lanes, times]
    """
    import pandas as pd

    if histories is not None and not isinstance(histories, Mapping):
        raise InputError("histories", histories, "a dict heading -> history", '{"energy [J]": mbd.StrainEnergy("arm")}')
    if not names and not histories:
        raise InputError("names", (), "names of bodies, beams or joints", hint="motion.to_dataframe('arm')")
    columns: Columns = {}
    for name in names:
        _add(columns, _columns(motion, name))
    for heading, history in (histories or {}).items():
        if not isinstance(heading, str):
            raise InputError("histories", heading, "a str", noun="a heading of histories")
        if not callable(history):
            raise InputError(("histories", heading), history, "a history of a motion")
        x = history(motion)
        if not isinstance(x, Tensor) or x.shape != (motion.lanes, len(motion.t)):
            shape = list(x.shape) if isinstance(x, Tensor) else type(x).__name__
            raise InputError(
                ("histories", heading),
                hint="a history, such as mbd.StrainEnergy, and not a measure of one",
                noun=f"histories[{heading!r}]",
                allowed=f"must have shape [lanes, times] = {[motion.lanes, len(motion.t)]}",
                state=f"is {shape}",
            )
        _add(columns, {heading: x})
    index = pd.MultiIndex.from_product([range(motion.lanes), motion.t.detach().tolist()], names=["lane", "t [s]"])
    return pd.DataFrame({key: x.detach().flatten().numpy() for key, x in columns.items()}, index=index)


def _add(columns: Columns, more: Columns) -> None:
    for heading, x in more.items():
        if heading in columns:
            raise InputError(
                ("names", heading),
                hint="each name once",
                noun=f"column {heading!r}",
                allowed="must appear once",
                state="appears twice",
            )
        columns[heading] = x


def _columns(motion: MotionData, name: str) -> Columns:
    """Return the columns of a body, beam or joint."""
    beams, joints = ([x.name for x in kind] for kind in (motion.system.beams, motion.system.joints))
    bodies = [x for x in motion.dynamics.topology.names if x not in beams]
    places = [kind for kind, known in (("body", bodies), ("beam", beams), ("joint", joints)) if name in known]
    if not places:
        raise unknown("body, beam or joint", name, [*bodies, *beams, *joints])
    if len(places) > 1:
        raise InputError(
            "names",
            name,
            "unique",
            hint="rename one of them",
            noun=f"name {name!r}",
            state=f"is the name of a {' and of a '.join(places)}",
        )
    if places == ["beam"]:
        return {f"{name} {key}": x for key, x in _of_beam(BeamMotion(motion, name)).items()}
    if places == ["body"]:
        return {f"{name} {key}": x for key, x in _of_body(BodyMotion(motion, name)).items()}
    joint = joint_named(motion.system, name)
    force, torque = reaction_on(motion, joint, joint.b, frame_point(motion, joint.b))
    headings = [
        f"{name} {kind} {axis} [{unit}]" for kind, unit in (("force", "N"), ("torque", "N m")) for axis in "xyz"
    ]
    return _named(headings, torch.cat([force, torque], -1))


def _of_body(body: BodyMotion) -> Columns:
    parts = {"x y z": (body.r, "m"), "vx vy vz": (body.velocity, "m/s"), "e0 e1 e2 e3": (body.p, "1")}
    parts["wx wy wz"] = (body.omega, "rad/s")
    topology = body.motion.dynamics.topology
    if topology.names.index(body.name) < topology.flexible:
        parts[" ".join(f"w{k + 1}" for k in range(body.w.shape[-1]))] = (body.w, "1")
    headings = [f"{letter} [{unit}]" for letters, (_, unit) in parts.items() for letter in letters.split()]
    return _named(headings, torch.cat([x for x, _ in parts.values()], -1))


def _of_beam(beam: BeamMotion) -> Columns:
    nodes = _named(
        [f"node {k} {axis} [m]" for k in range(beam.nodes.shape[2]) for axis in "xyz"], beam.nodes.flatten(2)
    )
    elements = range(beam.forces.shape[2])
    strains = _named([f"element {k} {key}" for k in elements for key in _STRAINS], beam.strains.flatten(2))
    headings = [f"element {k} {end} {key}" for k in elements for end in ("start", "end") for key in _FORCES]
    return nodes | strains | _named(headings, beam.forces.flatten(2))


def _named(headings: Sequence[str], x: Tensor) -> Columns:
    """Return columns of the last axis of x [lanes, times, n]."""
    return dict(zip(headings, x.unbind(-1), strict=True))
