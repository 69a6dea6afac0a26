"""Arrays with loops against torch, by an interpreter and by compiled code; what does not fit for every size is refused."""

from __future__ import annotations

import ctypes
import math
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.extensions.native.codegen.interpreter import Interpreter
from torchmbd.extensions.native.codegen.array import Array, Table
from torchmbd.extensions.native.codegen.emit import PRELUDE
from torchmbd.extensions.native.codegen.module import Module
from torchmbd.extensions.native.codegen.pieces import Pieces
from torchmbd.extensions.native.codegen.program import Program, Write
from torchmbd.extensions.native.codegen.segment_sum import SymbolicSegmentSum
from torchmbd.extensions.native.codegen.size import Size, Untraceable, constant_index, loop_index
from torchmbd.math import rotation
from torchmbd.math.pair import cat, contract, cross, matmul, matvec
from torchmbd.multibody.equations.index_maps import SegmentSum

N, M, K = Size("N"), Size("M"), Size("K")
SIZES = {"N": 4, "M": 3, "K": 6}
BODY = [0, 2, 1, 3, 3, 0]  # of each of K
GROUP = [0, 2, -1, 3, 3, 0]
SHAPES = {"p": (4, N), "q": (M, N), "C": (3, 3, M, M, N), "x": (3, K)}


def inputs(program: Program) -> dict[str, Any]:
    return {name: Array.input(program, name, shape)[..., None, None] for name, shape in SHAPES.items()}


def numbers(seed: int = 0) -> dict[str, Tensor]:
    make = torch.Generator().manual_seed(seed)

    def size(n: Any) -> int:
        return n if isinstance(n, int) else SIZES[str(n)[2:]]

    return {
        name: torch.rand(*map(size, shape), 1, 1, generator=make, dtype=torch.float64) - 0.5
        for name, shape in SHAPES.items()
    }


class Tables:
    """Tables and sums of segments, traced or of torch."""

    def __init__(self, traced: bool):
        self.body = Table("body", K) if traced else torch.tensor(BODY)
        self.sum: Any = SymbolicSegmentSum(Table("group", K), N) if traced else SegmentSum(GROUP, SIZES["N"])
        self.n: Any = N if traced else SIZES["N"]


FUNCTIONS: dict[str, Callable[..., Any]] = {
    "rotations": lambda t, p, q, C, x: rotation.rotation_matrix(p),
    "contractions": lambda t, p, q, C, x: contract(C, q, 3) + contract(C, q, 2).transpose(0, 1),
    "sums of sums": lambda t, p, q, C, x: contract(contract(C, q, 3), q, 2),
    "what does not depend": lambda t, p, q, C, x: (q * 0.0 + p[0]).sum(0),
    "a gather": lambda t, p, q, C, x: matvec(rotation.rotation_matrix(p).index_select(2, t.body), x),
    "segments": lambda t, p, q, C, x: t.sum(cross(x, p[1:].index_select(1, t.body))),
    "one of two modes": lambda t, p, q, C, x: matmul(C[:, :, 0], C[:, :, 1]) * q[1:2],
    "joined": lambda t, p, q, C, x: cat([x * x, p[:3] + q.sum(0)], 1).flatten(0, 1).unflatten(0, (3, -1)),
    "cut": lambda t, p, q, C, x: cat([p[:3], x], 1)[:, t.n :] * 2.0,
    "flat": lambda t, p, q, C, x: cat([p.flatten(0, 1), q.flatten(0, 1)]) * p[:1, :1, None].sum(1)[0, 0],
    "functions": lambda t, p, q, C, x: torch.where(p > 0.1, torch.sqrt(p * p + 1.0), torch.atan2(p, p + 2.0)).clamp(
        -0.5, 0.5
    ),
}


def traced(f: Callable[..., Any]) -> tuple[Program, list[Write]]:
    program = Program([M])
    x = f(Tables(True), **inputs(program))
    program.buffer("out", 0, "output")
    parts = x.as_array() if isinstance(x, Pieces) else x
    writes = []
    for k in np.ndindex(*parts.numbers.shape):
        index = constant_index(0)
        for i, n, v in zip(k, parts.shape, parts.loops, strict=True):
            index = index.times(n).plus(loop_index(v) if v is not None else i)
        writes.append(Write("out", program.loops(parts.variables, index), index, int(parts.numbers[k]), False))
    return program, writes


@pytest.mark.parametrize("name", FUNCTIONS)
def test_programs_compute_what_torch_does(name: str) -> None:
    f, given = FUNCTIONS[name], numbers()
    program, writes = traced(f)
    expected = f(Tables(False), **given)
    tables = {"body": BODY, "group": [SIZES["N"] if g < 0 else g for g in GROUP]}
    result = Interpreter(program, SIZES, tables, given).run(writes, {"out": expected.numel()})["out"]
    np.testing.assert_allclose(result, expected.flatten().numpy(), rtol=1e-13, atol=1e-14)


@pytest.mark.thorough
@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")
def test_compiled_functions_compute_lanes(tmp_path: Path) -> None:
    """All functions in one library; a nan stays in its lane."""
    lanes = [numbers(seed) for seed in range(8)]
    lanes[5]["p"][0] = math.nan
    folded = [SIZES["N"] if g < 0 else g for g in GROUP]
    tables = np.array(BODY, dtype=np.intc), np.array(folded, dtype=np.intc)
    for name, f in FUNCTIONS.items():
        program, writes = traced(f)
        module = Module(program, [])
        module.values["f"] = writes
        fields = "".join(f"const V* {x}; " for x in SHAPES)
        head = "struct N { long N, M, K; };\nstruct Tables { const int *body, *group; };\n"
        head += f"struct In {{ N n; Tables tables; V* w; const long* o; {fields} V* out; }};\n"
        call = 'extern "C" long call(In* in) { long o[BUFFERS]; const long size = layout(in->n, o); in->o = o;'
        call += " if (in->w) f(*in); return size; }"
        (tmp_path / "f.cpp").write_text("\n".join([PRELUDE, head, module.text(), call]))
        result = tmp_path / f"{abs(hash(name))}.so"
        options = ["-DLANES=8", "-O1", "-std=c++17", "-march=native", "-shared", "-fPIC"]
        subprocess.run(["g++", *options, "-o", str(result), str(tmp_path / "f.cpp")], check=True)
        code = ctypes.CDLL(str(result))
        code.call.restype = ctypes.c_long
        expected = [f(Tables(False), **given) for given in lanes]
        given = [torch.cat([x[k] for x in lanes], -1).contiguous() for k in SHAPES]
        out = torch.zeros(*expected[0].shape[:-1], 8, dtype=torch.float64)
        pointers = [x.ctypes.data for x in tables] + [0, 0] + [x.data_ptr() for x in given] + [out.data_ptr()]
        arguments = (ctypes.c_long * (3 + len(pointers)))(*SIZES.values(), *pointers)
        room = torch.empty(8 * code.call(arguments) + 8, dtype=torch.float64)
        arguments[5] = room.data_ptr() + -room.data_ptr() % 64
        code.call(arguments)
        for lane, x in enumerate(expected):
            torch.testing.assert_close(out[..., lane : lane + 1], x, rtol=1e-12, atol=1e-13, equal_nan=True, msg=name)


@pytest.mark.parametrize(
    "f",
    [
        lambda t, p, q, C, x: p[:3] + x,
        lambda t, p, q, C, x: p.argmax(0),
        lambda t, p, q, C, x: x.unflatten(1, (2, -1)),
        lambda t, p, q, C, x: p.index_select(0, t.body),
        lambda t, p, q, C, x: x[:, ::2],
    ],
)
def test_what_does_not_fit_for_every_size_is_refused(f: Callable[..., Any]) -> None:
    with pytest.raises((Untraceable, AttributeError)):
        traced(f)
