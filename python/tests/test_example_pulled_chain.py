# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import openmm

EXAMPLE = Path(__file__).parents[2] / "examples" / "pulled_chain.py"


def test_tensions_are_those_of_statics() -> None:
    example = runpy.run_path(str(EXAMPLE))
    _, expected = example["statics"]()
    found = example["tensions_from_multipliers"](openmm.Platform.getPlatform("Reference"), {})
    assert np.all(np.diff(expected) < 0)  # each bond carries less than the one above
    # The suspension is as heavy as 1e15 amu, not fixed; all else is rounding.
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_it_runs_alone() -> None:
    run = subprocess.run([sys.executable, str(EXAMPLE)], check=True, capture_output=True, text=True)
    assert "largest relative difference" in run.stdout
