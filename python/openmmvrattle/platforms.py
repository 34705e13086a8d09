# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""OpenMM's platforms by name, with the precision that they compute in: ``"CPU"``, ``"CUDA"``, ``"CUDA:double"``.

A platform that has several precisions, as CUDA, HIP and OpenCL have, computes in ``mixed`` here unless the name says
otherwise. OpenMM's own choice is ``single``, in which the energy error is that of the rounding, whatever the steps.
"""

from __future__ import annotations

import argparse
from typing import Any

import openmm

__all__ = [
    "PRECISIONS",
    "add_platform_arguments",
    "command_line_platform",
    "make_context",
    "platform_and_properties",
    "platform_from",
    "platform_names",
]

PRECISIONS = ("single", "mixed", "double")
USUAL_PRECISION = "mixed"


def platform_names() -> list[str]:
    """The names of the platforms that OpenMM has here."""
    return [openmm.Platform.getPlatform(i).getName() for i in range(openmm.Platform.getNumPlatforms())]


def platform_and_properties(name: str) -> tuple[openmm.Platform, dict[str, str]]:
    """What a Context, or a Simulation, is made with.

    Args:
        name: of the platform, with a precision behind a colon if it is not to be the usual one.

    Raises:
        ValueError: if there is no such platform, or it has no such precision.
    """
    name, colon, precision = name.partition(":")
    if name not in platform_names():
        raise ValueError(f"there is no platform '{name}' here; choose among {', '.join(platform_names())}")
    platform = openmm.Platform.getPlatform(name)
    if "Precision" not in platform.getPropertyNames():
        if colon:
            raise ValueError(f"the platform {name} has no choice of precision; leave out '{precision}'")
        return platform, {}
    if colon and precision not in PRECISIONS:
        raise ValueError(f"there is no precision '{precision}'; choose among {', '.join(PRECISIONS)}")
    return platform, {"Precision": precision or USUAL_PRECISION}


def make_context(system: openmm.System, integrator: Any, platform: str) -> openmm.Context:
    """A Context on a platform.

    Args:
        system: what is simulated.
        integrator: by what.
        platform: as for `platform_and_properties`.
    """
    return openmm.Context(system, integrator, *platform_and_properties(platform))


def add_platform_arguments(parser: argparse.ArgumentParser, default: str) -> None:
    """Add the options ``--platform`` and ``--precision`` to a command line.

    Args:
        parser: of the command line.
        default: in words, what it is without them.
    """
    parser.add_argument("--platform", metavar="NAME", help=f"OpenMM's platform (default: {default})")
    parser.add_argument(
        "--precision",
        choices=PRECISIONS,
        help=f"of a platform that has a choice: CUDA, HIP, OpenCL (default: {USUAL_PRECISION})",
    )


def platform_from(options: argparse.Namespace, default: str) -> str:
    """The platform that the two options ask for, with its precision.

    Args:
        options: what was read from the command line.
        default: the platform where none is named.

    Raises:
        ValueError: if there is no such platform, or it has no such precision.
    """
    name = options.platform or default
    if options.precision is not None:
        name += f":{options.precision}"
    platform_and_properties(name)
    return name


def command_line_platform(default: str) -> tuple[openmm.Platform, dict[str, str]]:
    """What ``--platform`` and ``--precision`` ask for on the command line of a script that has no other options.

    Args:
        default: the platform where none is named.
    """
    parser = argparse.ArgumentParser()
    add_platform_arguments(parser, default)
    try:
        return platform_and_properties(platform_from(parser.parse_args(), default))
    except ValueError as error:
        parser.error(f"{error}.")
