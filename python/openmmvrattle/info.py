# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The command ``info``: versions, what each platform can do, and what is wrong with the installation.

What it says of a platform it finds out by trying: a small system takes steps there, and the integrator tells by what.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.metadata
import json
import os
import platform
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import openmm

import openmmvrattle

from .platforms import make_context

_PACKAGES = ("numpy", "matplotlib", "rich", "distributed", "pandas")
_VERSION = ".".join(openmm.Platform.getOpenMMVersion().split(".")[:2])
_BROUGHT_BY = {"CUDA": f'"openmm[cuda12]=={_VERSION}.*" or [cuda13]', "HIP": f'"openmm[hip6]=={_VERSION}.*" or [hip7]'}
"""What pip installs for a platform that the package openmm does not have by itself."""
_GPUS = {"CUDA", "HIP", "OpenCL"}
_STEPS = 60
"""To take in a trial. Automatic step control looks at the first 30 before it does anything."""


@dataclass(frozen=True)
class _Use:
    """A use of an integrator, to be tried on each platform."""

    integrator: str
    make: Callable[[], Any]
    prepare_step: Callable[[Any, int], None] | None = None
    """Called with the integrator and the number of each step, if that is to be taken by itself."""


def add_parser(commands: Any) -> None:
    """Add the command to the command line."""
    parser = commands.add_parser(
        "info",
        help="versions, what each platform can do, and what is wrong with the installation",
        description="Show versions, on which platforms the integrators run and what takes their steps there, and "
        "libraries that could not be loaded. "
        "The exit status is 0 if the integrators run on all platforms that have a device, and 1 otherwise.",
    )
    parser.set_defaults(run=run)
    parser.add_argument("--json", action="store_true", help="write it as JSON")


def run(options: argparse.Namespace) -> int:
    """Carry the command out and return the exit code."""
    content = information()
    if options.json:
        print(json.dumps(content, indent=2))
    else:
        _print(content)
    return 0 if content["healthy"] else 1


def information() -> dict[str, Any]:
    """Find out everything that the command shows."""
    platforms = [openmm.Platform.getPlatform(index) for index in range(openmm.Platform.getNumPlatforms())]
    found: dict[str, dict[str, str | None]] = {}
    steps: dict[str, dict[str, str | None]] = {}
    with _standard_output_to_error():
        for each in platforms:
            tried = {name: _try(use, each.getName()) for name, use in _uses().items()}
            steps[each.getName()] = {name: where for name, (_, where) in tried.items()}
            problems = found.setdefault(each.getName(), {})
            for name, use in _uses().items():
                problems[use.integrator] = problems.get(use.integrator) or tried[name][0]
    failures = {
        "OpenMM-VRATTLE": list(openmmvrattle.pluginLoadFailures),
        "OpenMM": list(openmm.Platform.getPluginLoadFailures()),
    }
    ours = "VariableStepRattleIntegrator"
    promised = {name for names in openmmvrattle._PLATFORMS_OF_LIBRARY.values() for name in names}
    # Where nothing runs, as on a platform without a device, it is not for us.
    usable = {name for name in promised & set(found) if None in found[name].values()}
    works = "Reference" in found and all(found[name][ours] is None for name in usable | {"Reference"})
    return {
        "healthy": works and not failures["OpenMM-VRATTLE"],
        "versions": _versions(),
        "platforms": found,
        "steps": steps,
        "platforms_not_here": sorted(promised - set(found)),
        "plugin_load_failures": failures,
        "folder": str(next(iter(openmmvrattle.__path__))),
    }


@contextlib.contextmanager
def _standard_output_to_error() -> Iterator[None]:
    """Keep what a platform prints, such as OpenCL's warning of an untried driver, out of what this command prints."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def _versions() -> dict[str, str]:
    versions = {
        "openmm-vrattle": openmmvrattle.__version__,
        "built for OpenMM": _built_for(),
        "OpenMM": openmm.Platform.getOpenMMVersion(),
        "Python": platform.python_version(),
        "SWIG runtime": _swig_runtime(),
        "system": f"{platform.system()} {platform.machine()}",
    }
    for package in _PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return versions


def _built_for() -> str:
    try:
        from . import _build
    except ImportError:
        return "nothing was built"
    return _build.OPENMM_VERSION


def _swig_runtime() -> str:
    """The SWIG runtimes in use: OpenMM's wrapper and ours understand each other if there is only one."""
    found = sorted(re.findall(r"swig_runtime_data(\d+)", " ".join(sys.modules)))
    return " and ".join(found) or "unknown"


def _uses() -> dict[str, _Use]:
    """What is tried on a platform, by the heading of its column."""

    def variable(**settings: Any) -> Any:
        return openmmvrattle.VariableStepRattleIntegrator(0.001, **settings)

    def with_expression() -> Any:
        integrator = variable(automatic=True)
        integrator.addConstraint("z1", [2])
        return integrator

    def with_height() -> Any:
        integrator = variable()
        integrator.addConstraint("z1-height", [2], {"height": 0.0})
        return integrator

    def lift(integrator: Any, step: int) -> None:
        integrator.setExpressionParameterValue(0, "height", 0.0001 * step)

    ours, langevin = "VariableStepRattleIntegrator", "VariableStepRattleLangevinIntegrator"
    custom = "CustomVariableStepRattleIntegrator"
    return {
        "monitors": _Use(ours, variable),
        "automatic": _Use(ours, lambda: variable(automatic=True)),
        "expressions": _Use(ours, with_expression),
        "moving expressions": _Use(ours, with_height, lift),
        "constant temperature": _Use(langevin, lambda: getattr(openmmvrattle, langevin)(300, 1, 0.001)),
        "Python alone": _Use(custom, lambda: getattr(openmmvrattle, custom)(0.001)),
    }


def _try(use: _Use, on: str) -> tuple[str | None, str | None]:
    """Let a rigid pair of particles and a third one take steps.

    Returns:
        What OpenMM says if they do not, or None; and what takes the steps, "device" or "host", or None.
    """
    system = openmm.System()
    for _ in range(3):
        system.addParticle(1.0)
    system.addConstraint(0, 1, 0.1)
    try:
        integrator = use.make()
        context = make_context(system, integrator, on)
        context.setPositions([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 1.0, 0.0]])
        context.setVelocities([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
        if use.prepare_step is None:
            integrator.step(_STEPS)
        else:
            for step in range(_STEPS):
                use.prepare_step(integrator, step)
                integrator.step(1)
        if not isinstance(integrator, openmm.CustomIntegrator):
            return None, "device" if integrator.isOnDevice() else "host"
    except Exception as error:
        return " ".join(str(error).split()) or type(error).__name__, None
    return None, "device"


def _print(content: dict[str, Any]) -> None:
    print("Versions")
    _print_columns(content["versions"].items())
    _print_platforms(content)
    for whose, failures in content["plugin_load_failures"].items():
        if failures:
            print(f"\nLibraries of {whose} that could not be loaded")
        for failure in failures:
            print(f"- {' '.join(failure.split())}")
        if failures and whose == "OpenMM":
            print("They matter only for the platforms that they belong to.")
    if content["healthy"]:
        print("\nAll is well.")
    else:
        print(
            "\nSomething is wrong: install the package anew (pip install --force-reinstall openmm-vrattle); it lies in "
            f"{content['folder']}."
        )


def _print_columns(rows: Iterable[Sequence[str]]) -> None:
    """Print cells below each other."""
    rows = list(rows)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        print("  " + "  ".join(cells).rstrip())


def _print_platforms(content: dict[str, Any]) -> None:
    print("\nWhat takes the steps of the integrators")
    names = list(next(iter(content["steps"].values()), {}))
    rows = [("platform", *names)]
    for platform_name, steps in content["steps"].items():
        # Reference and CPU have no device beside the host.
        cells = {"host": "host", "device": "GPU"} if platform_name in _GPUS else {"host": "yes", "device": "yes"}
        rows.append((platform_name, *(cells.get(steps[name], "no") for name in names)))
    _print_columns(rows)
    if _GPUS & set(content["steps"]):
        print("  host: by the processor, with forces from the GPU; that is slow for large systems.")
    problems = [
        f"- {integrator} on {platform_name}: {problem}"
        for platform_name, found in content["platforms"].items()
        for integrator, problem in found.items()
        if problem is not None
    ]
    if problems:
        print("\nWhat OpenMM says where they do not run")
    for line in problems:
        print(line)
    missing = content["platforms_not_here"]
    if missing:
        print("\nPlatforms that OpenMM does not have here")
    for name in missing:
        print(f"- {name}" + (f": pip install {_BROUGHT_BY[name]} brings it" if name in _BROUGHT_BY else ""))
