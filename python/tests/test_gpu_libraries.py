# OpenMM-VRATTLE: tests that the libraries for CUDA and HIP are loaded where OpenMM has these platforms, without a GPU.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import openmm.version
import pytest

# `make test` downloads OpenMM's packages for GPUs to this folder, and does not install them: without a driver they
# cannot be loaded.
WHEELS = Path(sys.prefix) / "gpu-wheels"

SCRIPT = """
import sys, openmm
openmm.Platform.loadPluginLibrary(sys.argv[1])
import openmmvrattle
print(openmm.Platform.getPlatform(openmm.Platform.getNumPlatforms() - 1).getName(), openmmvrattle.pluginLoadFailures)
loaded = [line.split()[-1] for line in open("/proc/self/maps") if "OpenMMVRattle" in line]
print(" ".join(sorted(set(loaded))))
"""


@pytest.mark.parametrize("package", ["openmm_cuda_12", "openmm_cuda_13", "openmm_hip_6", "openmm_hip_7"])
def test_the_library_is_loaded(package: str, tmp_path: Path) -> None:
    """One library of ours serves all versions; the driver's libraries are empty ones here, and nothing is computed."""
    compiler = shutil.which("g++") or shutil.which("c++")
    wheels = sorted(WHEELS.glob(f"{package}-*.whl"))
    if not wheels or compiler is None or sys.platform != "linux":
        pytest.skip(f"there is no wheel of {package} in {WHEELS}, or no compiler")
    zipfile.ZipFile(wheels[0]).extractall(tmp_path)
    platform = "CUDA" if "cuda" in package else "HIP"
    (library,) = tmp_path.glob(f"**/libOpenMM{platform}.so")
    needed = re.findall(rb"lib(?:cuda|cufft|nvrtc|hiprtc|amdhip64)\.so[.0-9]*", library.read_bytes())
    assert needed
    for name in {each.decode() for each in needed}:
        empty = tmp_path / "empty.cpp"
        empty.write_text("")
        subprocess.run(
            [compiler, "-shared", "-fPIC", str(empty), f"-Wl,-soname,{name}", "-o", str(tmp_path / name)], check=True
        )
    folders = [str(tmp_path), str(library.parent), openmm.version.openmm_library_path]
    environment = os.environ | {"LD_LIBRARY_PATH": os.pathsep.join(folders)}
    result = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(library)], env=environment, capture_output=True, text=True, cwd=tmp_path
    )
    print(result.stdout, result.stderr)
    first, second = result.stdout.splitlines()[-2:]
    assert first == f"{platform} []"
    assert f"libOpenMMVRattle{platform}.so" in second
