"""Kernels of CUDA C++: compiled by NVRTC, which comes with torch for CUDA, and launched on arrays of torch.

Compiling needs no device. What is loaded belongs to the device that is current then.
Checked in tests/integrators/test_kernel.py, where NVRTC and a device are there.
"""

from __future__ import annotations

import ctypes
import importlib.util
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import MbdError

SUFFIX = ".cubin"
THREADS = 32  # of a group: few lanes make groups for many processors


def library() -> ctypes.CDLL:
    """NVRTC, of the CUDA that torch was made for: of its packages, or of the system; MbdError if there is none."""
    spec, major = importlib.util.find_spec("nvidia"), (torch.version.cuda or "").partition(".")[0]
    folders = [Path(place) for place in (spec and spec.submodule_search_locations) or ()]
    own = [file for folder in folders for file in sorted(folder.glob(f"*/lib/libnvrtc.so.{major}*"))]
    for file in own:
        for part in file.parent.glob("libnvrtc-builtins.so.*"):  # which it asks for by name only
            ctypes.CDLL(str(part))
    for name in (*map(str, own), f"libnvrtc.so.{major}", "libnvrtc.so"):
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    raise MbdError("NVRTC is not there: no package of torch has it, and the system does not find libnvrtc.so")


def compile_kernel(text: str, architecture: str, to: Path) -> None:
    """Write the machine code for an architecture, such as "sm_90"; MbdError with what NVRTC says."""
    rtc, program, size = library(), ctypes.c_void_p(), ctypes.c_size_t()

    def done(result: int) -> None:
        if not result:
            return
        rtc.nvrtcGetProgramLogSize(program, ctypes.byref(size))
        log = ctypes.create_string_buffer(max(size.value, 1))
        rtc.nvrtcGetProgramLog(program, log)
        raise MbdError(f"NVRTC fails with {result}: {log.value.decode()[-2000:]}")

    done(rtc.nvrtcCreateProgram(ctypes.byref(program), text.encode(), b"march.cu", 0, None, None))
    options = [f"--gpu-architecture={architecture}".encode(), b"--std=c++17"]
    done(rtc.nvrtcCompileProgram(program, len(options), (ctypes.c_char_p * len(options))(*options)))
    done(rtc.nvrtcGetCUBINSize(program, ctypes.byref(size)))
    code = ctypes.create_string_buffer(size.value)
    done(rtc.nvrtcGetCUBIN(program, code))
    to.write_bytes(code.raw)


class Kernels:
    """Kernels of machine code, each of one array, by name."""

    def __init__(self, code: bytes, names: list[str]):
        from torch.cuda._utils import _cuda_load_module

        self._kernels: Any = _cuda_load_module(code, names)

    def __call__(self, name: str, argument: Tensor, lanes: int) -> None:
        """Launch a kernel with a thread for each lane."""
        self._kernels[name](grid=(-(-lanes // THREADS), 1, 1), block=(THREADS, 1, 1), args=[argument])
