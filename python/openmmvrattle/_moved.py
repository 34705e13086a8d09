# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Modules that were called otherwise: their old names go on to work, with a DeprecationWarning."""

import importlib
import sys
import warnings


def moved(name: str) -> None:
    """Let the module of a name be the one of the same name in openmmvrattle.compare."""
    package, _, last = name.rpartition(".")
    new = f"{package}.compare.{last}"
    # Python passes over the frames of its import system.
    warnings.warn(f"{name} is called {new} now", DeprecationWarning, stacklevel=3)
    sys.modules[name] = importlib.import_module(new)
