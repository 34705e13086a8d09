# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The benchmarks of the constraint solver and of a whole step run, and measure what they say."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"

pytestmark = pytest.mark.skipif(not FOLDER.exists(), reason="needs the folder benchmarks")


def run(script: str, *arguments: str) -> list[dict]:
    """The JSON lines of a benchmark."""
    command = [sys.executable, str(FOLDER / script), *arguments]
    result = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert result.returncode == 0, result.stderr
    return [json.loads(line) for line in result.stdout.splitlines() if line.startswith("{")]


def test_constraints() -> None:
    results = run("constraints.py", "--system", "light-heavy-chain", "protein-hbonds", "--repeats", "2")
    assert [(r["system"], r["error"]) for r in results] == [
        (system, error) for system in ("light-heavy-chain", "protein-hbonds") for error in (1e-5, 1e-8, 1e-12)
    ]
    for result in results:
        assert result["ours_achieved"] <= result["error"]
        assert 0 < result["ours_step_seconds"] and 0 < result["their_seconds"]
        # OpenMM's solver stops early on the chain, and says nothing.
        if result["system"] == "light-heavy-chain" and result["error"] <= 1e-8:
            assert result["their_achieved"] > 1e-6
        if result["system"] == "protein-hbonds" and result["error"] >= 1e-8:
            assert result["their_achieved"] <= result["error"]


@pytest.mark.parametrize(
    ("options", "integrators", "constraints"),
    [
        (["peptide-in-water"], ["Verlet", "Explicit", "SemiExplicit"], 2000),
        (["peptide-in-water", "--langevin"], ["LangevinMiddle", "Langevin"], 2000),
        (["villin-vacuum", "--langevin", "--alone"], ["LangevinMiddle", "Langevin"], 500),
    ],
)
def test_overhead(options: list[str], integrators: list[str], constraints: int) -> None:
    results = run("overhead.py", "--rounds", "1", "--steps", "1", "--system", *options)
    assert [r["integrator"] for r in results] == integrators
    for result in results:
        assert result["ratio"] == pytest.approx(result["ratio_of_best"])  # of one round
        assert result["steps_per_second"] > 0
        assert result["processor_ms"] > 0
        assert result["constraints"] > constraints
