# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Print where this Python's OpenMM, Eigen and SWIG are, as a CMake list of NAME=VALUE, without importing OpenMM.

Importing OpenMM would load every one of its platforms, GPU drivers included, only to ask for a path.
"""

import importlib.util
import re
import runpy
import sys
from pathlib import Path


def folder(package: str) -> Path | None:
    spec = importlib.util.find_spec(package)
    return Path(spec.origin).parent if spec and spec.origin else None


found: dict[str, object] = {}

openmm = folder("openmm")
if openmm is not None:
    version = runpy.run_path(str(openmm / "version.py"))
    libraries = Path(version["openmm_library_path"])
    found["OPENMM_VERSION"] = version["short_version"]
    found["OPENMM_LIBRARY_DIR"] = libraries.as_posix()
    found["OPENMM_INCLUDE_DIR"] = (libraries.parent / "include").as_posix()
    # SWIG modules share their types through a module whose name carries the version of SWIG's runtime.
    for extension in [*openmm.glob("_openmm*.so"), *openmm.glob("_openmm*.pyd")]:
        runtime = re.search(rb"swig_runtime_data(\d+)", extension.read_bytes())
        if runtime:
            found["OPENMM_SWIG_RUNTIME"] = runtime.group(1).decode()

# The package cmeel-eigen puts Eigen's headers into cmeel.prefix, beside the Python packages.
for path in sys.path:
    eigen = Path(path) / "cmeel.prefix" / "include" / "eigen3"
    if (eigen / "Eigen" / "Core").is_file():
        found.setdefault("EIGEN_INCLUDE_DIR", eigen.as_posix())

# The package swig is asked for by its own place: another swig may come first on the PATH.
swig = folder("swig")
if swig is not None:
    for library in (swig / "data" / "share" / "swig").glob("*/swigrun.swg"):
        found["SWIG_LIBRARY_DIR"] = library.parent.as_posix()
        found["SWIG_PROGRAM"] = next((swig / "data" / "bin").glob("swig*")).as_posix()

print(";".join(f"{name}={value}" for name, value in found.items()), end="")
