# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The command line: ``python -m openmmvrattle``."""

from __future__ import annotations

import argparse
import importlib.metadata
import sys
from collections.abc import Sequence

import openmm

from . import info
from .compare import MissingPackageError
from .compare.commands import advise, compare
from .compare.commands.systems import UsageError

_EXAMPLES = """examples:
  python -m openmmvrattle info
      does the installation work, and on which platforms?
  python -m openmmvrattle advise --pdb protein.pdb
      would variable steps pay on this system, and with which settings?
  python -m openmmvrattle compare --system light-heavy-chain --output whip
      integrators side by side: tables, pictures and a report in the folder whip

  python -m openmmvrattle COMMAND --help shows all options of a command, with more examples.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code: 0, 1 for a fault that was found, 2 for wrong usage, 130 after an
    interrupt."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.command is None:
        parser.print_help()
        return 0
    try:
        return options.run(options)
    except (UsageError, MissingPackageError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("Interrupted.", file=sys.stderr)
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m openmmvrattle",
        description="Time-reversible variable-step dynamics with constraints for OpenMM.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=_version())
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    for command in (compare, advise, info):
        command.add_parser(commands)
    return parser


def _version() -> str:
    try:
        own = importlib.metadata.version("openmm-vrattle")
    except importlib.metadata.PackageNotFoundError:
        own = "not installed"
    return f"openmm-vrattle {own} (OpenMM {openmm.Platform.getOpenMMVersion()})"


if __name__ == "__main__":
    sys.exit(main())
