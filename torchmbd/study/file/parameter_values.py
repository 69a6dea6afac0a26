"""Values of parameters of a model in a file that any study can load.

    hinge.damping: {value: 0.021, unit: none}
    bob.mass: 0.98                                   without a unit in SI

    parameters: fitted.yaml                          in an experiment file, or parameters=fitted.yaml on the command line

The entries of the file stand in the place of its name before anything is checked, so that the record of the study has the
numbers. Checked in tests/study/file/test_parameter_values.py.
"""

from __future__ import annotations

from pathlib import Path

import torch

from torchmbd.design.scenario_settings import settings_of
from torchmbd.multibody.system import System
from torchmbd.study.file.faults import Fault, StudyError
from torchmbd.study.file.scenario_keys import Settings, si_of
from torchmbd.study.file.yaml_file import Document, read_yaml

KEY = "parameters"


def with_values_of_file(document: Document, folder: Path) -> None:
    """Put the entries of the file that `parameters` names in its place; StudyError for one that is not a mapping."""
    if not isinstance(document.data, dict) or not isinstance(document.data.get(KEY), str):
        return
    named = folder / document.data[KEY]
    values = read_yaml(named)
    if not isinstance(values.data, dict):
        raise StudyError(str(named), [Fault((), "has no parameters: must have name: {value: ..., unit: ...}")])
    document.data[KEY] = values.data
    for path, line in values.lines.items():
        document.lines[(KEY, *path)] = f"{named}, line {line}"


def set_parameters(system: System, values: Settings) -> System:
    """Give parameters of a system, by name, other values; InputError for one that does not exist, or that cannot be."""
    if not values:
        return system
    settings = settings_of(system, (), f"of {KEY}", si_of(values), (KEY,))
    with torch.no_grad():
        for name, value in settings.items():
            system.get_parameter(name).copy_(value)
    return system
