"""Arguments of `simulate`: wrong ones are refused, with their name, value and what is allowed.

Checked in tests/integrate/test_simulate.py.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from torchmbd.errors import InputError, one_of, unknown
from torchmbd.integrate.backend import BACKENDS
from torchmbd.integrate.integrator import Integrator
from torchmbd.integrate.phases.phase import Phase
from torchmbd.integrate.registry import INTEGRATORS, integrator_of
from torchmbd.math.checked_numbers import is_whole, with_unit
from torchmbd.math.gradients import all_true, in_transform, is_differentiated, untransformed
from torchmbd.math.pair import value
from torchmbd.math.plausible_units import check_parameter
from torchmbd.math.rotation import rotation_matrix
from torchmbd.math.units import in_si
from torchmbd.multibody.equations import base_points
from torchmbd.multibody.equations.equations import split_q
from torchmbd.multibody.start.start import Start
from torchmbd.multibody.system import System
from torchmbd.results.motion_data import MotionData

SHORTEST, LONGEST = 1e-12, 1e9  # steps [s], whose powers in the equations neither vanish nor overflow
GRADIENTS = ("auto", "forward", "reverse", "none")


def checked_integrator(
    duration: Any, method: Any, steps: Any, options: Mapping[str, Any], argument_names: Collection[str] = ()
) -> Integrator:
    """The integrator; InputError for arguments of `simulate` that are wrong for every system.

    argument_names  the names of all arguments but the options, of the function that takes these
    """
    if isinstance(duration, Tensor) and untransformed(duration).dim():
        what = f"a tensor of shape {tuple(duration.shape)}" if duration.dim() else "a batch of torch.vmap"
        raise InputError("duration", duration, "one positive number [s], for all designs", shown=what)
    duration = seconds_of(duration)
    if not isinstance(duration, numbers.Real) or isinstance(duration, bool) or not 0 < float(duration) < math.inf:
        shown = with_unit(duration, " s")
        raise InputError("duration", duration, "a positive number", in_si(duration), shown=shown)
    if steps is not None and not (is_whole(steps) and steps >= 1):
        raise InputError("steps", steps, "a positive integer")
    if not SHORTEST <= float(duration) / (steps or 1) <= LONGEST:
        step = f"steps of {float(duration) / (steps or 1):.3g} s"
        raise InputError("duration", duration, f"{SHORTEST:g} to {LONGEST:g} s", shown=f"{duration!r} s: {step}")
    integrator = integrator_of(method, options, argument_names)
    if steps is not None:
        integrator.stored_intervals(steps)
    return integrator


def check_gradients(gradients: Any, integrator: Integrator) -> None:
    """InputError for a mode of gradients that does not exist, or not for this integrator."""
    one_of("gradients", gradients, GRADIENTS)
    if gradients != "reverse":
        return
    if not integrator.adjoint:
        methods = " or ".join(repr(name) for name, entry in INTEGRATORS.items() if entry.adjoint)
        shown = f"'reverse', but method is {integrator.name!r}"
        raise InputError("gradients", gradients, "'forward'", f"method = {methods}", shown=shown)


def seconds_of(duration: Any) -> Any:
    """A duration as a number of Python."""
    return untransformed(duration).item() if isinstance(duration, Tensor) else duration


def duration_is_differentiated(duration: Any, gradients: str, integrator: Integrator) -> bool:
    """True if the motion is differentiated with respect to its duration; InputError if this derivative does not exist."""
    if not isinstance(duration, Tensor) or not is_differentiated(duration):
        return False
    obstacle = f"gradients is {gradients!r}" if gradients in ("forward", "none") else f"method is {integrator.name!r}"
    if not integrator.adjoint or gradients in ("forward", "none"):
        methods = " or ".join(repr(name) for name, entry in INTEGRATORS.items() if entry.adjoint)
        raise InputError(
            "duration",
            duration,
            state=f"is being differentiated, but {obstacle}",
            hint=f"method {methods} with gradients='auto' or 'reverse', which have both modes, or duration.detach()",
        )
    if duration.dtype != torch.float64:
        raise InputError("duration", duration, "torch.float64", shown=str(duration.dtype))
    return True


def check_phase_times(phases: Any, gradients: str, integrator: Integrator) -> None:
    """InputError if the time of a phase is differentiated, but the gradients of the motion do not reach it."""
    if gradients not in ("forward", "none") and integrator.adjoint:
        return
    for number, phase in enumerate(phases if isinstance(phases, (list, tuple)) else (), 1):
        if isinstance(phase, Phase) and phase.time is not None:
            key, x = ("until", phase.until) if phase.lasting is None else ("lasting", phase.lasting)
            raise InputError(
                (str(phase.name or number), key),
                noun=f"{key} of phase {phase.name or number!r}",
                shown=repr(x),
                state="is being differentiated, but forward tangents do not support this",
                hint=f"gradients='reverse' or 'auto' with a one-step method, or {key}.detach()",
            )


def refuse_dual_level(batch: Mapping[str, Tensor]) -> None:
    """InputError for dual numbers of torch.autograd.forward_ad: the integration of tangents opens such a level itself."""
    for name, x in batch.items():
        if not in_transform(x) and forward_ad.unpack_dual(x).tangent is not None:
            raise InputError(
                (name,),
                noun=repr(name),
                state="is a dual number of torch.autograd.forward_ad, which this method and these phases do not support",
                hint="torch.func.jvp, or method 'generalized_alpha' without phases with gradients='auto' or 'reverse'",
            )


def check_backend(backend: Any) -> None:
    """InputError for a backend that does not exist, or is not installed."""
    names = ["auto", *BACKENDS]
    if isinstance(backend, str) and (absence := BACKENDS.absence(backend)):
        raise InputError(
            "backend",
            backend,
            hint=" or ".join(map(repr, names)),
            shown=repr(backend),
            state=f"cannot be used, because {absence}",
        )
    if isinstance(backend, str) and backend not in names and (missing := BACKENDS.missing(backend)):
        raise InputError("backend", backend, names, shown=repr(backend), state=f"does not exist, or {missing}")
    one_of("backend", backend, names)


def start_of(system: System, start: Any) -> Start:
    """The initial state that `start` describes; InputError says what is allowed."""
    if isinstance(start, MotionData):
        T, Kr = start.dynamics.topology, start.dynamics.data.get("Kr")
        q, v = (x[:, -1].T[:, None] for x in (start.q, start.v))
        v = base_points.rates_to_origins(T.base_points, rotation_matrix(split_q(T, q)[1]), v)
        q = base_points.to_origins(T.base_points, q)
        return Start.of_motion(system, q[:, 0].T, v[:, 0].T, T, None if Kr is None else value(Kr))
    return Start.of(system, start)


def check_start(start: Start, gradients: str, integrator: Integrator) -> None:
    """InputError if the start is differentiated, but the gradients of the motion do not reach it."""
    if start.is_differentiated and (gradients == "forward" or (gradients != "none" and not integrator.adjoint)):
        raise InputError(
            "start",
            start,
            state="requires a gradient, but forward mode does not compute gradients with respect to the start",
            hint="gradients='reverse' or 'auto' of a one-step method, or Parameters given to the bodies (bent, "
            "moving, position)",
        )


def check_dtypes(system: System) -> None:
    """InputError names the first parameter of a system that has other numbers than float64."""
    for name, x in system.named_parameters():
        if x.dtype != torch.float64:
            raise InputError(
                name, x.dtype, "torch.float64, the type of the system", noun=f"parameter {name!r}", shown=f"{x.dtype}"
            )


def checked_designs(system: System, designs: Any) -> dict[str, Tensor]:
    """Designs with a lane axis; InputError names those that are not finite float64 numbers of the system's parameters."""
    parameters = dict(system.named_parameters())
    if not isinstance(designs, (Mapping, type(None))):
        raise InputError("designs", designs, "a mapping parameter name -> tensor [lanes, ...]")
    check_dtypes(system)
    for name, x in parameters.items():
        if name in (designs or {}):
            continue
        if not all_true(torch.isfinite(x)):
            raise InputError(name, x.tolist(), "finite numbers", noun=f"parameter {name!r}", shown=f"{x.tolist()}")
        check_parameter("parameter", name, untransformed(x))
    result = {}
    for name, design in (designs or {}).items():
        if name not in parameters:
            raise unknown("parameter", name, parameters)
        x = design[None] if isinstance(design, Tensor) and design.shape == parameters[name].shape else design
        if not isinstance(x, Tensor) or x.dtype != torch.float64 or x.shape[1:] != parameters[name].shape or not len(x):
            seen = f"has shape {tuple(x.shape)} of {x.dtype}" if isinstance(x, Tensor) else f"is {x!r}"
            shape = ", ".join(["lanes", *map(str, parameters[name].shape)])
            raise InputError(("designs", name), allowed=f"a float64 tensor [{shape}]", state=seen)
        _check_lanes(name, x, torch.isfinite(x), "finite numbers")
        numbers_of = untransformed(x).reshape(-1, *parameters[name].shape)
        lane = int(numbers_of.reshape(len(numbers_of), -1).abs().amax(1).argmax())
        check_parameter(f"design of lane {lane}:", name, numbers_of[lane])
        _check_lanes(name, x, *of_allowed_sign(system, name, x))
        result[name] = x
    return result


def of_allowed_sign(system: System, parameter: str, x: Tensor) -> tuple[Tensor, str]:
    """Which values of a parameter have a sign that it may have, and what is allowed: a mass is positive."""
    owner, _, name = parameter.rpartition(".")
    module = system.get_submodule(owner)
    if name in getattr(module, "positive", ()):
        return x > 0.0, "positive numbers"
    if name in getattr(module, "nonnegative", ()):
        return x >= 0.0, "zero or positive numbers"
    return torch.ones_like(x, dtype=torch.bool), "finite numbers"


def _check_lanes(name: str, x: Tensor, good: Tensor, allowed: str) -> None:
    """InputError for the first lane of a design [lanes, ...] that is not good."""
    if not all_true(good):
        lane = int(torch.nonzero(~good.reshape(len(x), -1).all(1))[0])
        numbers = x[lane].tolist()
        raise InputError((name,), numbers, allowed, noun=f"design {name!r}", state=f"of lane {lane} is {numbers}")


def checked_variables(system: System, variables: Any) -> list[str]:
    """Names of parameters; InputError names what is none."""
    parameters = dict(system.named_parameters())
    if isinstance(variables, str) or not isinstance(variables, Sequence):
        raise InputError("variables", variables, "a list of names of parameters")
    return [one_of("parameter", name, parameters) for name in variables]
