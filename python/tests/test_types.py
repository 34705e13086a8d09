# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The type hints of the package agree with its classes, and a type checker makes use of them.

OpenMM has no types of its own: to a type checker its Quantity and what is inherited from its Integrator can be
anything.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

CONFIGURATION = "[mypy]\nstrict = true\n[mypy-openmm.*]\nignore_missing_imports = true\n"

GOOD_SCRIPT = """\
from openmm import unit
from openmmvrattle import VariableStepRattleIntegrator, XmlSerializer

integrator = VariableStepRattleIntegrator(
    0.002, VariableStepRattleIntegrator.Explicit, maximumStepSize=4 * unit.femtosecond, monitors=[]
)
index: int = integrator.addMonitor(VariableStepRattleIntegrator.ForcePNorm, power=0.5)
kind, weight, power = integrator.getMonitor(index)
half: float = weight * power / 2
rho: float = integrator.getStepDensity()
integrator.setReferenceMonitorValue(half + rho, index)
text: str = XmlSerializer.serialize(integrator)
mine: VariableStepRattleIntegrator = VariableStepRattleIntegrator.cast(integrator)
"""

BAD_SCRIPT = """\
from openmmvrattle import VariableStepRattleIntegrator

integrator = VariableStepRattleIntegrator()
integrator.addMonitor("ConstraintForce")
step: int = integrator.getMonitor(0)
text: str = integrator.getStepDensity()
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One for all, so that mypy finds again what it knows of the package."""
    result = tmp_path_factory.mktemp("types")
    (result / "mypy.ini").write_text(CONFIGURATION)
    return result


def mypy(folder: Path, script: str) -> tuple[int, str]:
    (folder / "script.py").write_text(script)
    command = [sys.executable, "-m", "mypy", "--config-file", "mypy.ini", "--cache-dir", "cache", "script.py"]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    return result.returncode, result.stdout + result.stderr


def test_the_hints_agree_with_the_classes(folder: Path) -> None:
    """Names, signatures and constants, compared by mypy's stubtest with the classes as Python sees them."""
    command = [sys.executable, "-m", "mypy.stubtest", "openmmvrattle.integrators", "--mypy-config-file", "mypy.ini"]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr


def test_a_script_that_is_right_passes(folder: Path) -> None:
    status, output = mypy(folder, GOOD_SCRIPT)
    assert status == 0, output


def test_what_is_wrong_in_a_script_is_found(folder: Path) -> None:
    status, output = mypy(folder, BAD_SCRIPT)
    assert status == 1
    for line, what in [(3, "call-arg"), (4, "arg-type"), (5, "assignment"), (6, "assignment")]:
        assert any(found.startswith(f"script.py:{line}:") and what in found for found in output.splitlines()), output
