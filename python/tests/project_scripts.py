# OpenMM-VRATTLE: the scripts of the project, for the tests that look into them.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
TIMEOUT = 600  # s, for a program that another test runs: many times what it takes, for machines under load


def run_command(*arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """`python -m openmmvrattle` with these arguments."""
    return subprocess.run(
        [sys.executable, "-m", "openmmvrattle", *arguments], capture_output=True, text=True, timeout=TIMEOUT, **options
    )


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


def run_quickly(example: ModuleType, folder: Path) -> Any:
    """The study of a quick run of a whole example, which writes its files into a folder."""
    studies = []

    def run_and_keep(*arguments: Any) -> Any:
        studies.append(run_study(*arguments))
        return studies[-1]

    run_study, example.run_study = example.run_study, run_and_keep
    try:
        assert example.main(["--quick", "--output", str(folder)]) == 0
    finally:
        example.run_study = run_study
    return studies[0]
