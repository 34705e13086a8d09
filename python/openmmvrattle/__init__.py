# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Time-reversible variable-step integration of molecular dynamics with constraints, for OpenMM.

>>> import openmm
>>> from openmmvrattle import VariableStepRattleIntegrator
>>> integrator = VariableStepRattleIntegrator(0.002)
>>> context = openmm.Context(system, integrator)  # doctest: +SKIP

Importing this package loads its libraries into OpenMM. A library that could not be loaded is named in
`pluginLoadFailures`; the package then works on the other platforms. CustomVariableStepRattleIntegrator is written in
Python alone and works on every platform, also where the compiled part of this package cannot be loaded at all; then
VariableStepRattleIntegrator raises an OpenMMException that says why.
"""

import importlib.metadata
from pathlib import Path
from typing import TYPE_CHECKING

import openmm
import openmm.version

from . import constraints
from .custom import ConstraintWarning, CustomVariableStepRattleIntegrator
from .serialization import XmlSerializer

if TYPE_CHECKING:
    from .compare.advice import advise
    from .integrators import VariableStepRattleIntegrator, VariableStepRattleLangevinIntegrator

__all__ = [
    "ConstraintWarning",
    "CustomVariableStepRattleIntegrator",
    "VariableStepRattleIntegrator",
    "VariableStepRattleLangevinIntegrator",
    "XmlSerializer",
    "advise",
    "constraints",
    "pluginLoadFailures",
]
# What of these needs the compiled part of the package.
_COMPILED = ("VariableStepRattleIntegrator", "VariableStepRattleLangevinIntegrator", "advise")

# The platforms that each of our libraries serves. The CPU platform runs the kernels of Reference.
_PLATFORMS_OF_LIBRARY: dict[str, tuple[str, ...]] = {
    "OpenMMVRattleReference": ("Reference", "CPU"),
    "OpenMMVRattleOpenCL": ("OpenCL",),
    "OpenMMVRattleCUDA": ("CUDA",),
    "OpenMMVRattleHIP": ("HIP",),
}


def _check_openmm_version(built: str, running: str) -> None:
    """Raise an OpenMMException if code built for OpenMM `built` cannot run with OpenMM `running`.

    OpenMM's C++ interface changes with its minor version, and code made for another one crashes.
    """
    if running.split(".")[:2] != built.split(".")[:2]:
        needed = ".".join(built.split(".")[:2])
        raise openmm.OpenMMException(
            f"openmmvrattle was built for OpenMM {built} and cannot run with OpenMM {running}: "
            f'install the one it was built for (pip install "openmm=={needed}.*"), '
            "or a version of openmm-vrattle for the one you have."
        )


def _load_plugins(folder: Path) -> list[str]:
    """Load our libraries in `folder` for the platforms that OpenMM has, and return what went wrong.

    `Platform.loadPluginsFromDirectory` would load libraries for platforms that are not there as well, and would forget
    OpenMM's own list of failures.
    """
    registered = {openmm.Platform.getPlatform(i).getName() for i in range(openmm.Platform.getNumPlatforms())}
    failures = []
    for library, platforms in _PLATFORMS_OF_LIBRARY.items():
        if registered.isdisjoint(platforms):
            continue
        files = sorted(folder.glob(f"*{library}.*"))
        if not files:
            failures.append(f"There is no library {library} in {folder}.")
        for file in files[:1]:
            try:
                openmm.Platform.loadPluginLibrary(str(file))
            except Exception as error:  # whatever it is, the other platforms can still be used
                failures.append(f"{file}: {error}")
    return failures


def _load_compiled_part() -> list[str]:
    """Import what was compiled, put it into this module, and return what went wrong with its libraries."""
    from . import _build

    _check_openmm_version(_build.OPENMM_VERSION, openmm.version.short_version)
    from . import _vrattle
    from .integrators import VariableStepRattleIntegrator, VariableStepRattleLangevinIntegrator

    globals()["VariableStepRattleIntegrator"] = VariableStepRattleIntegrator
    globals()["VariableStepRattleLangevinIntegrator"] = VariableStepRattleLangevinIntegrator
    # Found from the extension: in an editable install the Python files lie somewhere else.
    failures = _load_plugins(Path(_vrattle.__file__).parent / "lib" / "plugins")
    from .compare.advice import advise

    globals()["advise"] = advise
    return failures


if not TYPE_CHECKING:  # a type checker would take every name for granted

    def __getattr__(name: str) -> object:
        """Say why there is no VariableStepRattleIntegrator."""
        if name in _COMPILED:
            raise openmm.OpenMMException(_compiled_part_failure)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _version() -> str:
    """The version that this copy was built as, or what the installer knows where nothing was built."""
    try:
        from ._build import VERSION
    except ImportError:
        try:
            return importlib.metadata.version("openmm-vrattle")
        except importlib.metadata.PackageNotFoundError:
            return "unknown"
    return VERSION


__version__: str = _version()
_compiled_part_failure = ""
try:
    pluginLoadFailures: list[str] = _load_compiled_part()
except (ImportError, OSError, openmm.OpenMMException) as error:
    _compiled_part_failure = (
        f"There is no VariableStepRattleIntegrator, as the compiled part of openmmvrattle cannot be used: {error} "
        "CustomVariableStepRattleIntegrator, which is written in Python alone, can be used."
    )
    pluginLoadFailures = [_compiled_part_failure]
    # Written so that type checkers, which read __all__, take the class for granted.
    globals()["__all__"] = [name for name in __all__ if name not in _COMPILED]
