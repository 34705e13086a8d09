# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The command ``info``: versions, platforms, and what is wrong with the installation."""

from __future__ import annotations

import argparse
import contextlib
import functools
import importlib.metadata
import json
import os
import platform
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import openmm

import openmmvrattle

_PACKAGES = ("numpy", "matplotlib", "rich", "distributed", "pandas")


def add_parser(commands: Any) -> None:
    """Add the command to the command line."""
    parser = commands.add_parser(
        "info",
        help="versions, platforms, and what is wrong with the installation",
        description="Show versions, on which platforms the integrators run, and libraries that could not be loaded. "
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
    with _standard_output_to_error():
        found = {
            each.getName(): {name: _problem(make, each) for name, make in _integrators().items()} for each in platforms
        }
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


def _integrators() -> dict[str, Callable[[], openmm.Integrator]]:
    """What can be tried on a platform."""

    def make(name: str) -> openmm.Integrator:
        return getattr(openmmvrattle, name)(0.001)

    names = ("VariableStepRattleIntegrator", "CustomVariableStepRattleIntegrator")
    return {name: functools.partial(make, name) for name in names}


def _problem(make: Callable[[], openmm.Integrator], on: openmm.Platform) -> str | None:
    """Let two bonded particles take a step; None if they do, otherwise what OpenMM says."""
    system = openmm.System()
    for _ in range(2):
        system.addParticle(1.0)
    system.addConstraint(0, 1, 0.1)
    try:
        integrator = make()
        context = openmm.Context(system, integrator, on)
        context.setPositions([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
        context.setVelocities([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
        integrator.step(1)
    except Exception as error:
        return " ".join(str(error).split()) or type(error).__name__
    return None


def _print(content: dict[str, Any]) -> None:
    print("Versions")
    _print_columns(content["versions"].items())
    print("\nWhere the integrators run")
    names = list(next(iter(content["platforms"].values()), {}))
    rows = [("platform", *names)]
    remarks = []
    for name, problems in content["platforms"].items():
        rows.append((name, *("yes" if problem is None else "no" for problem in problems.values())))
        remarks += [f"- {each} on {name}: {problem}" for each, problem in problems.items() if problem is not None]
    _print_columns(rows)
    if remarks:
        print("\nWhat OpenMM says where they do not")
    for remark in remarks:
        print(remark)
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
