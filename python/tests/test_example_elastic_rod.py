# OpenMM-VRATTLE: the example that reproduces section 5 of the paper, run small, and its claims.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import csv
import io
import json
import math
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from dense_rod import Rod
from project_scripts import load_script, run_quickly


@pytest.fixture(scope="module")
def example() -> ModuleType:
    """The script as a module."""
    return load_script("examples/elastic_rod.py")


@pytest.fixture(scope="module")
def finished(example: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path]:
    """The study of a quick run of the whole script, and the folder with its files."""
    folder = tmp_path_factory.mktemp("elastic_rod") / "not" / "there"
    return run_quickly(example, folder), folder


@pytest.fixture
def study(finished: tuple[Any, Path]) -> Any:
    return finished[0]


@pytest.mark.claims
def test_comparisons_are_fair(example: ModuleType, study: Any) -> None:
    """The same number of force evaluations, one a step and one at the start, over the same time; every step seen."""
    assert len(study.trials) == 10
    for name, trials in study.trials.items():
        for number, trial in zip(example.QUICK_STEPS, trials, strict=True):
            variable, fixed = trial.variable, trial.fixed
            assert variable.force_evaluations == fixed.force_evaluations == variable.steps + 1 == fixed.steps + 1
            assert variable.series.times[-1] == pytest.approx(fixed.series.times[-1], rel=1e-9)
            # With a = 6 so few steps are not in proportion to the first one.
            if not name.endswith("6"):
                assert variable.failure is None
                assert 1 <= variable.series.times[-1] * (1 + 1e-9) < 1.05
                assert variable.steps == pytest.approx(number, rel=0.15)


@pytest.mark.claims
def test_runs_start_where_they_should(study: Any) -> None:
    """The energy of the start; the first step has the nominal size; the rod keeps its length."""
    for trials in study.trials.values():
        for trial in trials:
            assert trial.variable.initial_energy == pytest.approx(1.493568125, abs=1e-9)
            assert trial.variable.series.step_sizes[1] == pytest.approx(trial.variable.first_step, rel=1e-9)
    rod = Rod()
    for points in study.trials["U3, a = 3"][0].variable.positions[::20]:
        assert np.max(np.abs(rod.g(points.ravel()))) < 1e-8


@pytest.mark.claims
def test_nearness_is_that_of_the_walls(example: ModuleType, study: Any) -> None:
    run = study.same_step[0.02][0].variable
    dense = [Rod().nearness(points.ravel(), 1.0) for points in run.positions]
    np.testing.assert_allclose(run.nearness, dense, rtol=1e-12)
    # (3.15): rho + rho' = 2 U.
    np.testing.assert_allclose(run.densities[1:] + run.densities[:-1], 2 * run.nearness[1:-1] ** 3, rtol=1e-9)


@pytest.mark.claims
def test_gains(study: Any) -> None:
    """What prototypes measured at 350 and 1,000 steps: 2.4 to 6.7 with U3, 0.4 to 1.1 with U2 and Gauss."""
    expected = {"U3, a = 1": 2.4, "U3, a = 2": 4.7, "U3, a = 3": 6.7, "U3, a = 3, simple start": 6.5}
    for name, gain in expected.items():
        for trial in study.trials[name]:
            assert trial.gain == pytest.approx(gain, rel=0.12), name
    assert study.trials["U3, a = 6"][1].gain < 0.5
    assert all(trial.gain > 6 for trial in study.trials["U3, a = 3, smooth"])
    for name in ("U1", "U2", "Gauss"):
        assert all(trial.gain < 1 for trial in study.trials[name])
    assert all(1.2 < trial.gain < 2.2 for trial in study.trials["vector field"])


@pytest.mark.claims
def test_figure_5_4(study: Any) -> None:
    """163 steps of VRATTLE beat 338 of RATTLE."""
    equal, double = study.same_step[0.02][0], study.same_step[0.04][0].variable
    assert equal.fixed.steps == pytest.approx(338, abs=2)
    assert double.steps == pytest.approx(163, abs=2)
    assert double.largest_error < equal.fixed.largest_error
    assert equal.gain > 5


@pytest.mark.claims
def test_recursion_of_the_density(study: Any) -> None:
    """(3.15), rho + rho' = 2 U, for the recursion in the script as for the integrator's; and where each starts."""
    for starts in study.starts.values():
        for run in (starts.simple, starts.backward, starts.ours):
            u = run.nearness**3
            np.testing.assert_allclose(run.densities[1:] + run.densities[:-1], 2 * u[1:-1], rtol=1e-8)
            h = run.series.step_sizes[1:] * run.densities
            np.testing.assert_allclose(h, h[0], rtol=1e-10)
        # rho[-1/2] = U(q0), and so rho[1/2] as well.
        assert starts.simple.densities[0] == pytest.approx(starts.simple.nearness[0] ** 3, rel=1e-12)
    assert study.starts[0.0].simple.nearness[0] == pytest.approx(1 / 0.65, rel=1e-12)


@pytest.mark.claims
def test_starts(example: ModuleType, study: Any) -> None:
    """From t = 0.06 the extrapolated start reduces the oscillation 5.5-fold; from t = 0 it doubles it, unlike ours."""
    amplitudes = {}
    for time, starts in study.starts.items():
        for name in ("simple", "backward", "ours"):
            run = getattr(starts, name)
            amplitudes[time, name] = example.oscillation_at(run.densities, int(np.argmax(run.nearness[1:])))
    assert amplitudes[0.06, "simple"] / amplitudes[0.06, "backward"] == pytest.approx(5.5, rel=0.15)
    assert amplitudes[0.06, "ours"] < amplitudes[0.06, "backward"]
    assert amplitudes[0.0, "backward"] > 1.5 * amplitudes[0.0, "simple"]
    assert amplitudes[0.0, "ours"] < 0.2 * amplitudes[0.0, "simple"]


def test_oscillation_is_what_alternates(example: ModuleType) -> None:
    n = np.arange(60)
    smooth = np.exp(n / 20)
    assert np.max(example.oscillation(smooth)) < 1e-4
    sequence = smooth + 0.3 * (-1.0) ** n
    np.testing.assert_allclose(example.oscillation(sequence)[2:-2], 0.3, rtol=1e-3)
    assert example.oscillation_at(sequence, 0) == pytest.approx(0.3, rel=1e-3)


@pytest.mark.claims
def test_claims(example: ModuleType, study: Any) -> None:
    """Those that hold, and those that do not."""
    claims = {claim.claim: claim for claim in example.judge_claims(study)}
    failed = {name for name, claim in claims.items() if not claim.held}
    assert all(math.isfinite(claim.number) for claim in claims.values())
    assert len(claims) == 17
    assert failed == {
        "The same from t = 0",
        "while that of the step size remains essentially constant",
    }


@pytest.mark.claims
def test_findings(example: ModuleType, study: Any) -> None:
    findings = {finding.finding: finding.number for finding in example.other_findings(study)}
    assert all(math.isfinite(number) for number in findings.values())
    assert findings["U3: order of convergence, from 350 to 1,000 steps"] == pytest.approx(2.0, abs=0.1)
    assert findings["U3, 1,000 steps: gain in the root mean square of the error"] == pytest.approx(2.2, rel=0.2)
    assert findings["U3, 1,000 steps: its error at the end divided by that of RATTLE"] > 5
    smooth = findings["U3, 1,000 steps: gain with the smooth form"]
    assert smooth > findings["U3, 1,000 steps: gain with the maximum"]


@pytest.mark.claims
def test_files(example: ModuleType, finished: tuple[Any, Path]) -> None:
    study, folder = finished
    names = {"table.csv", "claims.json"} | {f"figure-5-{n}.png" for n in (2, 3, 4, 5, 6)}
    assert {path.name for path in folder.iterdir()} == names
    for name in names:
        if name.endswith(".png"):
            content = (folder / name).read_bytes()
            assert content.startswith(b"\x89PNG") and len(content) > 5000
    with (folder / "table.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 20 and tuple(rows[0]) == example.COLUMNS
    row = [row for row in rows if row["method"] == "U3, a = 3"][0]
    trial = study.trials["U3, a = 3"][0]
    assert float(row["largest_energy_error_kj_per_mol"]) == trial.variable.largest_error
    assert float(row["gain"]) == trial.gain
    content = json.loads((folder / "claims.json").read_text(encoding="utf-8"))
    assert [claim["number"] for claim in content["claims"]] == [c.number for c in example.judge_claims(study)]


@pytest.mark.claims
def test_output(example: ModuleType, study: Any) -> None:
    """One line for each method and each claim, which says what the number is."""
    console = example.Console(width=400, record=True, file=io.StringIO())
    example.print_table(study, console)
    example.print_claims(study, console)
    lines = [line.strip() for line in console.export_text().splitlines()]
    assert sum(line.startswith(("held: ", "did not hold: ")) for line in lines) == 17
    names = {line.split("  ")[0] for line in lines}
    assert names > {"RATTLE", *study.trials}


def test_output_that_cannot_be_written(example: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert example.main(["--quick", "--output", str(tmp_path / "file" / "folder")]) == 1
    assert capsys.readouterr().err.startswith("error: ")
