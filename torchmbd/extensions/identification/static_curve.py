"""Static curves: what a mechanism shows at rest under several loads.

    r_k = (gain y(q(p_k)) + offset - measured_k) / deviation        q(p): the equilibrium under the loads p

Loads are parameters of the system, such as the force of mbd.Force(..., (0, 0, mbd.variable(0.0))). The equilibria of a
design are one path, each searched from that of the row before: rows stand in the order in which the load grows.
Checked in tests/extensions/identification/test_static_curve.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchmbd.design.differentiate import differentiate
from torchmbd.errors import InputError, within
from torchmbd.extensions.identification.channel import Channel, channels_of
from torchmbd.extensions.identification.measurement import Block, Measurement, Prediction, number_of
from torchmbd.extensions.identification.run import Run
from torchmbd.extensions.identification.table import Table
from torchmbd.multibody.system import System
from torchmbd.results.motion_data import OK
from torchmbd.simulation.equilibrium import equilibrium


class StaticCurve(Measurement):
    """Channels measured at rest under several loads.

    data      a CSV file, a DataFrame or a mapping of arrays: columns of loads, and one for each channel; nan is a gap
    loads     parameter of the system -> name of the column with its values; units may be in the headings, else SI
    channels  name -> mbd.identification.Channel(...) without delay, or a history whose name is that of its column

    >>> force = [0.0, 1.0, 2.0]
    >>> curve = mbd.identification.StaticCurve({"F": force, "z": force}, {"push.z": "F"}, {"z": mbd.Position("tip", "z")})
    >>> [(block.channel, block.abscissa) for block in curve.blocks]
    [('z', 'push.z')]
    """

    def __init__(self, data: Any, loads: Mapping[str, str], channels: Mapping[str, Any]):
        if not isinstance(loads, Mapping) or not loads or not all(isinstance(x, str) for x in loads.values()):
            raise InputError("loads", loads, "a mapping parameter -> name of its column, with at least one parameter")
        self.channels = channels_of(channels)
        columns = {name: channel.column or name for name, channel in self.channels.items()}
        table = Table.of(data, list(dict.fromkeys([*loads.values(), *columns.values()])))
        self.loads = {name: _load(table, column) for name, column in loads.items()}
        self.values = {name: x.si(f"channel {name!r}", table, columns[name]) for name, x in self.channels.items()}
        self.present = {name: np.isfinite(y) for name, y in self.values.items()}
        for name, channel in self.channels.items():
            _check_channel(name, channel, self.present[name])

    def check(self, system: System) -> None:
        parameters = dict(system.named_parameters())
        for name in self.loads:
            if name not in parameters:
                hint = "mbd.variable(...), which makes a parameter of a plain number of a load"
                noun, state = f"load {name!r}", "is not a parameter"
                raise InputError(("loads", name), allowed=parameters, hint=hint, noun=noun, state=state)
            if parameters[name].numel() != 1:
                state, allowed = f"has {parameters[name].numel()} entries", "a parameter of one entry"
                raise InputError(("loads", name), noun=f"load {name!r}", allowed=allowed, state=state)
        for name, channel in self.channels.items():
            try:
                channel.response.check(system)
            except InputError as error:
                raise within(f"channel {name!r}", error, "channels", name) from None

    @property
    def blocks(self) -> list[Block]:
        abscissa, load = next(iter(self.loads.items()))
        result = []
        for name, channel in self.channels.items():
            present, deviation = self.present[name], channel.deviation
            spread = (
                None
                if deviation is None
                else np.broadcast_to(np.asarray(deviation, dtype=float), present.shape)[present]
            )
            result.append(Block(name, load[present], self.values[name][present], spread, channel.title, abscissa))
        return result

    @property
    def unknowns(self) -> dict[str, nn.Parameter]:
        return {f"{name}.{key}": x for name, channel in self.channels.items() for key, x in channel.unknowns.items()}

    @property
    def sets(self) -> list[str]:
        return list(self.loads)

    def predict(self, run: Run, unknowns: Mapping[str, Tensor]) -> Prediction:
        paths = [self._path(run, lane) for lane in range(run.lanes)]
        value = torch.stack([y for y, _ in paths])
        by_design = torch.stack([dy for _, dy in paths]) if run.gradients else None
        count = value.shape[1]
        gains, offsets = torch.ones(run.lanes, count).double(), torch.zeros(run.lanes, count).double()
        by_unknown = {key: torch.zeros(run.lanes, count, dtype=torch.float64) for key in unknowns}
        first = 0
        for name, channel in self.channels.items():
            rows = slice(first, first + int(self.present[name].sum()))
            gains[:, rows] = number_of(channel.gain, f"{name}.gain", unknowns)[:, None]
            offsets[:, rows] = number_of(channel.offset, f"{name}.offset", unknowns)[:, None]
            for key, slope in (("gain", value[:, rows]), ("offset", torch.ones_like(value[:, rows]))):
                if f"{name}.{key}" in by_unknown:
                    by_unknown[f"{name}.{key}"][:, rows] = slope
            first = rows.stop
        slopes = None if by_design is None else gains[..., None] * by_design
        return Prediction(gains * value + offsets, slopes, by_unknown, [OK] * run.lanes)

    def _path(self, run: Run, lane: int) -> tuple[Tensor, Tensor]:
        """Numbers [rows] of one design, and their derivatives in the variables [rows, n_b]; zeros without gradients."""
        loads = {name: torch.from_numpy(x) for name, x in self.loads.items()}
        count = len(next(iter(loads.values())))
        shapes = {name: x.shape for name, x in run.system.named_parameters()}
        designs = {name: x.reshape(count, *shapes[name]) for name, x in loads.items()}
        differentiable = run.gradients and bool(run.variables)
        for name, x in run.parameters.items():
            x = x[lane].detach().expand(count, *x.shape[1:]).clone()
            designs[name] = x.requires_grad_(differentiable and name in run.variables)
        with torch.set_grad_enabled(differentiable):
            variables = run.variables if differentiable else None
            rest = equilibrium(run.system, designs=designs, variables=variables, start=run.rest_start, follow=True)

        def rows(rest: Any) -> Tensor:
            return torch.cat([channel.response.values(rest)[:, :1] for channel in self.channels.values()], 1)

        y = differentiate(rows, rest)
        places = [torch.from_numpy(np.flatnonzero(present)) for present in self.present.values()]
        value = torch.cat([y.value[rows, k] for k, rows in enumerate(places)])
        if y.gradient is None:
            return value, value.new_zeros(len(value), sum(x[0].numel() for x in run.designs.values()))
        return value, torch.cat([y.gradient[rows, k] for k, rows in enumerate(places)])


def _load(table: Table, column: str) -> np.ndarray:
    """Values of a load in SI; InputError for one that is not a number."""
    factor, _ = table.factor(column, None)
    values = factor * table.columns[column]
    wrong = np.flatnonzero(~np.isfinite(values))
    if not len(values) or len(wrong):
        where = table.row(int(wrong[0])) if len(wrong) else "data"
        value, noun = values[wrong[:1]].tolist(), f"{where}: load {column!r}"
        raise InputError(("columns", column), value, "a finite number in every row", noun=noun)
    return values


def _check_channel(name: str, channel: Channel, present: np.ndarray) -> None:
    path, noun = ("channels", name), f"channel {name!r}"
    if isinstance(channel.delay, nn.Parameter) or channel.delay:
        raise InputError(
            path, allowed="must have gain and offset alone", state="of a static curve has a delay", noun=noun
        )
    if not present.any():
        raise InputError(path, allowed="must have at least one number", state="has only gaps", noun=noun)
    if isinstance(channel.deviation, np.ndarray) and len(channel.deviation) != len(present):
        state, allowed = f"has {len(channel.deviation)} values", f"must have {len(present)}"
        raise InputError((*path, "deviation"), channel.deviation, allowed, noun=f"deviation of {noun}", state=state)
    if channel.response.since_start:
        allowed = "mbd.Position, with an offset, or the displacement of a node seen from its own body"
        shown = "a displacement since the start, which a state at rest has not"
        raise InputError(path, channel.response, allowed, noun=noun, shown=shown)
