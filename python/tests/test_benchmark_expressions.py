# OpenMM-VRATTLE: the benchmark of expression constraints runs and prints what the documentation says it does.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "expressions.py"


def test_it_prints_a_table_and_a_line_for_each_measurement() -> None:
    command = [sys.executable, str(SCRIPT), "--number", "500", "--repeats", "2", "--platform", "Reference"]
    run = subprocess.run(command, check=True, capture_output=True, text=True)
    lines = [json.loads(line) for line in run.stdout.splitlines() if line.startswith("{")]
    assert [(m["kind"], m["update"]) for m in lines] == [
        (kind, update) for kind in ("sphere", "distance", "angle") for update in ("fixed", "explicit", "semi-explicit")
    ]
    # Forces without a neighbour list take thousands of times as long; a hundredth part of them is a safe bound.
    assert all(0 < m["step_with"] < 0.5 * m["forces"] for m in lines)
    assert all(m["iterations"] >= 1 for m in lines)
    assert "500 expression constraints" in run.stdout
