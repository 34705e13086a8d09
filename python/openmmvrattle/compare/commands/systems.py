# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""What the commands have in common: which system is meant, on which platform, and errors in plain sentences."""

from __future__ import annotations

import argparse
import difflib
import inspect
import math
from collections.abc import Iterable
from pathlib import Path

from ...custom.settings import MONITOR_KINDS as MONITORS
from ...platforms import add_platform_arguments, platform_from, platform_names
from ...testsystems import SYSTEMS, MonitorSettings, TestSystem
from ..inputs import CONSTRAINTS, DEFAULT_FORCE_FIELD, InputError, from_pdb, from_xml

UPDATES = ("SemiExplicit", "Explicit", "Bounded")
"""The recursions of the step density."""
_LARGE = 500
"""Systems of the user's own with more particles than this run on the platform CPU by default."""


class UsageError(Exception):
    """Something on the command line cannot be done; the message says what, in one sentence."""


def add_system_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that say which system of the user's own is meant, and where it runs."""
    own = parser.add_argument_group("a system of your own")
    own.add_argument("--pdb", type=Path, metavar="FILE", help="a PDB file; with --xml only its positions are used")
    own.add_argument(
        "--forcefield",
        nargs="+",
        default=list(DEFAULT_FORCE_FIELD),
        metavar="NAME",
        help="force field for --pdb, as openmm.app.ForceField takes it (default: "
        + " ".join(DEFAULT_FORCE_FIELD)
        + ")",
    )
    own.add_argument(
        "--constraints",
        default="HBonds",
        type=str,
        metavar="NAME",
        help="bonds of --pdb that are rigid: " + ", ".join(CONSTRAINTS) + " (default: HBonds; water is always rigid)",
    )
    own.add_argument("--add-hydrogens", action="store_true", help="add hydrogen atoms that the PDB file lacks")
    own.add_argument("--cutoff", type=float, default=0.9, metavar="NM", help="cutoff of periodic --pdb (default: 0.9)")
    own.add_argument("--xml", type=Path, metavar="FILE", help="an OpenMM System, written by XmlSerializer")
    own.add_argument("--state", type=Path, metavar="FILE", help="an OpenMM State for --xml: positions and velocities")
    own.add_argument(
        "--temperature",
        type=float,
        default=300.0,
        metavar="K",
        help="of the velocities at the start, where there are none (default: 300)",
    )
    add_platform_arguments(parser, f"Reference; for your own systems of more than {_LARGE} particles CPU")


def chosen(name: str, names: Iterable[str], what: str) -> str:
    """The name as it is written in a list, whatever its case; an error names the nearest ones."""
    names = list(names)
    for candidate in names:
        if candidate.lower() == name.lower():
            return candidate
    near = difflib.get_close_matches(name.lower(), [n.lower() for n in names], n=3)
    if len(name) > 3:
        near += [n.lower() for n in names if name.lower() in n.lower()]
    suggestions = [n for n in names if n.lower() in near]
    if 0 < len(suggestions) <= 5:
        raise UsageError(f"there is no {what} '{name}'; did you mean {' or '.join(suggestions)}?")
    raise UsageError(f"there is no {what} '{name}'; choose among {', '.join(names)}.")


def has_own_system(options: argparse.Namespace) -> bool:
    """Whether a file with a system was given."""
    if options.state is not None and options.xml is None:
        raise UsageError("--state needs the System that belongs to it: give --xml SYSTEM.xml as well.")
    if not 0.0 <= options.temperature < math.inf:
        raise UsageError("the temperature must not be negative.")
    return options.pdb is not None or options.xml is not None


def own_system(options: argparse.Namespace, seed: int) -> tuple[TestSystem, str]:
    """The system from the files that were given, and the platform to run it on."""
    common = {"temperature": options.temperature, "seed": seed}
    platform = options.platform or _fast_platform()
    try:
        if options.xml is not None:
            system = from_xml(options.xml, options.state, options.pdb, platform=platform, **common)
        else:
            system = from_pdb(
                options.pdb,
                options.forcefield,
                chosen(options.constraints, CONSTRAINTS, "kind of constraints"),
                options.add_hydrogens,
                options.cutoff,
                platform=platform,
                **common,
            )
    except InputError as error:
        raise UsageError(str(error)) from error
    small = system.system.getNumParticles() <= _LARGE
    return system, options.platform or ("Reference" if small else platform)


def _fast_platform() -> str:
    return "CPU" if "CPU" in platform_names() else "Reference"


def named_system(name: str, seed: int | None) -> TestSystem:
    """One of our own systems; a seed changes its random start, if it has one."""
    build = SYSTEMS[chosen(name, SYSTEMS, "system")]
    return build() if seed is None or not has_seed(name) else build(seed=seed)


def has_seed(name: str) -> bool:
    """Whether one of our own systems has a random start."""
    return "seed" in inspect.signature(SYSTEMS[name]).parameters


def check_platform(options: argparse.Namespace) -> None:
    """Write the platform as OpenMM does, with the precision that it is to have, or raise a UsageError."""
    if options.platform is not None:
        options.platform = chosen(options.platform, platform_names(), "platform")
    if options.precision is not None:
        if options.platform is None:
            raise UsageError("--precision needs the platform that it is for: give --platform NAME as well.")
        try:
            options.platform = platform_from(options, options.platform)
        except ValueError as error:
            raise UsageError(f"{error}.") from error


def monitors_from(text: str) -> tuple[MonitorSettings, ...]:
    """The monitors of one step control, from KIND, KIND^POWER, WEIGHT*KIND or several of them joined by +."""
    monitors = []
    for part in text.split("+"):
        weight, star, rest = part.rpartition("*")
        kind, caret, power = rest.partition("^")
        try:
            settings = MonitorSettings(
                chosen(kind.strip(), MONITORS, "monitor"),
                float(weight) if star else 1.0,
                float(power) if caret else 1.0,
            )
        except ValueError as error:
            raise UsageError(
                f"the monitor '{part}' cannot be read; write KIND, KIND^POWER or WEIGHT*KIND, such as ForcePNorm^0.5."
            ) from error
        if not (0.0 < settings.weight < math.inf and 0.0 < settings.power < math.inf):
            raise UsageError(f"weight and power of the monitor '{part}' must be positive.")
        monitors.append(settings)
    return tuple(monitors)
