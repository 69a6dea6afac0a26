"""Kernels of CUDA C++: compiled by NVRTC, which comes with torch for CUDA, and launched on arrays of torch.

Compiling needs no device. What is loaded belongs to the device that is current then.
Checked in tests/integrators/test_kernel.py, where NVRTC and a device are there.
"""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

from torch import Tensor

from torchmbd.errors import MbdError

SUFFIX = ".cubin"
THREADS = 32  # of a group: few lanes make groups for many processors


def compile_kernel(text: str, architecture: str, to: Path, rtc: Any = None) -> None:
    """Write the machine code for an architecture, such as "sm_90"; MbdError with what NVRTC says. rtc: its library."""
    if rtc is None:
        from torch.cuda._utils import _get_gpu_rtc_library

        rtc = _get_gpu_rtc_library()
    program, size = ctypes.c_void_p(), ctypes.c_size_t()

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
