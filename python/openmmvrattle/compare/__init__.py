# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Integrators compared, and advice from a trial run: what the commands ``compare`` and ``advise`` are made of.

Running and measuring needs OpenMM and NumPy alone; pictures, tables and Dask clusters need the packages of the extra
``compare``: pip install "openmm-vrattle[compare]".
"""

from __future__ import annotations

import importlib

__all__ = ["MissingPackageError"]


class MissingPackageError(ImportError):
    """A package that only comparisons need is not installed; the message says which, and how to get it."""


def require(what: str, *packages: str) -> None:
    """Raise a MissingPackageError if one of some packages cannot be imported.

    Args:
        what: what needs them.
        packages: their names.
    """
    missing = []
    for package in packages:
        try:
            importlib.import_module(package)
        except ImportError:
            missing.append(package)
    if missing:
        verb = "is" if len(missing) == 1 else "are"
        raise MissingPackageError(
            f"{what} needs {' and '.join(missing)}, which {verb} not installed: pip install "
            '"openmm-vrattle[compare]" (or, in the folder of the source, ".[compare]").'
        )
