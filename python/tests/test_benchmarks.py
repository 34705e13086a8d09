# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The benchmarks run and write what they should, and the gains that the documentation claims are there."""

import csv
import json
import math
import subprocess
import sys
from pathlib import Path

import pytest
from project_scripts import load_script

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "work_precision.py"
DOCUMENT = Path(__file__).parents[2] / "docs" / "work_precision.md"

pytestmark = pytest.mark.skipif(not SCRIPT.exists(), reason="needs the folder benchmarks")


def run_script(folder, *arguments):
    command = [sys.executable, str(SCRIPT), "--output", str(folder), *arguments]
    result = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert result.returncode == 0, result.stderr
    return result.stdout


def lines_of(path):
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


@pytest.fixture(scope="module")
def script():
    """The script as a module."""
    return load_script("benchmarks/work_precision.py")


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    folder = tmp_path_factory.mktemp("quick")
    choice = ["--systems", "water-clash", "--monitors", "ForcePNorm^0.5", "ConstraintForce", "--updates", "Explicit"]
    return folder, run_script(folder, "--quick", "--jobs", "2", *choice)


def test_measurements_are_at_equal_force_evaluations(quick):
    folder, _ = quick
    measurements = lines_of(folder / "measurements.jsonl")
    assert {m["method"] for m in measurements} == {"fixed", "variable", "control", "vrattle"}
    assert {m["monitor"] for m in measurements} == {"", "ForcePNorm^0.5", "ConstraintForce"}
    finished = [m for m in measurements if m["failure"] is None]
    assert len({m["evaluations"] for m in finished if m["method"] == "vrattle"}) >= 2
    for measurement in finished:
        assert measurement["largest_energy_error"] > 0
        assert measurement["force_evaluations"] == pytest.approx(measurement["evaluations"], rel=0.02, abs=2)


def test_gain_is_against_rattle_with_fixed_steps(quick):
    folder, _ = quick
    measurements = lines_of(folder / "measurements.jsonl")
    fixed = {m["evaluations"]: m["largest_energy_error"] for m in measurements if m["method"] == "control"}
    compared = [m for m in measurements if m["gain"] is not None]
    assert compared
    for measurement in compared:
        expected = fixed[measurement["evaluations"]] / measurement["largest_energy_error"]
        assert measurement["gain"] == pytest.approx(expected)


def test_table_has_a_row_for_each_measurement(quick):
    folder, _ = quick
    with (folder / "table.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    measurements = lines_of(folder / "measurements.jsonl")
    assert len(rows) == len(measurements)
    assert set(rows[0]) == set(measurements[0])


def test_figure_is_a_picture(quick):
    folder, _ = quick
    content = (folder / "work_precision.png").read_bytes()
    assert content.startswith(b"\x89PNG")
    assert len(content) > 10_000


def test_report_has_tables_and_says_which_claims_were_measured(quick):
    folder, output = quick
    report = (folder / "table.md").read_text(encoding="utf-8")
    assert "### water-clash" in report
    assert "| ForcePNorm^0.5 |" in report
    assert report in output
    assert "claim water-clash: ForcePNorm^0.5, Explicit, 800 evaluations: gain -" in output
    assert "not measured" in output


@pytest.mark.parametrize(
    "arguments",
    [["--systems", "unheard-of"], ["--jobs", "0"], ["--evaluations", "5"], ["--claims", "unheard-of"]],
)
def test_wrong_usage_is_refused(tmp_path, arguments):
    command = [sys.executable, str(SCRIPT), "--output", str(tmp_path), *arguments]
    result = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert result.returncode == 2
    assert "error: " in result.stderr


# Those that take seconds; the others of the benchmark are the same setting on other systems.
@pytest.mark.parametrize(
    "name", ["pendulum", "whip", "whip-with-repulsion", "water-clash", "alanine-dipeptide-hbonds", "rigid-waters"]
)
@pytest.mark.claims
def test_claim_is_met(script, tmp_path, name):
    output = run_script(tmp_path, "--claims", name, "--jobs", "2")
    (result,) = lines_of(tmp_path / "claims.jsonl")
    claim = script.CLAIMS[name]
    assert result["claim"] == name
    assert result["gain"] >= claim.least_gain == result["least_gain"], output
    for measurement in lines_of(tmp_path / "measurements.jsonl"):
        if measurement["failure"] is None:
            assert measurement["force_evaluations"] == pytest.approx(measurement["evaluations"], rel=0.02)


def test_claims_are_those_of_the_documentation(script):
    expected = {"pendulum": 1e5, "whip": 1e3, "whip-with-repulsion": 30, "water-clash": 10}
    assert {name: script.CLAIMS[name].least_gain for name in expected} == expected
    assert {claim.least_gain for name, claim in script.CLAIMS.items() if name not in expected} == {0.9}
    text = DOCUMENT.read_text(encoding="utf-8")
    for claim in script.CLAIMS.values():
        assert f"`{claim.name}`" in text


def test_evaluations_saved_are_interpolated(script):
    """With errors that fall with the square of the evaluations, a hundredth of the error saves a factor of ten."""
    fixed = [(n, 1e6 / n**2) for n in (100, 400, 1600)]
    ratio, is_bound = script.evaluations_saved(fixed, [(n, 1e4 / n**2) for n in (20, 40, 100)])
    assert ratio == pytest.approx(10.0)
    assert not is_bound


def test_evaluations_saved_are_not_extrapolated(script):
    fixed = [(100, 1.0), (400, 0.1)]
    assert script.evaluations_saved(fixed, [(100, 0.01), (50, 0.05)]) == (8.0, True)
    assert script.evaluations_saved(fixed, [(100, 2.0)]) is None
    assert script.evaluations_saved(fixed, [(100, math.nan)]) is None
    assert script.evaluations_saved([], [(100, 1.0)]) is None


def test_errors_of_fixed_steps_that_scatter_do_not_help(script):
    """An error that rises with the evaluations by chance is not taken for the better one."""
    fixed = [(100, 1.0), (200, 0.25), (300, 0.5), (400, 0.0625)]
    ratio, _ = script.evaluations_saved(fixed, [(100, 0.25)])
    assert 2.0 <= ratio <= 3.0
