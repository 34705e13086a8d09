# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Time-reversible variable-step integration of molecular dynamics with constraints, for OpenMM.

>>> import openmm
>>> from openmmvrattle import VariableStepRattleIntegrator
>>> integrator = VariableStepRattleIntegrator(0.002)
>>> context = openmm.Context(system, integrator)  # doctest: +SKIP

Importing this package loads its libraries into OpenMM. A library that could not be loaded is named in
`pluginLoadFailures`; the package then works on the other platforms.
"""

from pathlib import Path

import openmm
import openmm.version

from . import _build

__all__ = ["VariableStepRattleIntegrator", "XmlSerializer", "advise", "pluginLoadFailures"]
__version__: str = _build.VERSION

# The platforms that each of our libraries serves. The CPU platform runs the kernels of Reference.
_PLATFORMS_OF_LIBRARY: dict[str, tuple[str, ...]] = {"OpenMMVRattleReference": ("Reference", "CPU")}


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


_check_openmm_version(_build.OPENMM_VERSION, openmm.version.short_version)

from . import _vrattle  # noqa: E402
from .serialization import XmlSerializer  # noqa: E402
from .vrattle import VariableStepRattleIntegrator  # noqa: E402

# Found from the extension: in an editable install the Python files lie somewhere else.
pluginLoadFailures: list[str] = _load_plugins(Path(_vrattle.__file__).parent / "lib" / "plugins")

from .advice import advise  # noqa: E402 (it uses what is above)
