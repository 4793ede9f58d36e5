"""Run the tests that claim equality of bits or tokens (marker `bits`) under four kinds of CPU kernels:
`python scripts/cpus.py [words for pytest]`. A line per kind; the exit status is 1 if a test fails or no kind can run.

OpenBLAS, numpy, PyTorch, oneDNN, MKL and numba choose their kernels by the CPU, and the last bits of their sums differ.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CAPABILITIES = ("DEFAULT", "AVX2", "AVX512")  # PyTorch's on x86-64; each includes those before it
VARIABLES = (
    "OPENBLAS_CORETYPE",  # its builds for numpy take Haswell's kernels for Zen, SkylakeX's for all newer ones of Intel
    "NPY_DISABLE_CPU_FEATURES",  # names of numpy 2.4
    "ATEN_CPU_CAPABILITY",
    "ONEDNN_MAX_CPU_ISA",
    "MKL_CBWR",
    "NUMBA_CPU_NAME",
    "NUMBA_CPU_FEATURES",
)
_AVX512 = "X86_V4 AVX512_ICL AVX512_SPR"
_AVX2 = "+avx2,+avx,+fma,+f16c,+sse4.2,+popcnt"
_SKYLAKE = f"{_AVX2},+avx512f,+avx512bw,+avx512cd,+avx512dq,+avx512vl"
KERNELS = {  # values of the variables; "" leaves the choice to the library
    "avx512": ("SkylakeX", "", "avx512", "AVX512_CORE", "", "skylake-avx512", _SKYLAKE),
    "mixed": ("Zen", "", "avx512", "AVX512_CORE", "", "", ""),
    "avx2": ("Haswell", _AVX512, "avx2", "AVX2", "", "haswell", _AVX2),
    "sse4": ("Nehalem", f"X86_V3 {_AVX512}", "default", "SSE41", "COMPATIBLE", "nehalem", "+sse4.2,+popcnt"),
}


def capabilities() -> tuple[str, ...]:
    """What PyTorch finds in this machine."""
    if platform.machine() not in ("x86_64", "AMD64"):
        return ()
    import torch

    return CAPABILITIES[: CAPABILITIES.index(torch.backends.cpu.get_cpu_capability()) + 1]


def passes(name: str, variables: dict[str, str]) -> bool:
    """Runs the tests and prints a line, before it what a failure printed."""
    command = [sys.executable, "-m", "pytest", "-m", "bits", *sys.argv[1:]]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | variables, capture_output=True, text=True, check=False)
    *before, last = (done.stdout + done.stderr).strip().splitlines() or [f"status {done.returncode}"]
    if done.returncode:
        print(*before, sep="\n")
    print(f"{name:7} {last}, with {' '.join(f'{key}={value!r}' for key, value in variables.items())}", flush=True)
    return done.returncode == 0


def main() -> int:
    """The exit status."""
    for variable in VARIABLES:
        os.environ.pop(variable, None)
    here, passed = capabilities(), []
    for name, values in KERNELS.items():
        variables = {key: value for key, value in zip(VARIABLES, values, strict=True) if value}
        needed = variables["ATEN_CPU_CAPABILITY"].upper()
        if needed in here:
            passed.append(passes(name, variables))
        else:
            print(f"{name:7} not run: needs {needed}, this machine has {', '.join(here) or platform.machine()}")
    return int(not passed or not all(passed))


if __name__ == "__main__":
    sys.exit(main())
