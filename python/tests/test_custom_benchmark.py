# OpenMM-VRATTLE: the benchmark of the CustomIntegrator runs.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "custom.py"

pytestmark = pytest.mark.skipif(not SCRIPT.exists(), reason="needs the folder benchmarks")


def test_a_short_run() -> None:
    """Both integrators cost more than nothing beside VerletIntegrator, and the search takes about two passes."""
    command = [sys.executable, str(SCRIPT), "--box", "1.9", "--rounds", "2", "--steps", "2"]
    run = subprocess.run(command, check=True, capture_output=True, text=True)
    lines = [json.loads(line) for line in run.stdout.splitlines() if line.startswith("{")]
    names = [line["integrator"].split(",")[0] for line in lines]
    assert names == ["VerletIntegrator"] + 3 * ["plugin"] + 3 * ["custom"]
    assert lines[0]["ratio"] == 1
    assert all(line["milliseconds_per_step"] > 0 for line in lines)
    passes = {line["integrator"]: line["passes_per_step"] for line in lines if "passes_per_step" in line}
    assert passes["custom, AppliedForce"] == 1
    assert 1 < passes["custom, ConstraintForce"] < 4
