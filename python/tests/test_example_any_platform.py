# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import re
import runpy
import subprocess
import sys
from pathlib import Path

import openmm
import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "any_platform.py"


@pytest.mark.parametrize("custom", [False, True])
def test_there_and_back(custom: bool) -> None:
    example = runpy.run_path(str(EXAMPLE))
    distance, energy_error, sizes = example["there_and_back"]("Reference", 50, custom)
    assert distance < 1e-7
    assert energy_error < 0.1
    assert len(sizes) == 100 and sizes.max() > 1.05 * sizes.min()


def test_it_runs_alone() -> None:
    """On whatever platform is the fastest here."""
    run = subprocess.run([sys.executable, str(EXAMPLE), "--steps", "50"], check=True, capture_output=True, text=True)
    found = re.search(r"there and back: (\S+) nm from the start", run.stdout)
    assert found and float(found[1]) < 1e-5
    names = [openmm.Platform.getPlatform(i).getName() for i in range(openmm.Platform.getNumPlatforms())]
    assert any(f"fs on {name}" in run.stdout for name in names)
