"""Nodes of a beam line that are functions of parameters: geometry as a design.

    BeamLine(torch.nn.Parameter(nodes))               the nodes themselves: "rod.line.nodes"
    BeamLine.straight(length=mbd.variable(0.3))       a length: "rod.line.length"
    BeamLine(module)                                  any torch module without arguments that returns nodes [n, 3] [m]

A module is evaluated for each design by itself, so it has no axis of lanes. Straight elements only.
Checked in tests/sensitivity/test_node_variables.py.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.math.checked_numbers import parameter
from torchmbd.math.variable import ParameterVector


class Nodes(nn.Module):
    """Nodes that are a parameter [n, 3]."""

    nodes: Tensor

    def __init__(self, nodes: nn.Parameter):
        super().__init__()
        self.nodes = parameter("nodes of a BeamLine", nodes)

    def forward(self) -> Tensor:
        return self.nodes


class Straight(nn.Module):
    """Nodes at shares of a length [m]."""

    positive = ("length",)
    length: Tensor
    _unit: Tensor

    def __init__(self, length: Any, unit: Float[Tensor, "n 3"]):
        super().__init__()
        self.length = length
        self.register_buffer("_unit", unit, persistent=False)

    def forward(self) -> Tensor:
        return self.length * self._unit


def node_module_of(nodes: Any) -> nn.Module | None:
    """Return the module that computes the nodes; None where they are constant."""
    if isinstance(nodes, nn.Parameter):
        return Nodes(nodes)
    return nodes if isinstance(nodes, nn.Module) else None


def evaluate_nodes(shape: nn.Module) -> Tensor:
    """Return the present nodes of a module [n, 3] without gradient; InputError where it returns something else."""
    with torch.no_grad():
        nodes = shape()
    if not isinstance(nodes, Tensor) or nodes.dtype != torch.float64 or nodes.ndim != 2 or nodes.shape[1] != 3:
        allowed = "nodes [n, 3] in float64"
        raise InputError(f"the module of a BeamLine returns {nodes!r}; allowed: {allowed}")
    return nodes.detach().clone()


def varying_nodes(mesh: Any) -> bool:
    """Whether the nodes of a mesh depend on the design."""
    return getattr(mesh, "node_module", None) is not None


def present_nodes(mesh: Any) -> Float[Tensor, "*lanes n 3"]:
    """Nodes of a mesh in the present design [m]."""
    if not varying_nodes(mesh):
        return mesh.nodes
    variables: ParameterVector = mesh.variables
    return variables.evaluated()
