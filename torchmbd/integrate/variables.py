"""Variables of a motion: the names of the parameters by which it is differentiated, and their lanes.

Checked in tests/integrate/test_simulate.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.integrate.arguments import checked_variables
from torchmbd.math.gradients import is_differentiated
from torchmbd.multibody.system import System


def variable_names(
    system: System, designs: Mapping[str, Tensor], gradients: str, variables: Sequence[str] | None, by_times: bool
) -> list[str]:
    """Names of the parameters by which the motion is differentiated.

    by_times: whether it is differentiated by its duration or times of its phases as well
    """
    if gradients == "none":
        return []
    parameters = dict(system.named_parameters())
    if variables is not None:
        return checked_variables(system, variables)
    if gradients == "auto":
        return [name for name, x in parameters.items() if is_differentiated(designs.get(name, x))]
    names = [name for name, x in parameters.items() if x.requires_grad or is_differentiated(designs.get(name, x))]
    if not names and not by_times:
        raise InputError(
            "gradients", gradients, "'auto' or 'none', because no parameter of the system requires a gradient"
        )
    return names


def refuse_other_designs(names: Sequence[str], designs: Mapping[str, Tensor]) -> None:
    """InputError if a design is being differentiated, but is none of the variables of these names."""
    for name, x in designs.items():
        if name not in names and is_differentiated(x):
            raise InputError(
                name,
                allowed="one of the variables",
                noun=f"design {name!r}",
                state=f"is being differentiated, but variables is {list(names)}",
                hint=f"variables = [..., {name!r}], or the detached tensor x.detach()",
            )


def entry_labels(system: System, names: Sequence[str]) -> tuple[str, ...]:
    """One label for each entry of the named parameters: `rod.laminate.angles[0]`."""
    parameters = dict(system.named_parameters())
    return tuple(f"{name}[{i}]" for name in names for i in range(parameters[name].numel()))


def lanes_of_batch(
    system: System, designs: Mapping[str, Tensor], names: Sequence[str], arguments: Mapping[str, int] | None = None
) -> dict[str, Tensor]:
    """Designs, and own values of the other variables `names`, all with the same lanes [lanes, ...].

    arguments   number of lanes of other arguments, such as "start", by their names
    """
    parameters, others = dict(system.named_parameters()), arguments or {}
    batch = {name: parameters[name][None] for name in names if name not in designs} | dict(designs)
    counts = {name: x.shape[0] for name, x in batch.items()} | dict(others)
    lanes = max(counts.values(), default=1)
    if not {1, lanes}.issuperset(counts.values()):
        wrong = [name for name, n in counts.items() if n > 1]
        argument = "designs" if set(wrong) & set(batch) else wrong[-1]
        shown = ", ".join(f"{name!r}: {counts[name]}" for name in wrong)
        value, allowed = {name: counts[name] for name in wrong}, "the same number for all, or one"
        raise InputError(argument, value, allowed, noun="numbers of lanes", state=f"differ: {shown}")
    return {name: x.clone().expand(lanes, *x.shape[1:]) for name, x in batch.items()}
