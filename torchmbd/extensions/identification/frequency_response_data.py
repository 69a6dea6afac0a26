"""Measured frequency responses: amplitudes of outputs by those of an input, about an equilibrium or in steady rotation.

    complex   r = (Re G - Re m) / deviation,  (Im G - Im m) / deviation
    polar     r = (ln |G| - ln |m|) / deviation,  arg(G / m) / deviation         phases within half a turn

G is that of the linearized model (vibrations/frequency_response.py), with exact derivatives; m what was measured.
Checked in tests/extensions/identification/test_frequency_response_data.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmbd.design.differentiate import differentiate
from torchmbd.errors import InputError, one_of, wrong_entry
from torchmbd.extensions.identification.channel import checked_deviation
from torchmbd.extensions.identification.measurement import Block, Measurement, Prediction
from torchmbd.extensions.identification.modal_data import check_options
from torchmbd.extensions.identification.run import Run
from torchmbd.extensions.identification.table import Table
from torchmbd.extensions.vibrations.frequency_response import QUANTITIES, frequency_response
from torchmbd.extensions.vibrations.linear_system import checked_ports, system_with_ports
from torchmbd.extensions.vibrations.port_functions import Ports
from torchmbd.multibody.forces.signals import Actuator, Signal
from torchmbd.multibody.system import System
from torchmbd.results.motion_data import OK

PARTS = {"complex": ("real", "imaginary"), "polar": ("magnitude", "phase")}


class FrequencyResponseData(Measurement):
    """Frequency responses of some outputs to one input.

    data        a mapping of arrays: frequencies, and one complex array for each output; or a CSV file or a DataFrame with
                two columns for each, "tip real" and "tip imaginary", or for form="polar" "tip magnitude" and "tip phase";
                units may be in the headings, else SI: [Hz], the unit of the output over that of the input, [rad]; nan is
                a gap
    input       an actuator of the system, such as mbd.signals.JointTorque(joint)
    outputs     name -> a signal of one number, such as mbd.signals.JointAngle(joint); or a pair of a signal of three and a
                direction: (mbd.signals.PointPosition(frame), "y")
    frequency   name of the column of frequencies
    quantity    "displacement": the outputs are the signals; "velocity", "acceleration": their first, second rates in time
    form        what is compared: "complex", the real and the imaginary part, or "polar", the logarithm of the magnitude and the
                phase
    deviation   name -> standard deviation of both parts, in the unit of the response or, of "polar", [-] and [rad]: a number,
                or one for each row, which weights the rows; None: estimated from the residuals
    options     of `equilibrium`: spin, center, observer for a steady rotation, times. Fixed sensors and forces perpendicular
                to the axis need observer="ground"

    >>> [hinge] = mbd.examples.pendulum().joints
    >>> shown = {"f": [0.2, 0.4], "swing": [0.1 + 0.0j, -0.2 - 0.01j]}
    >>> torque, angle = mbd.signals.JointTorque(hinge), mbd.signals.JointAngle(hinge)
    >>> measured = mbd.identification.FrequencyResponseData(shown, torque, {"swing": angle}, frequency="f")
    >>> [(block.channel, len(block.measured)) for block in measured.blocks]
    [('swing real', 2), ('swing imaginary', 2)]
    """

    def __init__(
        self,
        data: Any,
        input: Actuator,
        outputs: Mapping[str, Signal | tuple[Signal, str]],
        frequency: str = "frequency",
        quantity: str = QUANTITIES[0],
        form: str = "complex",
        deviation: Mapping[str, Any] | None = None,
        **options: Any,
    ):
        if not isinstance(outputs, Mapping) or not all(isinstance(name, str) for name in outputs):
            raise InputError("outputs", outputs, "a mapping name -> signal, such as mbd.signals.JointAngle(joint)")
        if not isinstance(input, Actuator):
            raise InputError("input", input, "an actuator, such as mbd.signals.JointTorque(joint)")
        pairs = {name: x if isinstance(x, tuple) and len(x) == 2 else (x, None) for name, x in outputs.items()}
        self.input, signals = checked_ports([input], [signal for signal, _ in pairs.values()])
        check_options(self, options)
        self.outputs, self.options = dict(zip(outputs, signals, strict=True)), options
        self.form, self.order = one_of("form", form, PARTS), QUANTITIES.index(one_of("quantity", quantity, QUANTITIES))
        self.rows: list[int] = []  # of the outputs among the numbers of all signals
        first = 0
        for name, (signal, direction) in pairs.items():
            if (direction is None) != (signal.size == 1):
                text = f"{signal!r}, of {signal.size} numbers" + (f", and {direction!r}" if direction else "")
                raise InputError(
                    name,
                    text,
                    "a signal of one, or a pair of a signal of three and 'x', 'y' or 'z'",
                    noun=f"output {name!r}",
                    shown=f"{text}",
                )
            if direction is not None:
                one_of((name, "direction"), direction, "xyz")
            self.rows.append(first + ("xyz".index(direction) if direction else 0))
            first += signal.size
        self.f, measured = _table(data, frequency, list(outputs), self.form)
        self.present = {name: np.isfinite(m) for name, m in measured.items()}
        self.measured = {name: m[self.present[name]] for name, m in measured.items()}
        self.deviation: dict[str, np.ndarray] = {}
        for name, m in self.measured.items():
            if not len(m) or (self.form == "polar" and not m.all()):
                raise InputError(
                    name,
                    allowed="must have numbers other than zero at all of them",
                    noun=f"output {name!r}",
                    state="has zeros or gaps at measured frequencies",
                )
        deviation = {} if deviation is None else deviation
        if not isinstance(deviation, Mapping):
            raise InputError("deviation", deviation, "a mapping name of an output -> a number, or one for each row")
        for name, x in deviation.items():
            one_of("deviation", name, self.outputs)
            values = checked_deviation(f"deviation of output {name!r}", x)
            if isinstance(values, np.ndarray) and len(values) != len(self.f):
                raise InputError(
                    (name, "deviation"),
                    deviation,
                    f"must have {len(self.f)}",
                    noun=f"deviation of output {name!r}",
                    state=f"has {len(values)} values",
                )
            self.deviation[name] = np.broadcast_to(values, self.f.shape)[self.present[name]]

    def check(self, system: System) -> None:
        system_with_ports(system, Ports(1), self.input, list(self.outputs.values()))

    @property
    def blocks(self) -> list[Block]:
        result = []
        for name, m in self.measured.items():
            parts = (np.real(m), np.imag(m)) if self.form == "complex" else (np.log(np.abs(m)), np.angle(m))
            units = ("", "") if self.form == "complex" else (" (ln) [-]", " [rad]")
            for part, numbers, unit in zip(PARTS[self.form], parts, units, strict=True):
                label, f, deviation = f"{name} {part}", self.f[self.present[name]], self.deviation.get(name)
                result.append(Block(label, f, numbers, deviation, f"{part} of {name}{unit}", "frequency [Hz]"))
        return result

    def predict(self, run: Run, unknowns: Mapping[str, Tensor]) -> Prediction:
        ports = Ports(1)
        system = system_with_ports(run.system, ports, self.input, list(self.outputs.values()))
        f = torch.from_numpy(self.f)
        places = {name: torch.from_numpy(np.flatnonzero(present)) for name, present in self.present.items()}

        def rows(rest: Any) -> list[Tensor]:
            G = frequency_response(rest, ports, f, self.rows, self.order)[..., 0]
            result = []
            for k, name in enumerate(self.outputs):
                y, m = G[:, places[name], k], torch.from_numpy(self.measured[name])
                if self.form == "complex":
                    result += [y.real, y.imag]
                else:
                    result += [y.abs().log(), m.angle() + (y / m).angle()]
            return [torch.cat(result, 1)]

        y = differentiate(rows, run.equilibrium(system, **self.options))
        value, gradient = y.value.expand(run.lanes, -1), y.gradient
        if run.gradients and gradient is None:
            gradient = value.new_zeros(*value.shape, 0)
        return Prediction(value, gradient, {}, [OK] * run.lanes)


def _table(data: Any, frequency: str, names: list[str], form: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Frequencies [rows] [Hz] and complex numbers of each output [rows], nan where there is none."""
    pairs = dict(data) if isinstance(data, Mapping) else {}
    for name in [name for name in names if name in pairs]:  # arrays of complex numbers
        x, form = np.asarray(pairs.pop(name)), "complex"
        if not np.iscomplexobj(x):
            raise InputError(
                name,
                allowed="must have complex numbers",
                noun=f"output {name!r}",
                state="has numbers without imaginary parts",
            )
        pairs |= {f"{name} real": np.real(x), f"{name} imaginary": np.imag(x)}
    data = pairs or data
    columns = {name: [f"{name} {part}" for part in PARTS[form]] for name in names}
    table = Table.of(data, [frequency, *(x for pair in columns.values() for x in pair)])
    f = _in_unit(table, frequency, "Hz")
    if not (np.isfinite(f).all() and (f > 0.0).all() and (np.diff(f) > 0.0).all()):
        wrong = int(np.flatnonzero(~(np.isfinite(f) & (f > 0.0) & (np.diff(f, prepend=-1.0) > 0.0)))[0])
        raise InputError(
            "frequency",
            float(f[wrong]),
            "positive numbers in rising order",
            state=f"is {f[wrong]:g} Hz",
            noun=f"{table.row(wrong)}: frequency",
        )
    result = {}
    for name, (first, second) in columns.items():
        x = table.factor(first, None)[0] * table.columns[first]
        if form == "complex":
            result[name] = x + 1j * table.factor(second, None)[0] * table.columns[second]
            continue
        if (x <= 0.0).any():
            raise wrong_entry(table.row(int(np.flatnonzero(x <= 0.0)[0])), f"{first} is not positive", "above 0")
        result[name] = x * np.exp(1j * _in_unit(table, second, "rad"))
    return f, result


def _in_unit(table: Table, column: str, unit: str) -> np.ndarray:
    """A column in this SI unit; InputError for a heading of another."""
    factor, si = table.factor(column, None)
    if si not in (None, unit):
        raise InputError(
            (str(column), "unit"), unit, f"one of [{unit}]", noun=f"unit of column {column!r}", state=f"is of [{si}]"
        )
    return factor * table.columns[column]
