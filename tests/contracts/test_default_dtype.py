"""Numbers do not depend on torch's default dtype: no file of the package makes a floating tensor that is not float64."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close
from torch.utils._python_dispatch import TorchDispatchMode

import torchmbd as mbd
from tests.mechanisms import GRAVITY, SOFT, laminate, pendulum, plate
from torchmbd.examples import two_link_arm

PACKAGE = str(Path(mbd.__file__).parent)


class Precision(TorchDispatchMode):
    """Collects the lines of the package that make floating tensors of another precision."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: set[str] = set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        for x in result if isinstance(result, (tuple, list)) else (result,):
            if isinstance(x, Tensor) and x.is_floating_point() and x.dtype != torch.float64:
                self.lines.add(f"{_line()} {func}")
        return result


def _line() -> str:
    frame = sys._getframe(2)
    while frame and not frame.f_code.co_filename.startswith((PACKAGE, __file__)):
        frame = frame.f_back
    return f"{frame.f_code.co_filename}:{frame.f_lineno}" if frame else "elsewhere"


@contextmanager
def default(dtype: torch.dtype) -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


def motion(system: mbd.System, name: str, gradients: str = "auto") -> list[Tensor]:
    """Values and gradients of a motion."""
    result = mbd.simulate(system, 0.02, steps=4, backend="eager", gradients=gradients)
    value = result.q.square().sum() + mbd.Max(mbd.StrainEnergy(name))(result).sum()
    by = torch.autograd.grad(value, [x for x in system.parameters() if x.requires_grad], allow_unused=True)
    return [result.q, result.lam, *(x for x in by if x is not None)]


def sections(folder: Path) -> list[Tensor]:
    ply = mbd.examples.carbon()
    tube = mbd.sections.tube(0.02, ply, mbd.deg([30.0, -20.0]), thickness=mbd.variable(1e-3), cells=(8, 1))
    line = mbd.BeamLine.straight(mbd.variable(0.7), elements=3)
    body = mbd.FlexibleBody.beam("beam", line, tube, modes=3, reference="start", twist=0.3).damped(0.01)
    column = mbd.ExactBeam("column", mbd.BeamLine.straight(1.0, elements=4), tube)
    return [
        tube.stiffness(),
        tube.mass(),
        *body.structure().values(),
        column.equilibrium({"end": (1e3, 10.0, 5.0)}).nodes,
    ]


def statics(folder: Path) -> list[Tensor]:
    system = pendulum()
    rest = mbd.equilibrium(system)
    return [rest.q, rest.lam, rest.vibrations[0].frequencies]


def stiffened(folder: Path) -> list[Tensor]:
    return list(plate("rod", 2, stiffening=True, kind="triangle").structure().values())


def pairs(folder: Path) -> list[Tensor]:
    K = torch.tensor([[2.0, -1, 0], [-1, 2, -1], [0, -1, 2]], dtype=torch.float64)
    result = mbd.reduction.eigenpairs(K, torch.ones(3, dtype=torch.float64), 2)
    rigid = mbd.RigidBody("box", 1.3, (0.1, 0.2, 0.3), position=(0.1, 0.2, 0.7))
    return [*result, rigid.position, rigid.invariants()["P0"], laminate().entries()]


def bent(folder: Path) -> list[Tensor]:
    rod = plate("rod", 3, made_of=laminate((20.0, -50.0), 3e-3, SOFT)).bent([1e-3, -7e-4, 3e-4])
    hinge = mbd.Revolute(mbd.Ground().at(), rod.at("left"), axis="x", name="hinge")
    return motion(mbd.System([rod], [hinge], gravity=GRAVITY), "rod")


CASES: dict[str, Callable[[Path], list[Tensor]]] = {
    "motion": lambda _: motion(two_link_arm.build(cells=(4, 2), modes=2), "upper"),
    "examples": lambda _: motion(mbd.examples.arm(), "arm", gradients="forward"),
    "bent": bent,
    "sections": sections,
    "statics": statics,
    "stiffened": stiffened,
    "pairs": pairs,
}


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32])
@pytest.mark.parametrize("case", CASES)
def test_results_are_those_of_float64(case, dtype, tmp_path):
    check(CASES[case], dtype, tmp_path)


def check(case: Callable[[Path], list[Tensor]], dtype: torch.dtype, folder: Path) -> None:
    """A case has the results of float64 by another default, and no line makes another tensor."""
    with default(torch.float64):
        expected = case(folder)
    with default(dtype), Precision() as precision:
        result = case(folder)
    assert not precision.lines
    for x, y in zip(result, expected, strict=True):
        assert x.dtype == torch.float64
        assert_close(x.detach(), y.detach(), rtol=1e-12, atol=1e-12 * float(y.detach().norm()))
