"""A vibration of the system as it was built, found again in each design by its shape.

Numbers count frequencies: where two cross between designs the number of a vibration changes. With `follow` a measure has the
vibration whose shape is most like that of its number in the system as it was built, with its own values of all parameters.
A design in which none is surely the same, as where two veer, fails by name.
Checked in tests/extensions/vibrations/measures/test_followed_vibrations.py.
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from torchmbd.errors import DesignFailure, InputError
from torchmbd.extensions.vibrations.eigenvalues import NATURAL
from torchmbd.extensions.vibrations.likeness import MostAlike, NodalShape
from torchmbd.extensions.vibrations.spectrum import SWINGS, Spectrum
from torchmbd.extensions.vibrations.steady_states import Shaft, SteadyStates, steady_states
from torchmbd.math.module_call import outside_transforms
from torchmbd.multibody.system import System

_Key = tuple[Shaft, float, str, int]
#: Shapes of systems, with the values of the parameters that they belong to.
_SHAPES: WeakKeyDictionary[System, dict[_Key, tuple[Tensor, NodalShape]]] = WeakKeyDictionary()


def followed_eigenvalue(
    states: SteadyStates, system: System, shaft: Shaft, speed: float, kind: str, number: int
) -> Tensor:
    """The eigenvalue [designs] of states at one speed that has the shape of a number, from 1, in the system as it was built."""
    shape = outside_transforms(lambda: _shape(system, (shaft, speed, kind, number)))
    names = list(states.modes)

    def in_modes(*modes: Tensor) -> Tensor:
        lanes = max((x.shape[-1] for x in modes), default=1)
        of_lanes = [
            {n: x[..., min(i, x.shape[-1] - 1)] for n, x in zip(names, modes, strict=True)} for i in range(lanes)
        ]
        return torch.stack([shape.in_modes(states.dynamics.topology, x) for x in of_lanes], -1)

    shapes = outside_transforms(in_modes, *(x.movedim(0, -1) for x in states.modes.values()))
    choice = MostAlike(shapes, f"vibration {number} of the start")
    values = states.eigenvalues(kind, choice)[:, 0]
    return values.gather(1, torch.searchsorted(choice.chosen, choice.numbers)[:, None])[:, 0]


def _shape(system: System, key: _Key) -> NodalShape:
    """The shape of a vibration of the system with its own parameters; kept as long as these have the same values."""
    shaft, speed, kind, number = key
    values = torch.cat([torch.zeros(0, dtype=torch.float64), *(x.detach().flatten() for x in system.parameters())])
    known = _SHAPES.setdefault(system, {})
    if key in known and torch.equal(known[key][0], values):
        return known[key][1]
    with torch.no_grad():
        states = steady_states(system, [speed], shaft)
        rest = states.linearization(0)
    spectrum = Spectrum.natural(rest) if kind == NATURAL else Spectrum.poles(rest)
    order = torch.arange(len(spectrum.values))
    if kind != NATURAL:
        order = order[spectrum.values.imag > SWINGS * spectrum.values.abs()]
    if number > len(order):
        raise InputError(
            "number", number, f"1 to {len(order)}, the vibrations of the system as it was built", shown=f"{number}"
        )
    i = int(order[number - 1])
    if spectrum.fault[i] or int((spectrum.cluster == spectrum.cluster[i]).sum()) > 1:
        why = spectrum.fault[i] or "equal to another"
        raise DesignFailure(
            "number",
            number,
            "a vibration with a shape of its own",
            noun=f"vibration {number} of the system as it was built",
            state=f"has no shape to follow, because its eigenvalue is {why}",
            hint="another number, or follow=False",
        )
    modes = {name: x[0].detach().clone() for name, x in states.modes.items()}
    shape = NodalShape(spectrum.right[:, i].clone(), states.dynamics.topology, modes)
    known[key] = values, shape
    return shape
