"""Attempts at a motion: a lane that fails does not take the others with it, and is tried again.

How, its integrator says (`Integrator.again`): carefully, or with half the step. What became of a lane is its status: "ok",
or what is wrong: "failed: ..." or "unresolved: ...".
Checked in tests/integrate/test_simulate.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchmbd.errors import InputError, warn
from torchmbd.integrate.contacts import MOST, Doubt
from torchmbd.integrate.integrator import Integrated, Integrator
from torchmbd.integrate.memory import require_room
from torchmbd.integrate.step_count import RIGID, all_modes, first_steps, wanted_steps
from torchmbd.integrate.stepper import ITERATION_ERROR, TURN
from torchmbd.multibody.system import Dynamics, System, equations
from torchmbd.multibody.system.expansion import Expansion
from torchmbd.results.history import History
from torchmbd.results.motion_data import OK

# With sensitivities more than this is tried again carefully: gradients are those of equations that are solved.
IMPRECISE = 1e-3
_UNRESOLVED = "unresolved: "
# Errors of a step by the largest vibration of the motion. The estimate sees the fastest modes, which may hardly count: of 71
# rods of the slider-crank with 100 to 1200 steps, estimates up to 3 go with 3 % of the integral of U and 23 % of its peak at
# most, and the stiffest design with 600 steps, 0.1 and 0.7 % off, has 1.04. Above 3 nothing is known of the vibrations.
STEP_ERROR = 3.0
_LEAST_SHARE = 1000  # of the steps that resolve every mode: a motion of which not even so few fit is refused at once
_OPEN = 1e-4  # [m] or [-]: violation of a joint at the end of a motion whose joints could not stay closed
_MOST_NUMBERS = 2e8  # of a motion whose steps are made smaller for its contacts
# Of accelerations: vibrations with less than five steps to a period.
ALTERNATION = 0.3
_LOOKED_AT = ("iteration_error", "turn", "step_error", "suggested_steps", "alternation")


def run(
    integrator: Integrator,
    dynamics: Dynamics,
    duration: float,
    steps: int,
    precise: bool,
    found: Integrated | None = None,
    finer: int = 1,
) -> tuple[History, dict[str, Any], list[str]]:
    """Integrate; lanes that fail, or whose gradients are imprecise, are tried again as the integrator says.

    Lanes with contacts that the steps do not show get more of these first (contacts.py).

    precise: whether there are gradients;  found: what was integrated already;  finer: steps that stand for one already
    """
    found, again = found or integrator.integrate(dynamics, duration, steps), integrator.again()
    made = _Made(found.history, found.statistics, _status(found, duration))
    _look_at_joints(dynamics, made.history, duration, made.stats, made.status)
    poor = [False] * len(made.status)
    if precise and again is not None and again.steps == 1:
        poor = (made.stats["iteration_error"] > IMPRECISE).tolist()
    _without_start(dynamics.start_errors, made.status, made.stats, made.history)
    doubtful = {lane: doubt for lane, doubt in found.doubts.items() if not has_failed(made.status[lane])}
    often = _steps_of_contacts(integrator, dynamics, steps, finer, doubtful)
    if often > 1:
        lanes = list(doubtful)
        retried = run(integrator, dynamics.select_lanes(lanes), duration, often * steps, precise, finer=often * finer)
        for lane in made.take(lanes, often, retried):
            del doubtful[lane]
            poor[lane] = False
    doubted(made.status, doubtful)
    warn_unresolved([x for lane, x in enumerate(made.status) if lane not in made.taken])
    failed = [
        lane
        for lane, reason in enumerate(made.status)
        if lane not in dynamics.start_errors and lane not in doubtful and (has_failed(reason) or poor[lane])
    ]
    if failed and again is not None:
        retried = run(
            again.integrator, dynamics.select_lanes(failed), duration, again.steps * steps, precise, finer=finer
        )
        made.take(failed, again.steps, retried)
    return replace(made.history, finer=made.finer), made.stats, made.status


def _steps_of_contacts(
    integrator: Integrator, dynamics: Dynamics, steps: int, finer: int, doubtful: Mapping[int, Doubt]
) -> int:
    """Steps that should stand for one of a motion with contacts that its steps do not show; 1: no more."""
    if not doubtful or not getattr(integrator, "halvings", 0):
        return 1
    often = min(max(doubt.steps for doubt in doubtful.values()), MOST // finer)
    T = dynamics.topology
    each = (T.n_q + 2 * T.n_v + T.rows) * (1 + dynamics.tangents) * len(doubtful)
    while often > 1 and often * steps * each > _MOST_NUMBERS:
        often //= 2
    return max(often, 1)


@dataclass
class _Made:
    """A motion of all lanes, some of which, `taken`, are replaced by better ones."""

    history: History
    stats: dict[str, Any]
    status: list[str]
    taken: list[int] = field(default_factory=list)
    finer: dict[int, tuple[History, int, int]] = field(default_factory=dict)

    def take(self, lanes: Sequence[int], often: int, retried: tuple[History, dict[str, Any], list[str]]) -> list[int]:
        """Take over lanes of a motion with so many steps for one, where these have not failed; which these are."""
        better, counts, status = retried
        cured = [(i, lane) for i, lane in enumerate(lanes) if not has_failed(status[i])]
        if not cured:
            return []
        source, own = (list(x) for x in zip(*cured, strict=True))

        def patch(x: Tensor, y: Tensor) -> Tensor:
            old, new = (torch.tensor(i) for i in (own, source))
            return x.index_copy(-1, old, y[::often].index_select(-1, new))

        parts = {name: patch(getattr(self.history, name), getattr(better, name)) for name in ("q", "v", "vd", "lam")}
        self.history = replace(self.history, **parts)
        for name in (*_LOOKED_AT, "tangent_error"):
            if name in self.stats:
                self.stats[name][own] = counts[name][source]
        failed_first = [lane for lane in own if has_failed(self.status[lane])]  # others were imprecise
        for i, lane in cured:
            self.status[lane] = status[i]
        halved = own if often > 1 else [lanes[i] for i in counts.get("halved", []) if lanes[i] in own]
        first = {*failed_first, *(lanes[i] for i in counts.get("failed_first", []))}
        self._note("halved", halved)
        self._note("renewed", [lane for lane in own if lane not in halved])
        self._note("failed_first", first)
        self.finer |= _finer(better, often, cured)
        self.taken += own
        return own

    def _note(self, name: str, lanes: Iterable[int]) -> None:
        self.stats[name] = sorted({*self.stats.get(name, []), *lanes})


def _look_at_joints(
    dynamics: Dynamics, history: History, duration: float, stats: dict[str, Any], status: list[str]
) -> None:
    """Note lanes that end with open joints: beyond a position that they cannot pass, an iteration may settle so.

    Lanes are looked at whose iteration leaves more than IMPRECISE.
    """
    if "iteration_error" not in stats or not dynamics.topology.rows:
        return
    for lane in torch.nonzero(stats["iteration_error"] > IMPRECISE)[:, 0].tolist():
        if lane in dynamics.start_errors or has_failed(status[lane]):
            continue
        one = dynamics.values().select_lanes([lane])
        T, end, x = one.topology, history.q[-1:, :, :1, [lane]], history.expansion
        t = end.new_tensor([duration])
        q = end if x is None else Expansion.of(x.condensation, x.data, t).rows(0, end)
        at = equations.placement(T, one.data, q[0], T.prescribed(t[0], one.data))
        phi = equations.constraints(T, at).abs()
        if float(phi.max()) > _OPEN:
            row = T.row_names[int(phi.flatten().argmax())]
            status[lane] = (
                f"failed: the joints could not stay closed ({row} is {float(phi.max()):.1e} m or rad off at the end)"
            )


def _without_start(faults: dict[int, str], status: list[str], stats: dict[str, Any], history: History) -> None:
    """Note lanes that start nowhere: no time of theirs has numbers."""
    for lane, reason in faults.items():
        status[lane] = f"failed: {reason}"
        stats.setdefault("until", torch.full((len(status),), len(history.q)))[lane] = 0


def _finer(better: History, often: int, cured: list[tuple[int, int]]) -> dict:
    """Where the smaller steps of lanes are, or those to be made again, that were `cured` [(place among the failed, lane)]."""
    result = {}
    for i, lane in cured:
        if i in better.finer:
            history, own, every = better.finer[i]
            result[lane] = history, own, every * often
        elif often > 1 or better.between:
            result[lane] = better, i, often
    return result


def resolved_run(
    integrator: Integrator, dynamics: Dynamics, duration: float, precise: bool, room: Callable[[int], None]
) -> tuple[int, tuple[History, dict[str, Any], list[str]]]:
    """As many steps as the motion needs (step_count.py), and `run` with them.

    room: refuses numbers of steps that do not fit into memory
    """

    def attempt(steps: int) -> tuple[Integrated, dict[str, Any], list[str]]:
        found = integrator.integrate(values, duration, steps)
        wanted = contact_steps(found.doubts, steps, values.lanes)
        return found, found.statistics | wanted, _status(found, duration)

    values = dynamics.values() if dynamics.tangents else dynamics
    steps, found = chosen(integrator, values, duration, attempt, room)
    return steps, run(integrator, dynamics, duration, steps, precise, None if dynamics.tangents else found)


Found = TypeVar("Found")


def chosen(
    integrator: Integrator,
    dynamics: Dynamics,
    duration: float,
    attempt: Callable[[int], tuple[Found, dict[str, Any], list[str]]],
    room: Callable[[int], None],
) -> tuple[int, Found | None]:
    """How many steps a motion needs, and what was found with them; of methods without estimates all that modes need."""
    most = integrator.fitting(all_modes(dynamics, duration))
    if not integrator.adjoint:
        most = min(most, RIGID) if "Kr" not in dynamics.data else most
        room(most)
        return most, None
    try:
        room(most // _LEAST_SHARE)
    except InputError:
        room(most)
    steps = min(integrator.fitting(first_steps(dynamics, duration)), most)
    while True:
        room(steps)
        found, stats, status = attempt(steps)
        wanted = wanted_steps(steps, stats, status, dynamics.start_errors)
        if wanted <= steps or steps >= most:
            return steps, found
        steps = min(integrator.fitting(wanted), most)


def memory_check(
    system: System | None, dynamics: Dynamics, tangents: int, integrator: Integrator
) -> Callable[[int], None]:
    """Refuses a number of steps whose motion does not fit into memory (InputError)."""

    def room(steps: int) -> None:
        if system is not None:
            require_room(system, dynamics.lanes, integrator.kept(steps), tangents)

    return room


def doubted(status: list[str], doubts: Mapping[int, Doubt]) -> None:
    """Put contacts that the steps do not show into the status of their lanes; of lanes that failed, why they did stays."""
    for lane, doubt in doubts.items():
        if has_failed(status[lane]):
            continue
        status[lane] = f"{'failed: ' if doubt.fails else _UNRESOLVED}{doubt.text}"


def contact_steps(doubts: Mapping[int, Doubt], steps: int, lanes: int) -> dict[str, Tensor]:
    """What `wanted_steps` takes: how many steps contacts want [lanes]."""
    return {"steps_for_contacts": torch.tensor([steps * doubts[i].steps if i in doubts else 0 for i in range(lanes)])}


def _status(found: Integrated, duration: float) -> list[str]:
    status = status_of(found.history, duration, found.statistics)
    return [f"failed: {found.failed[i]}" if i in found.failed else reason for i, reason in enumerate(status)]


def warn_unresolved(status: Sequence[str]) -> None:
    """Warn of lanes whose steps do not resolve their vibrations."""
    for reason in dict.fromkeys(status):
        if reason.startswith(_UNRESOLVED):
            warn(reason.removeprefix(_UNRESOLVED))


def status_of(history: History, duration: float, stats: dict[str, Any]) -> list[str]:
    """For each lane: the first time at which it is not finite, or what its steps leave to be desired."""
    # A sum is finite where all its terms are, short of overflow: one pass over the numbers.
    good = torch.stack([torch.isfinite(x.sum((1, 2))) for x in (history.q, history.v, history.vd)]).all(0)
    result = []
    for lane in range(good.shape[1]):
        bad = torch.nonzero(~good[:, lane])
        if len(bad):
            time = duration * int(bad[0]) / (len(history.q) - 1)
            result.append(f"failed: the motion is not finite from t = {time:.6g} s on")
        else:
            result.append(_complaint({name: float(stats[name][lane]) for name in _LOOKED_AT if name in stats}))
    return result


def has_failed(status: str) -> bool:
    """Whether a lane has no motion, or one that ends early; one that is not resolved has all its numbers."""
    return status.startswith("failed")


def validity(history: History, status: list[str], stats: dict[str, Any]) -> Tensor:
    """Of each lane [2, 1, lanes]: how many times have numbers that count, and 1, or 0 where it has failed.

    A tensor, and an output of `Motion`: torch.func.vmap takes it apart as it does the motion.
    """
    good = torch.tensor([not has_failed(x) for x in status], dtype=torch.float64)
    return torch.stack([_numbers_until(history, status, stats).to(good), good])[:, None]


def _numbers_until(history: History, status: list[str], stats: dict[str, Any]) -> Tensor:
    """All times, or those before the failure [lanes]."""
    times, lanes = len(history.q), len(status)
    good = torch.stack([torch.isfinite(x.sum((1, 2))) for x in (history.q, history.v, history.vd)]).all(0)
    until = good.int().cumprod(0).sum(0)
    until = until.minimum(stats.get("until", until)).clamp_min(0)
    return torch.where(torch.tensor([has_failed(x) for x in status]), until, torch.full((lanes,), times))


def _complaint(found: dict[str, float]) -> str:
    """What is wrong with the steps of a finite motion, or "ok"."""
    if found.get("iteration_error", 0.0) > ITERATION_ERROR:
        left = found["iteration_error"]
        return f"failed: the iteration of a step did not converge (relative error {left:.1e}); more steps help"
    if found.get("turn", 0.0) > TURN:
        return f"failed: a body turns by {found['turn']:.2g} rad in one step; allowed: {TURN:g}"
    if found.get("step_error", 0.0) > STEP_ERROR:
        # Of a stiff body only the gross motion may be wanted, which damped vibrations leave right: the numbers stay.
        message = (
            f"the steps do not resolve the vibrations of a flexible body (estimated error {100 * found['step_error']:.0f} % of "
            f"the largest): its energies mean little; {found['suggested_steps']:.0f} steps would resolve them"
        )
        return f"{_UNRESOLVED}{message}"
    if found.get("alternation", 0.0) > ALTERNATION:
        message = (
            f"{100 * found['alternation']:.0f} % of the accelerations change their sign from step to step: the steps do not "
            "resolve vibrations of a beam, which may grow; more steps, a smaller spectral_radius or damping of the beam help"
        )
        return f"{_UNRESOLVED}{message}"
    return OK
