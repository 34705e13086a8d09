# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Compile the device's program for NVIDIA GPUs, without one: python compile_kernels.py <PrintKernels>.

The compiler is NVRTC, which OpenMM uses too, of the package nvidia-cuda-nvrtc-cu12. Every kernel must compile for the
oldest and a newer architecture, and spill no register; "rare10" is the cluster that needs most, eight bonds on one
particle; "newton" is "large" with Newton's iteration behind the chord's. Where there is no NVRTC this ends with 77,
"skipped".
"""

from __future__ import annotations

import ctypes
import importlib.util
import re
import subprocess
import sys
from pathlib import Path

CONSTRAINT_AND_APPLIED_FORCE, MULTIPLIER_P_NORM = 3, 4
SEMI_EXPLICIT, EXPLICIT, AUTOMATIC, LANGEVIN = 0, 1, 3, 4
ARCHITECTURES = ("sm_70", "sm_90")
# Precision, monitor, update, graphs. The program for SemiExplicit has every kernel, and the largest.
CASES = (
    ("mixed", CONSTRAINT_AND_APPLIED_FORCE, SEMI_EXPLICIT, "common"),
    ("single", CONSTRAINT_AND_APPLIED_FORCE, SEMI_EXPLICIT, "common"),
    ("double", MULTIPLIER_P_NORM, SEMI_EXPLICIT, "common"),
    ("mixed", CONSTRAINT_AND_APPLIED_FORCE, SEMI_EXPLICIT, "large"),
    ("single", CONSTRAINT_AND_APPLIED_FORCE, EXPLICIT, "large"),
    ("double", CONSTRAINT_AND_APPLIED_FORCE, SEMI_EXPLICIT, "large"),
    ("mixed", CONSTRAINT_AND_APPLIED_FORCE, SEMI_EXPLICIT, "newton"),
    ("mixed", CONSTRAINT_AND_APPLIED_FORCE, SEMI_EXPLICIT, "dense"),
    ("mixed", CONSTRAINT_AND_APPLIED_FORCE, AUTOMATIC, "common"),
    ("single", CONSTRAINT_AND_APPLIED_FORCE, AUTOMATIC, "common"),
    ("double", CONSTRAINT_AND_APPLIED_FORCE, AUTOMATIC, "large"),
    ("mixed", CONSTRAINT_AND_APPLIED_FORCE, LANGEVIN, "common"),
    ("mixed", CONSTRAINT_AND_APPLIED_FORCE, LANGEVIN, "large"),
    ("double", CONSTRAINT_AND_APPLIED_FORCE, LANGEVIN, "dense"),
    *(
        (precision, CONSTRAINT_AND_APPLIED_FORCE, update, f"rare{graph}")
        for precision, update, graphs in (
            ("mixed", SEMI_EXPLICIT, (5, 10)),
            ("double", SEMI_EXPLICIT, (8, 9, 10, 11)),
            ("mixed", AUTOMATIC, (7, 10)),
            ("mixed", LANGEVIN, (3, 8, 10)),
        )
        for graph in graphs
    ),
    ("mixed", CONSTRAINT_AND_APPLIED_FORCE, SEMI_EXPLICIT, "expressions"),
    ("single", CONSTRAINT_AND_APPLIED_FORCE, EXPLICIT, "expressions"),
    ("mixed", CONSTRAINT_AND_APPLIED_FORCE, AUTOMATIC, "expressions"),
    ("mixed", CONSTRAINT_AND_APPLIED_FORCE, LANGEVIN, "expressions"),
)

# What OpenMM's own text at the beginning of every program defines, as far as ours needs it.
PRELUDE = """
#define KERNEL extern "C" __global__
#define DEVICE __device__
#define LOCAL __shared__
#define LOCAL_ARG
#define GLOBAL
#define RESTRICT __restrict__
#define LOCAL_ID threadIdx.x
#define LOCAL_SIZE blockDim.x
#define GLOBAL_ID (blockIdx.x*blockDim.x+threadIdx.x)
#define GLOBAL_SIZE (blockDim.x*gridDim.x)
#define GROUP_ID blockIdx.x
#define NUM_GROUPS gridDim.x
#define SYNC_THREADS __syncthreads();
typedef long long mm_long;
typedef unsigned long long mm_ulong;
typedef REAL real;
typedef REAL4 real4;
typedef MIXED mixed;
typedef MIXED4 mixed4;
inline __device__ float4 makeFour(float x, float y, float z, float w) { return make_float4(x, y, z, w); }
inline __device__ double4 makeFour(double x, double y, double z, double w) { return make_double4(x, y, z, w); }
#define make_real4(x, y, z, w) makeFour((real) (x), (real) (y), (real) (z), (real) (w))
#define make_mixed4(x, y, z, w) makeFour((mixed) (x), (mixed) (y), (mixed) (z), (mixed) (w))
"""
TYPES = {
    "single": {"REAL": "float", "REAL4": "float4", "MIXED": "float", "MIXED4": "float4"},
    "mixed": {"REAL": "float", "REAL4": "float4", "MIXED": "double", "MIXED4": "double4", "USE_MIXED_PRECISION": "1"},
    "double": {"REAL": "double", "REAL4": "double4", "MIXED": "double", "MIXED4": "double4"},
}


def find_nvrtc() -> Path | None:
    """The library of the package nvidia-cuda-nvrtc-cu12, or None."""
    spec = importlib.util.find_spec("nvidia")
    for folder in (spec.submodule_search_locations if spec else None) or []:
        for library in sorted(Path(folder).glob("cuda_nvrtc/lib/libnvrtc.so.1[0-9]")):
            return library
    return None


def compile_text(nvrtc: ctypes.CDLL, text: str, architecture: str) -> str:
    """Compile and return the compiler's report; raises where it does not compile."""
    program = ctypes.c_void_p()
    nvrtc.nvrtcCreateProgram(ctypes.byref(program), text.encode(), b"kernels.cu", 0, None, None)
    options = [f"--gpu-architecture={architecture}".encode(), b"--use_fast_math", b"--ptxas-options=-v"]
    result = nvrtc.nvrtcCompileProgram(program, len(options), (ctypes.c_char_p * len(options))(*options))
    size = ctypes.c_size_t()
    nvrtc.nvrtcGetProgramLogSize(program, ctypes.byref(size))
    log = ctypes.create_string_buffer(size.value)
    nvrtc.nvrtcGetProgramLog(program, log)
    nvrtc.nvrtcDestroyProgram(ctypes.byref(program))
    if result != 0:
        raise RuntimeError(log.value.decode())
    return log.value.decode()


def main(print_kernels: str) -> int:
    library = find_nvrtc()
    if library is None:
        print('skipped: there is no NVRTC; pip install "nvidia-cuda-nvrtc-cu12"')
        return 77
    nvrtc = ctypes.CDLL(str(library))
    num_failed = 0
    for precision, monitor, update, graphs in CASES:
        text = subprocess.run(
            [print_kernels, precision, str(monitor), str(update), graphs], check=True, capture_output=True, text=True
        ).stdout
        defines = "".join(f"#define {name} {value}\n" for name, value in TYPES[precision].items())
        for architecture in ARCHITECTURES:
            report = compile_text(nvrtc, defines + PRELUDE + text, architecture)
            kernels = re.findall(
                r"properties for (\w+)\n\D*(\d+) bytes stack frame, (\d+) bytes spill stores.*\n.*Used (\d+) registers",
                report,
            )
            expected = {"finishStep", "advanceStep"}
            if graphs == "newton":
                expected |= {"advanceByNewton", "tryByNewton"}
            if graphs == "expressions":
                expected |= {"advanceExpressions", "moveExpressions"}
                expected |= {"judgeJump"} if update != LANGEVIN else set()
            assert expected <= {kernel[0] for kernel in kernels}, report
            for name, stack, spills, registers in kernels:
                # The sines of expressions have arrays of their own.
                failed = int(spills) > 0 or (int(stack) > 0 and not name.endswith("Expressions"))
                num_failed += failed
                print(
                    f"{'FAILED' if failed else 'passed'}: {precision} update {update} {graphs} {architecture} {name}: "
                    f"{registers} registers, {spills} bytes of spills, {stack} bytes of stack"
                )
    print(f"{num_failed} failed")
    return 1 if num_failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
