"""An experiment: a system with settings, and what was measured of it.

Measurements of a motion share one motion of the experiment, which all designs of a batch are lanes of.
Checked in tests/extensions/identification/test_experiment.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

from torchmbd.design.scenario_settings import settings_of
from torchmbd.errors import DesignFailure, InputError, argument_names
from torchmbd.extensions.identification.measurement import Limits, Measurement
from torchmbd.extensions.identification.run import Run
from torchmbd.integrate import Phase
from torchmbd.integrate.one_step import OneStep
from torchmbd.integrate.registry import DEFAULT
from torchmbd.math.checked_numbers import list_of, positive
from torchmbd.multibody.system import System
from torchmbd.simulation import Simulation
from torchmbd.summary import Summary


class Experiment(Summary):
    """A system, and what was measured of it.

    system        the model
    measurements  a measurement, such as mbd.identification.TimeSeries(...), or a list of them
    settings      parameter -> value [SI] in this experiment, for parameters that are not unknowns
    duration      of the motion [s]; None: until the last measured time
    steps         equal steps of the motion; None: as many as `simulate` chooses for the first motion. `identify` takes more
                  steps if their error moves an unknown by too large a part of its standard deviation
    method, phases, backend, start, options   as in `simulate`

    >>> t = np.linspace(0.0, 1.0, 50)
    >>> swing = mbd.identification.TimeSeries({"t": t, "x": np.sin(t)}, {"x": mbd.Position("bob", "x")})
    >>> mbd.identification.Experiment(mbd.examples.pendulum(), swing).channels
    ['x']
    """

    def __init__(
        self,
        system: System,
        measurements: Measurement | Sequence[Measurement],
        settings: Mapping[str, Any] | None = None,
        duration: float | None = None,
        steps: int | None = None,
        method: str = DEFAULT,
        phases: Sequence[Phase] | None = None,
        backend: str = "auto",
        start: Any = "assembled",
        **options: Any,
    ):
        if not isinstance(system, System):
            raise InputError("system", system, "a System")
        single = [measurements] if isinstance(measurements, Measurement) else measurements
        self.measurements: list[Measurement] = list_of(
            "measurements", single, Measurement, "a measurement, such as mbd.identification.TimeSeries(...)"
        )
        if not self.measurements:
            raise InputError("measurements", measurements, "must contain at least one measurement", state="is empty")
        for measurement in self.measurements:
            measurement.check(system)
        self.channels = [block.channel for x in self.measurements for block in x.blocks]
        for name in self.channels:
            if self.channels.count(name) > 1:
                raise InputError(
                    name, allowed="measured once", noun=f"channel {name!r}", state="is measured twice in one experiment"
                )
        self.duration = None if duration is None else positive("duration", duration, "s")
        self.phases = phases
        self.simulation = Simulation.of_caller(
            argument_names(Experiment),
            system,
            self.duration or 1.0,  # until `within` has that of the measurements
            method=method,
            steps=steps,
            phases=None if self.duration is None else phases,
            backend=backend,
            start=start,
            **options,
        )
        self.system = system
        self.settings = settings_of(system, (), "of the experiment", settings or {}, ("settings",))
        for name in (name for measurement in self.measurements for name in measurement.sets if name in self.settings):
            raise InputError(
                "settings",
                settings,
                "must not have measured loads",
                state=f"has {name!r}, a load whose values a measurement gives",
            )
        self.steps = steps

    def _summary(self) -> list[tuple[str, Any]]:
        settings = ", ".join(f"{name} = {x.tolist()}" for name, x in self.settings.items())
        return [
            ("measurements", ", ".join(type(x).__name__ for x in self.measurements)),
            ("channels", ", ".join(self.channels)),
            ("settings", settings or "none"),
        ]

    def within(self, limits: Limits, start: Mapping[str, Tensor]) -> Experiment:
        """The experiment with its duration, without samples outside of the motion and without measured modes that
        do not have a partner in the model at the start.

        limits   bounds of the unknowns of its measurements, by name
        start    values of parameters where the search begins, by name [1, ...]; those of other systems are left out

        If the model fails at the start, nothing is left out. The search then reports the failure.
        """
        last = max(measurement.until(limits) for measurement in self.measurements)
        result = object.__new__(Experiment)
        vars(result).update(vars(self))
        result.duration = self.duration or last
        if self.duration is None and last > 0.0:
            result.simulation = self.simulation.with_arguments(duration=last, phases=self.phases)
        parameters = dict(self.system.named_parameters())
        run = result.run({name: x for name, x in start.items() if name in parameters}, 1, False, None)

        def within(measurement: Measurement) -> Measurement:
            try:
                return measurement.within(limits, run)
            except DesignFailure:
                return measurement

        result.measurements = [within(measurement) for measurement in self.measurements]
        return result

    def has_steps(self, limits: Limits) -> bool:
        """True if its measurements need a motion, by a method whose error falls with the square of its equal steps."""
        return isinstance(self.simulation.integrator, OneStep) and any(x.until(limits) > 0.0 for x in self.measurements)

    def run(self, designs: dict[str, Tensor], lanes: int, gradients: bool, steps: int | None) -> Run:
        """The experiment with a batch of designs, by name [lanes, ...]."""
        simulation = self.simulation.with_steps(steps)
        return Run(self.system, self.duration or 0.0, designs, self.settings, simulation, lanes, gradients)
