# OpenMM-VRATTLE: the blue-moon example recovers the mean force that it must.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import openmm

EXAMPLE = Path(__file__).parents[2] / "examples" / "blue_moon.py"


def test_the_mean_force_is_the_known_one() -> None:
    example = runpy.run_path(str(EXAMPLE))
    results = example["scan"](openmm.Platform.getPlatform("Reference"), {}, copies=200, windows=40, seed=5)
    errors = np.array([each.error for each in results])
    deviations = np.array([each.value - example["known_mean_force"](each.distance) for each in results])
    # The forces lie between 40 and 50 kJ/mol/nm; one of five independent numbers is beyond 4 errors once in 3000 times.
    assert np.all(errors < 2)
    assert np.all(np.abs(deviations) < 4 * errors)
    # Without the entropy of directions, 2 kT/r = 13 to 23 kJ/mol/nm, all of it would be wrong.
    assert np.all(2 * example["KT"] / np.array(example["DISTANCES"]) > 5 * errors)


def test_it_runs_alone() -> None:
    run = subprocess.run([sys.executable, str(EXAMPLE)], check=True, capture_output=True, text=True)
    assert "kJ/mol by the trapezoidal rule" in run.stdout
