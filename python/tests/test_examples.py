# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The short examples run as they stand, and show what they say. The longer ones have test files of their own."""

from __future__ import annotations

import csv
import re
import subprocess
import sys
from pathlib import Path

import pytest
from run_support import GPU, needs_gpu

FOLDER = Path(__file__).parents[2] / "examples"

pytestmark = pytest.mark.skipif(not FOLDER.exists(), reason="needs the folder examples")


ON_GPU = ["--platform", GPU, "--precision", "double"]
everywhere = pytest.mark.parametrize("options", [[], pytest.param(ON_GPU, marks=needs_gpu)], ids=["", "GPU"])


def run(name: str, folder: Path, options: list[str] | None = None) -> str:
    result = subprocess.run(
        [sys.executable, str(FOLDER / name), *(options or [])],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert result.returncode == 0, result.stderr
    # OpenMM warns of drivers that it was not tried with, such as OpenCL on a processor.
    return "".join(line for line in result.stdout.splitlines(keepends=True) if not line.startswith("WARNING:"))


def table(path: Path) -> list[list[float]]:
    with path.open(newline="") as file:
        return [[float(value) for value in row] for row in list(csv.reader(file))[1:]]


@everywhere
def test_quick_start(options: list[str], tmp_path: Path) -> None:
    """Twenty lines; the energy stays while the steps shrink by orders of magnitude."""
    found = re.findall(r"step (\S+) ps +energy (\S+) kJ", run("quick_start.py", tmp_path, options))
    assert len(found) == 20
    steps, energies = [float(step) for step, _ in found], [float(energy) for _, energy in found]
    assert max(steps) / min(steps) > 100
    assert max(energies) - min(energies) < 0.01


@everywhere
def test_swap_verlet(options: list[str], tmp_path: Path) -> None:
    output = run("swap_verlet.py", tmp_path, options)
    steps, time = re.search(r"(\d+) steps, (\S+) ps", output).groups()
    assert int(steps) == 2000
    assert float(time) == pytest.approx(2.0, rel=0.02)
    energies = [row[2] for row in table(tmp_path / "swap_verlet.csv")]
    assert len(energies) == 20
    assert max(energies) - min(energies) < 2.0


@everywhere
def test_nve_water(options: list[str], tmp_path: Path) -> None:
    lines = run("nve_water.py", tmp_path, options).splitlines()[1:]
    rows = [[float(value) for value in line.split()] for line in lines]
    assert [row[0] for row in rows] == pytest.approx([0.1 * number for number in range(1, 21)], abs=0.006)
    assert max(abs(row[2]) for row in rows) < 1.0
    assert max(row[3] for row in rows) < 1e-6
    assert len(table(tmp_path / "nve_water.csv")) == 20
    assert (tmp_path / "nve_water.xtc").stat().st_size > 0


@everywhere
def test_clash_relaxation(options: list[str], tmp_path: Path) -> None:
    """The energy error is much smaller with about as many force evaluations."""
    output = run("clash_relaxation.py", tmp_path, options)
    assert "Use variable steps: ForcePNorm" in output
    found = re.findall(r"(\d+) force evaluations, .* largest energy error (\S+) kJ", output)
    (fixed, fixed_error), *variable = [(int(number), float(error)) for number, error in found]
    assert len(variable) == 2
    for evaluations, error in variable:
        assert evaluations == pytest.approx(fixed, rel=0.2)
        assert error < fixed_error / 10


def test_no_minimisation(tmp_path: Path) -> None:
    """OpenMM's integrator fails, or is far too hot; ours goes on, at little more than an evaluation a step."""
    output = run("no_minimisation.py", tmp_path)
    theirs, ours = output.split("VariableStepRattleLangevinIntegrator")
    rows = [line.split() for line in ours.splitlines() if re.fullmatch(r"[ \d-]+", line)]
    assert [int(row[0]) for row in rows if row] == list(range(50, 401, 50))
    rows = [row for row in rows if row]
    assert 250 < float(rows[7][2]) < 400
    evaluations = float(re.search(r"(\S+) evaluations a step", ours)[1])
    assert 1 < evaluations < 1.5
    assert "failed" in theirs or float(theirs.split()[-1]) > 400


@needs_gpu
@pytest.mark.parametrize("name", ["pulled_chain", "blue_moon"])
def test_those_with_files_of_their_own_run_on_a_platform_by_name(name: str, tmp_path: Path) -> None:
    output = run(f"{name}.py", tmp_path, ON_GPU)
    if name == "pulled_chain":
        assert float(re.search(r"largest relative difference: (\S+)", output)[1]) < 1e-9
    else:
        deviations = [float(line.split()[-1]) for line in output.splitlines() if "+-" in line]
        assert len(deviations) == 5
        assert max(map(abs, deviations)) < 5


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_every_example_takes_a_platform(path: Path) -> None:
    result = subprocess.run([sys.executable, str(path), "--help"], capture_output=True, text=True, timeout=600)
    assert result.returncode == 0, result.stderr
    assert "--platform" in result.stdout and "--precision" in result.stdout


def test_a_platform_that_there_is_not(tmp_path: Path) -> None:
    result = subprocess.run(
        [sys.executable, str(FOLDER / "pulled_chain.py"), "--platform", "Cuda"], capture_output=True, text=True
    )
    assert result.returncode == 2
    assert "there is no platform 'Cuda' here; choose among" in result.stderr
