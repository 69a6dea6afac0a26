"""Memory of a motion, estimated before it is made: one that does not fit is refused, and batches are cut to a size that does.

    bytes = WORK + min(steps, SEGMENT) * STEP + tables + lanes * (structure + motion)
    motion    = 3 * 8 * times * (n_q + 2 n_v + rows) * (1 + n_b)                    coordinates, rates, ... and copies of them
    tables, structure        of the flexible bodies                                 multibody/bodies/body_memory.py

n_b design tangents of the motion. The adjoint (adjoint.py) has none; its structure stage takes what one takes.
Measured on the peak of processes: 2 to 100 000 steps, up to 8 variables, and the bodies of body_memory.py.
Assumed: other processes keep what they have.
Checked in tests/integrate/test_memory.py.
"""

from __future__ import annotations

from torchmbd.errors import InputError
from torchmbd.multibody.bodies.body_memory import design_bytes, table_bytes
from torchmbd.multibody.system import System
from torchmbd.process import available_memory, bytes_text, installed_memory, rounded_down
from torchmbd.results.history import SEGMENT

_COPIES = 3  # of the motion: what is recorded, rows of the whole system, work arrays
_WORK = 8e7  # bytes of multipliers and loads of some thousand states at once (times_as_lanes.py, elastic_limits.py)
_STEP = 3000.0  # bytes of Python objects for a step of a segment, of however many lanes
_SHARE = 0.25  # of the memory beside the tables for one batch


def lane_bytes(system: System, steps: int, tangents: int = 0, adjoint: bool = False) -> float:
    """Estimated bytes of one lane of a motion; `tangents`: number of design variables."""
    T = system.topology
    motion = _COPIES * 8.0 * (steps + 1) * (T.n_q + 2 * T.n_v + T.rows) * (1 if adjoint else 1 + tangents)
    slopes = min(tangents, 1) if adjoint else tangents
    return motion + sum(design_bytes(len(x.mesh.nodes), x.modes, slopes) for x in system.bodies if hasattr(x, "mesh"))


def _tables(system: System) -> float:
    """Bytes of bodies that do not depend on the number of lanes."""
    bodies = [x for x in system.bodies if hasattr(x, "assembly")]
    return sum(table_bytes(len(x.mesh.nodes), x.assembly.parts.values()) for x in bodies)


def _work(steps: int) -> float:
    """Bytes of a segment of steps that do not depend on the number of lanes."""
    return _WORK + _STEP * (min(steps, SEGMENT) + 1)


def _shared(system: System, steps: int) -> float:
    return _tables(system) + _work(steps)


def motion_bytes(system: System, lanes: int, steps: int, tangents: int = 0, adjoint: bool = False) -> float:
    """Estimated bytes of a motion of so many lanes."""
    return _shared(system, steps) + lanes * lane_bytes(system, steps, tangents, adjoint)


def require_memory(system: System, lanes: int, steps: int, tangents: int = 0, adjoint: bool = False) -> None:
    """Refuse a motion that does not fit into memory; InputError names its size, what there is, and what would fit."""
    needed, free = motion_bytes(system, lanes, steps, tangents, adjoint), available_memory()
    if needed <= free:
        return
    sizes = f"about {bytes_text(needed)} of memory, of which {bytes_text(free)} are available"
    if motion_bytes(system, 1, steps, tangents, adjoint) <= free:
        most = int((free - _shared(system, steps)) / lane_bytes(system, steps, tangents, adjoint))
        raise InputError(
            "designs",
            allowed=f"must have at most {rounded_down(most)} lanes at once",
            state=f"have {lanes} lanes of {steps} steps, which take {sizes}",
        )
    fixed, each = (lane_bytes(system, k, tangents, adjoint) for k in (0, 1))
    most = int((free - _shared(system, steps) - fixed) / (each - fixed))
    if most < 1:
        state = f"is too large, because one design takes {sizes}"
        raise InputError("system", system, "must have smaller meshes, or fewer modes or variables", state=state)
    state, hint = f"of one design take {sizes}", "checkpoint=100, which keeps every hundredth state only"
    raise InputError("steps", steps, f"at most {rounded_down(most)}", hint, shown=str(steps), state=state)


def lanes_at_once(system: System, steps: int, tangents: int = 0, adjoint: bool = False) -> int:
    """Designs of a batch that leaves most of the machine's memory free, one at least; the same for the same machine."""
    free = _SHARE * (installed_memory() - _tables(system)) - _work(steps)
    return max(1, int(min(free / lane_bytes(system, steps, tangents, adjoint), 2.0**30)))
