# OpenMM-VRATTLE: the benchmark of the energy drift, in its quick version.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import csv
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from project_scripts import load_script


@pytest.fixture(scope="module")
def drift() -> ModuleType:
    return load_script("benchmarks/drift.py")


def test_drift_and_walk_of_known_series(drift: ModuleType) -> None:
    rng = np.random.default_rng(6)
    times = np.arange(1, 4001) * 0.25
    noise = rng.normal(size=4000)
    slope, error, walk = drift.fit_drift(times, 0.003 * times + noise)
    # White noise: the error of a slope is sqrt(12/n)/T, but one run cannot rule out that a little of it is a walk.
    assert 0.6 < error / (np.sqrt(12 / 4000) / 1000) < 6
    assert abs(slope - 0.003) < 4 * error
    assert walk < 0.02
    slopes, errors, walks = [], [], []
    for _ in range(40):
        series = np.cumsum(rng.normal(size=4000)) * 0.02 + rng.normal(size=4000)
        for values, value in zip((slopes, errors, walks), drift.fit_drift(times, series), strict=True):
            values.append(value)
    # A random walk of 0.02 in each 0.25 ps, 0.04 in 1 ps: no drift, and the error must know.
    assert np.sqrt(np.mean(np.square(walks))) == pytest.approx(0.04, rel=0.3)
    assert np.mean(np.abs(slopes) < 3 * np.array(errors)) > 0.85
    assert np.std(slopes) == pytest.approx(np.sqrt(np.mean(np.square(errors))), rel=0.5)


def test_verdict_can_fail(drift: ModuleType) -> None:
    def run(name: str, slope: float, error: float) -> object:
        numbers = dict.fromkeys(drift.Run.__dataclass_fields__, 0)
        numbers |= {"problem": "water", "integrator": name, "drift": slope, "drift_error": 0.1}
        return drift.Run(**(numbers | {"constraint_error": error}))

    verlet = run("Verlet", 0.1, 3e-8)
    assert drift.verdict([run("VRATTLE U2", -0.4, 1e-9), verlet]) == []
    assert len(drift.verdict([run("VRATTLE U2", -0.6, 1e-9), verlet])) == 1
    assert len(drift.verdict([run("VRATTLE U2", float("nan"), 1e-9), verlet])) == 1
    assert len(drift.verdict([run("VRATTLE U2", 0.0, 1.2e-8), verlet])) == 1


@pytest.mark.claims
def test_quick_run(drift: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    assert drift.main(["--quick", "--output", str(tmp_path)]) == 0
    output = capsys.readouterr().out
    runs = [json.loads(line) for line in output.splitlines() if line.startswith("{")]
    names = ["VRATTLE U2", "VRATTLE force", "VRATTLE automatic", "Verlet", "VariableVerlet"]
    assert [run["integrator"] for run in runs] == names * 2
    for system in (runs[:5], runs[5:]):
        ours, verlet, variable = system[:3], system[3], system[4]
        assert verlet["mean_step"] == pytest.approx(ours[0]["mean_step"], rel=1e-9)
        # Tuned on trial runs that are as short.
        assert variable["mean_step"] == pytest.approx(ours[0]["mean_step"], rel=0.15)
        for run in system:
            # One evaluation a step, and one more where a run of ours begins.
            assert 0 <= run["force_evaluations"] - run["starts"] * run["steps"] <= run["starts"]
        for run in ours:
            assert run["constraint_error"] <= 1e-8
            if run["integrator"] == "VRATTLE automatic":  # calm all the time
                assert run["mean_step"] == pytest.approx(verlet["mean_step"], rel=1e-3)
            else:
                assert run["smallest_step"] < run["largest_step"]
            assert run["rescues"] == 0
            # Within one sample of the other's: they conserve energy alike.
            assert run["fluctuation"] <= 2 * verlet["fluctuation"] + 1e-3
            # The drift of a run of 9 ps is nothing but fluctuations, of 0.02 kJ/mol for the 8 waters.
            if run["starts"] > 1:
                assert abs(run["drift"]) < 20
    with (tmp_path / "drift.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 5 * (runs[0]["starts"] * runs[0]["steps"] // 10 + runs[5]["steps"] // 5)
    assert {row["system"] for row in rows} == {"8 waters", "216 waters"}
    assert (tmp_path / "drift.png").read_bytes()[1:4] == b"PNG"
