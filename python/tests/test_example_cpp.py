# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The example in C++ builds against the installed packages, and does what Python does."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import openmm
from conftest import PRESENT
from openmm import unit
from openmmvrattle import VariableStepRattleIntegrator
from openmmvrattle.testsystems import double_pendulum

FOLDER = Path(__file__).parents[2] / "examples" / "cpp"


def numbers(printed: str) -> list[list[float]]:
    """Those of each line about a time."""
    lines = [line for line in printed.splitlines() if line.startswith("time")]
    return [[float(word) for word in re.findall(r"-?\d+\.?\d*(?:e[+-]\d+)?", line)] for line in lines]


def test_it_does_what_python_does(tmp_path: Path) -> None:
    cmake = shutil.which("cmake", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    assert cmake, "there is no cmake; it belongs to the extra `test`"
    configure = [cmake, "-S", str(FOLDER), "-B", str(tmp_path), f"-DPython_EXECUTABLE={sys.executable}"]
    subprocess.run(configure, check=True)
    subprocess.run([cmake, "--build", str(tmp_path)], check=True)
    printed = subprocess.run([str(tmp_path / "pendulum")], check=True, capture_output=True, text=True).stdout
    lines = numbers(printed)
    command = [str(tmp_path / "pendulum"), "--platform"]
    on_cpu = subprocess.run([*command, "CPU"], check=True, capture_output=True, text=True).stdout
    assert on_cpu == printed  # which runs the kernels of Reference, and its forces of these kinds
    if "OpenCL" in PRESENT:
        on_opencl = subprocess.run([*command, "OpenCL"], check=True, capture_output=True, text=True).stdout
        np.testing.assert_allclose(numbers(on_opencl)[:6], lines[:6], rtol=0.06)
    assert len(lines) == 13

    pendulum = double_pendulum()
    integrator = VariableStepRattleIntegrator(0.01, minimumStepSize=1e-6, maximumStepSize=0.02)
    context = openmm.Context(pendulum.system, integrator, openmm.Platform.getPlatform("Reference"))
    context.setPositions(pendulum.positions)
    for time, step, energy, tension in lines[:6]:  # before the first whip, after which the motion is chaotic
        integrator.stepTo(time)
        state = context.getState(energy=True)
        multipliers = integrator.getMultipliers().value_in_unit(unit.kilojoule_per_mole / unit.nanometer**2)
        expected = (state.getKineticEnergy() + state.getPotentialEnergy()).value_in_unit(unit.kilojoule_per_mole)
        np.testing.assert_allclose(integrator.getStepSize().value_in_unit(unit.picosecond), step, rtol=0.06)
        np.testing.assert_allclose(energy, expected, rtol=1e-7)
        np.testing.assert_allclose(tension, 2 * multipliers[0], rtol=0.01)
