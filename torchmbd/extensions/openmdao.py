"""A motion as a component of OpenMDAO: parameters of the system in, responses out, with the exact Jacobian.

    component = mbd.openmdao_component(system, 0.1, {"energy": mbd.Integral(mbd.StrainEnergy("rod")), "mass": mbd.Mass("rod")})

Inputs are named as the parameters, with colons: "rod:laminate:angles". All numbers are SI units and radians, without units of
OpenMDAO. The Jacobian is one gradient of all responses; OpenMDAO multiplies with it in both directions.
A function over 60 lines: the class of the component is made inside it, when OpenMDAO is imported.
Source: J. S. Gray et al., OpenMDAO: an open-source framework for multidisciplinary design, analysis, and optimization,
Struct. Multidisc. Optim. 59 (2019) 1075-1104, doi:10.1007/s00158-019-02211-z.
Checked in tests/extensions/test_openmdao.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmbd.design.differentiate import differentiate
from torchmbd.design.response import Measure
from torchmbd.errors import InputError, not_installed, unknown
from torchmbd.integrate import Trajectory
from torchmbd.multibody.system import System
from torchmbd.results.motion_data import OK
from torchmbd.simulation import Simulation

__all__ = ["openmdao_component"]

_GRADIENTS = ("reverse", "forward")


def openmdao_component(
    system: System,
    duration: float,
    responses: Mapping[str, Measure],
    variables: Sequence[str] | None = None,
    gradients: str = "reverse",
    **options: Any,
) -> Any:
    """A component of OpenMDAO that simulates a system: an `ExplicitComponent` with exact partial derivatives.

    system     the model
    duration   of the motion [s]
    responses  name of an output -> measure; an output has as many entries as its measure has rows
    variables  names of the parameters that are inputs, of the parameters' shapes; None: all that require a gradient
    gradients  of the Jacobian: "reverse" or "forward", as in `simulate`
    options    of `simulate`: steps, method, start and others

    A motion that fails raises OpenMDAO's AnalysisError, which its drivers handle, with the status of the motion. A complex step
    through the component raises RuntimeError: motions are real numbers.
    Raises InputError without the package openmdao, and for unknown parameters.

    >>> from importlib.util import find_spec
    >>> if find_spec("openmdao"):
    ...     component = mbd.openmdao_component(mbd.examples.arm(), 0.02, {"mass": mbd.Mass("arm")})
    """
    try:
        om: Any = import_module("openmdao.api")
    except ImportError as error:
        raise not_installed(
            "package", "openmdao", "openmdao_component", "openmdao", "pip install 'torchmbd[openmdao]'"
        ) from error
    if gradients not in _GRADIENTS:
        raise InputError("gradients", gradients, f"{' or '.join(map(repr, _GRADIENTS))}")
    if not isinstance(responses, Mapping) or not responses:
        raise InputError("responses", responses, "a mapping name -> measure with at least one name")
    for name, measure in responses.items():
        if not isinstance(measure, Measure):
            raise InputError(name, measure, "a measure, such as mbd.Max(...)", noun=f"response {name!r}")
    parameters = dict(system.named_parameters())
    for name in variables or ():
        if name not in parameters:
            raise unknown("parameter", name, parameters)
    names = list(variables) if variables else [name for name, x in parameters.items() if x.requires_grad]
    if not names:
        raise InputError(
            "system", allowed="must have at least one variable", state="has no parameter that requires a gradient"
        )
    simulation = Simulation(system, duration, **options)

    class Motion(om.ExplicitComponent):
        """Inputs: parameters of the system; outputs: responses of its motion."""

        measures: list[Measure]

        def setup(self) -> None:
            motion = self.motion({name: parameters[name].detach() for name in names}, "none")
            self.measures = [measure.at_start(motion) for measure in responses.values()]
            for name in names:
                self.add_input(_input(name), parameters[name].detach().numpy())
            for name, values in zip(responses, self.values(motion), strict=True):
                self.add_output(name, values[0].numpy())

        def setup_partials(self) -> None:
            self.declare_partials("*", "*")

        def compute(self, inputs: Any, outputs: Any) -> None:
            motion = self.motion(self.design(inputs), "none")
            for name, values in zip(responses, self.values(motion), strict=True):
                outputs[name] = values[0].numpy()

        def compute_partials(self, inputs: Any, partials: Any) -> None:
            motion = self.motion(self.design(inputs), gradients)
            gradient = differentiate(self.values, motion).gradient
            assert gradient is not None
            first = 0
            for output, values in zip(responses, self.values(motion), strict=True):
                last, begin = first + values.shape[1], 0
                for name in names:
                    end = begin + parameters[name].numel()
                    partials[output, _input(name)] = gradient[0, first:last, begin:end].numpy()
                    begin = end
                first = last

        def design(self, inputs: Any) -> dict[str, Tensor]:
            """The parameters in their shapes, where OpenMDAO has vectors; RuntimeError in a complex step."""
            if self.under_complex_step:
                raise RuntimeError(
                    f"{self.pathname or 'motion'}: a motion has no complex step, its derivatives would be zero. Try: partials "
                    "and totals of the component, which are exact, or method='fd'"
                )
            values = {name: torch.from_numpy(np.array(inputs[_input(name)], dtype=float)) for name in names}
            return {name: x.reshape(parameters[name].shape) for name, x in values.items()}

        def motion(self, design: Mapping[str, Tensor], gradients: str) -> Trajectory:
            """The motion of one design; AnalysisError if it fails."""
            designs = {name: x[None] for name, x in design.items()}
            motion = simulation(designs, gradients, names)
            [status] = motion.status
            if status != OK:
                raise om.AnalysisError(f"{self.pathname or 'motion'}: {status}")
            return motion

        def values(self, motion: Trajectory) -> list[Tensor]:
            """Values of every response [1, rows]."""
            return [measure.value(motion).reshape(1, -1) for measure in self.measures]

    return Motion()


def _input(name: str) -> str:
    return name.replace(".", ":")
