"""The Trajectory of an integrated motion: a function of outputs of `Motion`, data of the reduced model, and designs.

Checked in tests/integrate/test_simulate.py, tests/integrate/test_duration.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from torchmbd.integrate.outputs import switches_with
from torchmbd.integrate.variables import entry_labels
from torchmbd.multibody.saddle.expansion import Expansion
from torchmbd.multibody.system import Dynamics, System
from torchmbd.results.history import History
from torchmbd.results.mode_shapes import DesignShapes, without_failed
from torchmbd.results.time_rows import IntegratedSignals, StepStates
from torchmbd.results.trajectory import Trajectory


def trajectory_of(
    system: System,
    integration: Any,
    outputs: Sequence[Tensor],
    data: dict[str, Any],
    designs: dict[str, Tensor],
    names: Sequence[str],
    shapes: Mapping[str, Tensor] = MappingProxyType({}),
) -> Trajectory:
    """The motion as a function of the outputs of `Motion`, the data of the reduced model and the designs.

    names    of the variables;  shapes: mode shapes that were made already
    """
    motion = integration.outputs.like(outputs)
    q, v, vd, lam = motion.states
    valid_times, good = motion.validity[0, 0].detach(), motion.validity[1, 0] > 0.0
    whole = integration.dynamics
    data = without_failed(dict(data) | motion.data, good)
    dynamics = Dynamics(whole.topology, whole.saddle, data, whole.initial, whole.stabilization, whole.backend)
    history = History(q, v, vd, lam, integration.expansion(data), segment=next(iter(motion.segment), None))
    at_steps = StepStates(*motion.at_steps) if motion.at_steps else None
    signals = IntegratedSignals(history, integration, data, valid_times, at_steps)
    return Trajectory(
        t=torch.linspace(0.0, integration.duration, len(q), dtype=torch.float64),
        signals=signals,
        status=integration.status,
        stats=integration.stats,
        system=system,
        dynamics=dynamics,
        shapes=DesignShapes(system, designs, signals.lanes, good, shapes),
        good=good,
        designs=designs,
        parameters=entry_labels(system, names),
        variables={name: designs[name] for name in names},
        switches=switches_with(integration.switches, motion.switches),
        integration=integration,
    )


def plain(motion: Trajectory, valid_times: Tensor | None = None) -> Trajectory:
    """The motion on plain tensors, also under torch.func; it shares status and statistics.

    valid_times: as in IntegratedSignals
    """
    integration = motion.integration
    assert integration is not None
    dynamics, h = integration.dynamics.values(), integration.history
    q, v, vd, lam = (x[:, :, :1] for x in (h.q, h.v, h.vd, h.lam))
    history = History(q, v, vd, lam, integration.expansion(dynamics.data), segment=h.segment)
    signals = IntegratedSignals(history, integration, dynamics.data, valid_times)
    return replace(
        motion, signals=signals, dynamics=dynamics, designs={}, variables={}, integration=None, t=motion.t.detach()
    )


def at_moving_times(motion: Trajectory, duration: Tensor) -> Trajectory:
    """The motion at times that are functions of the duration."""
    signals = motion.signals
    assert isinstance(signals, IntegratedSignals)
    t = torch.linspace(0.0, 1.0, signals.times, dtype=torch.float64) * duration
    h, x = signals.history, signals.history.expansion
    x = None if x is None else Expansion.of(x.condensation, x.data, t)
    history = replace(h, expansion=x, times=t)
    signals = IntegratedSignals(history, signals.integration, signals.data, signals.valid_times, signals.at_steps)
    return replace(motion, t=t, signals=signals)
