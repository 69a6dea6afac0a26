"""How a motion was simulated, to simulate it again with other steps, more modes, or finer meshes.

The start for a system of other modes has the same displacements and rates of its flexible bodies:

    Psi' w' = Psi w      w, w'   modal coordinates of the modes Psi and of more modes Psi', whose span contains that of Psi;
                                 least squares over the same nodes where they are modes on a finer mesh

Checked in tests/diagnosis/test_response_errors.py, tests/diagnosis/test_errors_of_motions.py.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from torchmbd.diagnosis.response_error import response_error
from torchmbd.diagnosis.richer import finer_mesh_system, richer_system
from torchmbd.errors import InputError
from torchmbd.integrate.integrator import Integrator
from torchmbd.integrate.ode import ADAPTIVE
from torchmbd.integrate.one_step import OneStep
from torchmbd.integrate.torchdiffeq_method import Torchdiffeq
from torchmbd.math.rotation import rotation_matrix
from torchmbd.multibody.bodies.frame import MODAL
from torchmbd.multibody.system import System
from torchmbd.results.mode_shapes import DesignShapes
from torchmbd.results.motion_data import MotionData
from torchmbd.results.response_error import ResponseError
from torchmbd.results.trajectory import Trajectory

_TIGHTER = 0.01  # tolerances of adaptive methods, for each halving of the output intervals
# Times the steps: oscillations with 1 to 6 periods in a step are seen there as such of at least 0.13 periods in a step.
FINER = 2.3
_LEAST_RTOL = 1e-13  # rounding is above it


def finer_count(steps: int, multiple: int, factor: int = 2) -> int:
    """Return about `factor` (2 or 4) times as many steps, which share no factor with `steps` but for `multiple`."""
    parts = -(-steps // multiple)
    finer = math.ceil(FINER * parts) if factor == 2 else factor * parts + 1
    while math.gcd(finer, parts) > 1:
        finer += 1
    return multiple * finer


@dataclass(frozen=True, eq=False, repr=False)
class Repetition:
    """How to make one motion again.

    simulation, designs   that it was made of;  integrator: with the defaults of its system
    steps      of the motion, also where they were chosen
    multiple   of which any number of steps is one, as held control histories and checkpoints demand
    parameters values that the system had
    made       motions that were made, kept for other responses
    """

    simulation: Any  # a Simulation, which is made above
    designs: Mapping[str, Tensor]
    integrator: Integrator
    steps: int
    multiple: int
    parameters: Mapping[str, Tensor]
    made: dict[Any, Any] = field(default_factory=dict, init=False)

    @property
    def order(self) -> int | None:
        """Order of the method; None: adaptive. InputError for a method without an estimate."""
        if isinstance(self.integrator, OneStep):
            return 2
        if self.integrator.name in ADAPTIVE:
            return None
        raise InputError(
            "method",
            self.integrator.name,
            f"generalized_alpha, hht_alpha, or an adaptive method ({', '.join(sorted(ADAPTIVE))})",
            noun="method of a motion whose errors by steps are estimated",
        )

    @property
    def has_equal_steps(self) -> bool:
        """True for methods of one step."""
        return isinstance(self.integrator, OneStep)

    def error_of(self, motion: Trajectory, response: Any, modes: bool, mesh: bool) -> ResponseError:
        """The errors of a response of the motion (response_error.py)."""
        return response_error(motion, response, modes, mesh)

    def finer(self, factor: int) -> Trajectory:
        """The motion with `factor` (2 or 4) times the steps and a few more, values only.

        Its number of steps shares no factor with that of the motion, but for `multiple`: a load whose period divides a step of
        the motion, which shows one value of it, does not divide these. For a factor of 2 they are FINER times as many.
        Adaptive methods have tighter tolerances instead.
        """
        return self._kept(factor, lambda: self._finer(factor))

    def _finer(self, factor: int) -> Trajectory:
        if self.order is None:
            assert isinstance(self.integrator, Torchdiffeq)
            share = _TIGHTER ** (factor // 2)
            rtol, atol = max(_LEAST_RTOL, self.integrator.rtol * share), self.integrator.atol * share
            return self._again(self.designs, steps=factor * self.steps, rtol=rtol, atol=atol)
        return self._again(self.designs, steps=finer_count(self.steps, self.multiple, factor))

    def coarser(self) -> Trajectory | None:
        """The motion with half as many equal steps, values only, without its warnings; None where there is none."""
        if self.order is None or self.steps % 2:
            return None
        return self._kept("coarser", lambda: self._without_warnings(self.steps // 2))

    def by_longer_steps(self, motion: Trajectory) -> Trajectory | None:
        """The motion with steps FINER times as long, values only, without its warnings; None where there is none.

        Its number of steps shares no factor with that of the motion, as in `finer`; `motion` is its finer one.
        """
        parts = -(-self.steps // self.multiple)
        coarse = math.floor(parts / FINER)
        while coarse > 1 and math.gcd(coarse, parts) > 1:
            coarse -= 1
        if self.order is None or coarse < 1:
            return None
        longer = self._without_warnings(self.multiple * coarse)
        longer.repetition.made[2] = motion
        return longer

    def richer(self, motion: Trajectory) -> Trajectory | None:
        """The same steps with more modes of all flexible bodies, values only; None where no body has further modes.

        motion   the motion of these arguments: modal coordinates of its start are those of its modes
        Raises InputError for a static equilibrium that begins with modal coordinates.
        """
        T = motion.dynamics.topology
        modes = dict(zip(T.names, T.mode_counts, strict=False))  # flexible bodies are the first
        return self._kept("modes", lambda: self._with_bodies(motion, *richer_system(self.simulation.system, modes)))

    def with_finer_meshes(self, motion: Trajectory) -> Trajectory | None:
        """The same on meshes of twice as many cells in each direction; None where no body has such a mesh."""
        return self._kept("mesh", lambda: self._with_bodies(motion, *finer_mesh_system(self.simulation.system)))

    def _kept(self, key: Any, make: Callable[[], Any]) -> Any:
        """A motion, made once."""
        if key not in self.made:
            self.made[key] = make()
        return self.made[key]

    def _without_warnings(self, steps: int) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return self._again(self.designs, steps=steps, diagnose=False)

    def _with_bodies(self, motion: Trajectory, system: System, names: list[str]) -> Any | None:
        if not names:
            return None
        start, designs = _with_other_modes(motion, system, self.simulation.start, self.designs)
        return self._again(designs, system=system, start=start, steps=self.steps)

    def _again(self, designs: Mapping[str, Tensor], diagnose: bool = True, **arguments: Any) -> Any:
        """The motion of designs by the simulation with other arguments, values only."""
        for name, x in self.simulation.system.named_parameters():
            if not torch.equal(x.detach(), self.parameters[name]):
                raise InputError(
                    name, hint="simulate again", noun=f"parameter {name!r}", state="has changed since the motion"
                )
        # Times without gradients, and joints of any copy of the system.
        phases = [_plain(phase) for phase in self.simulation.phases]
        other = self.simulation.with_arguments(duration=self.simulation.seconds, phases=phases, **arguments)
        return other(designs, gradients="none", progress=False, diagnose=diagnose)


def _plain(phase: Any) -> Any:
    times = {key: getattr(phase, key) for key in ("until", "lasting")}
    joints = {key: [getattr(x, "name", x) for x in getattr(phase, key)] for key in ("lock", "release")}
    return replace(phase, **{k: x.detach() if isinstance(x, Tensor) else x for k, x in times.items()}, **joints)


def _with_other_modes(
    motion: Any, system: System, start: Any, designs: Mapping[str, Tensor]
) -> tuple[Any, dict[str, Tensor]]:
    """Start and designs for a `system` of other modes, out of those of a motion.

    Raises InputError for a static equilibrium that begins with modal coordinates or rates: they cannot be combined.
    """
    designs = dict(designs)
    numbers: dict[str, Any] = {}
    if isinstance(start, MotionData):
        numbers = _last_state(start)
    elif isinstance(start, Mapping):
        numbers = {name: torch.as_tensor(x, dtype=torch.float64).detach() for name, x in start.items()}
    shapes = None
    for name in system.topology.names[: system.topology.flexible]:
        for key in MODAL:
            label = f"{name}.{key}"
            of_design = designs.pop(label, getattr(motion.system.body(name), key))
            w = numbers.pop(label, of_design).detach()
            if bool(w.any()):
                shapes = shapes or DesignShapes(system, designs, motion.lanes)
                numbers[label] = _in_more_modes(motion.modes(name), w, shapes.values(name))
    if start == "equilibrium" and numbers:
        raise InputError(
            "start",
            start,
            "used with modal coordinates of zero",
            state=f"is 'equilibrium', but bodies have the initial values {', '.join(map(repr, numbers))}",
        )
    return start if isinstance(start, str) and not numbers else numbers, designs


def _in_more_modes(psi: Tensor, w: Tensor, more: Tensor) -> Tensor:
    """Coordinates [lanes, m'] in shapes `more` [lanes, nodes, 6, m'] of those w [m] or [lanes, m] in shapes psi."""
    u = torch.einsum("lnim,lm->lni", psi, w.expand(len(psi), -1))
    more = more[:, : u.shape[1]]  # a finer mesh has further nodes
    return torch.linalg.lstsq(more.flatten(1, 2), u.flatten(1, 2)[..., None]).solution[..., 0]


def _last_state(motion: Any) -> dict[str, Tensor]:
    """The last state of a motion as numbers of all bodies [lanes, ...]."""
    T, state = motion.dynamics.topology, {}
    for i, name in enumerate(T.names):
        body = motion.body(name)
        p = body.p[:, -1] / body.p[:, -1].norm(dim=-1, keepdim=True)
        state[f"{name}.position"] = body.r[:, -1]
        state[f"{name}.axes"] = rotation_matrix(p.T).movedim(-1, 0)
        state[f"{name}.velocity"] = body.at().velocity[:, -1]
        state[f"{name}.angular_velocity"] = body.omega[:, -1]
        if i < T.flexible:
            state[f"{name}.modal"], state[f"{name}.modal_velocity"] = body.w[:, -1], body.wd[:, -1]
    return {key: x.detach() for key, x in state.items()}
