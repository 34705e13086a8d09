# OpenMM-VRATTLE: the scripts of the project, for the tests that look into them.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]


def load_script(path: str) -> ModuleType:
    """A script, named from the root of the project, as a module; a skipped test where there is none."""
    if not (ROOT / path).exists():
        pytest.skip(f"needs {path}")
    folder = str((ROOT / path).parent)
    if folder not in sys.path:  # for scripts that import others beside them, as Python has it when it runs one
        sys.path.append(folder)
    specification = importlib.util.spec_from_file_location(path.removesuffix(".py").replace("/", "_"), ROOT / path)
    assert specification is not None and specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules[specification.name] = module  # where dataclasses look up the module of a class
    specification.loader.exec_module(module)
    return module
