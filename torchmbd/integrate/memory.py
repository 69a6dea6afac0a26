"""Memory of a motion, estimated before it is made: one that does not fit is refused, and batches are cut to a size that does.

    bytes = min(steps, SEGMENT) * STEP + lanes * (structure + motion)
    motion    = 3 * 8 * times * (n_q + 2 n_v + rows) * (1 + n_b)                    coordinates, rates, ... and copies of them
    structure = sum over flexible bodies of nodes * (a + b sqrt(nodes) + c modes + n_b (d + e modes))

n_b design tangents of the motion. The adjoint (adjoint.py) has none; its structure stage takes what one takes.
Measured on the peak of processes: plates of 65 to 3201 nodes, 6 and 20 modes, up to 8 variables, 2 to 100 000 steps.
Assumed: other processes keep what they have.
Checked in tests/integrate/test_memory.py.
"""

from __future__ import annotations

import math
import os
from pathlib import Path

from torchmbd.errors import InputError
from torchmbd.multibody.system import System
from torchmbd.results.history import SEGMENT

_COPIES = 3  # of the motion: what is recorded, rows of the whole system, work arrays
_STEP = 3000.0  # bytes of Python objects for a step of a segment, of however many lanes
_NODE, _FILL, _MODE, _SLOPE, _MODE_SLOPE = 8600.0, 560.0, 600.0, 1000.0, 400.0  # a, b, c, d, e [bytes]
_SHARE = 0.25  # of the machine's memory for one batch
_CONTROL_GROUPS, _OF_PROCESS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def lane_bytes(system: System, steps: int, tangents: int = 0, adjoint: bool = False) -> float:
    """Estimated bytes of one lane of a motion; `tangents`: number of design variables."""
    T = system.topology
    motion = _COPIES * 8.0 * (steps + 1) * (T.n_q + 2 * T.n_v + T.rows) * (1 if adjoint else 1 + tangents)
    structure = 0.0
    for body in system.bodies:
        if hasattr(body, "mesh"):
            n, modes = len(body.mesh.nodes), body.modes
            slopes = (min(tangents, 1) if adjoint else tangents) * (_SLOPE + _MODE_SLOPE * modes)
            structure += n * (_NODE + _FILL * math.sqrt(n) + _MODE * modes + slopes)
    return motion + structure


def _shared(steps: int) -> float:
    """Bytes of a segment of steps that do not depend on the number of lanes."""
    return _STEP * (min(steps, SEGMENT) + 1)


def motion_bytes(system: System, lanes: int, steps: int, tangents: int = 0, adjoint: bool = False) -> float:
    """Estimated bytes of a motion of so many lanes."""
    return _shared(steps) + lanes * lane_bytes(system, steps, tangents, adjoint)


def installed() -> float:
    """Bytes of the machine, or of the container or job that this process runs in; inf where that is unknown."""
    try:
        machine = float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # not POSIX
        machine = math.inf
    return min([machine, *_control_group_limits()])


def _control_group_limits() -> list[float]:
    """Limits [bytes] of the control groups that this process is in, of versions 1 and 2, as in containers and SLURM jobs."""
    groups = _OF_PROCESS.read_text().splitlines() if os.access(_OF_PROCESS, os.R_OK) else []
    files: dict[Path, None] = {}
    for group in ["0::/", "0:memory:/", *groups]:  # number:controllers:path; a container may see the root only
        _, controllers, path = group.split(":", 2)
        version_1 = "memory" in controllers.split(",")
        if controllers and not version_1:
            continue
        root = _CONTROL_GROUPS / "memory" if version_1 else _CONTROL_GROUPS
        bottom = root / path.lstrip("/")
        folders = [folder for folder in (bottom, *bottom.parents) if folder.is_relative_to(root)]
        files |= dict.fromkeys(x / ("memory.limit_in_bytes" if version_1 else "memory.max") for x in folders)
    limits = [file.read_text().strip() for file in files if os.access(file, os.R_OK)]
    return [float(limit) for limit in limits if limit.isdigit()]


def available() -> float:
    """Bytes that are free, and those that this process holds already: it uses them again."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        process_bytes = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:  # not Linux
        return installed()
    [free] = [int(line.split()[1]) * 1024.0 for line in lines if line.startswith("MemAvailable:")]
    return min(free + process_bytes, installed())


def require_memory(system: System, lanes: int, steps: int, tangents: int = 0, adjoint: bool = False) -> None:
    """Refuse a motion that does not fit into memory; InputError names its size, what there is, and what would fit."""
    needed, free = motion_bytes(system, lanes, steps, tangents, adjoint), available()
    if needed <= free:
        return
    sizes = f"about {_shown(needed)} of memory, {_shown(free)} are available"
    design_bytes = motion_bytes(system, 1, steps, tangents, adjoint)
    if design_bytes <= free:
        most = int((free - _shared(steps)) / lane_bytes(system, steps, tangents, adjoint))
        raise InputError(
            "designs",
            allowed=f"up to {_rounded(most)} lanes at once",
            state=f"have {lanes} lanes, of {steps} steps: they take {sizes}",
        )
    fixed, each = (lane_bytes(system, k, tangents, adjoint) for k in (0, 1))
    most = int((free - _shared(steps) - fixed) / (each - fixed))
    if most < 1:
        shown = f"too large: one design takes {sizes}"
        raise InputError("system", system, "smaller meshes, fewer modes or variables", shown=shown)
    shown = f"{steps}: the motion of one design takes {sizes}"
    allowed = f"up to {_rounded(most)} states; checkpoint=100 keeps every hundredth only"
    raise InputError("steps", steps, allowed, shown=shown)


def lanes_at_once(system: System, steps: int, tangents: int = 0, adjoint: bool = False) -> int:
    """Designs of a batch that leaves most of the machine's memory free, one at least; the same for the same machine."""
    free = _SHARE * installed() - _shared(steps)
    return max(1, int(min(free / lane_bytes(system, steps, tangents, adjoint), 2.0**30)))


def _rounded(count: int) -> int:
    """Down to two figures: what is available changes from one moment to the next."""
    unit = 10 ** max(len(str(count)) - 2, 0)
    return count // unit * unit


def _shown(count: float) -> str:
    """Bytes in a fitting unit: `3.2 GB`."""
    power = min(max(int(math.log10(max(count, 1.0)) // 3), 2), 6)
    return f"{count / 1e3**power:.2g} {('MB', 'GB', 'TB', 'PB', 'EB')[power - 2]}"
