# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The comparison of integrators: its numbers, its files and its command line."""

import csv
import io
import json
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import openmm
import pytest
from openmmvrattle import __main__ as command_line
from openmmvrattle.compare import measurement as measurement_module
from openmmvrattle.compare import plots
from openmmvrattle.compare.commands.compare import print_comparison
from openmmvrattle.compare.comparison import (
    Comparison,
    IntegratorRun,
    Series,
    compare,
    envelope,
    quick_settings,
    two_digits,
    verdict,
    write_json,
    write_series,
    write_summary,
)
from openmmvrattle.testsystems import SYSTEMS, MonitorSettings, StepControl
from project_scripts import run_command
from rich.console import Console

METHODS = ["fixed", "variable", "control", "vrattle", "vrattle"]


@pytest.fixture(scope="module")
def pendulum():
    """The double pendulum to just beyond its first whip, with few steps."""
    test_system = SYSTEMS["double-pendulum"]()
    settings = replace(test_system.settings, total_time=3.0, force_evaluations=15_000)
    with pytest.warns(UserWarning, match="1000 steps in a row"):  # in the whip, by automatic step control
        return compare(test_system, settings=settings)


@pytest.fixture(scope="module")
def chain():
    test_system = SYSTEMS["light-heavy-chain"]()
    return compare(test_system, settings=replace(test_system.settings, total_time=2.0, force_evaluations=1600))


def make_run(method="fixed", error=1.0, failure=None, name=None, constraint_error=1e-12):
    numbers = {
        field: 1.0
        for field in IntegratorRun.__dataclass_fields__
        if field not in ("name", "method", "failure", "series", "largest_energy_error", "largest_constraint_error")
    }
    return IntegratorRun(
        name=name or method,
        method=method,
        failure=failure,
        largest_energy_error=error,
        largest_constraint_error=constraint_error,
        series=Series(np.array([0.0, 1.0]), np.array([0.0, error]), np.array([math.nan, 1.0])),
        **numbers,
    )


def make_comparison(*runs, **changes):
    values = {
        "system_name": "made-up",
        "description": "made up",
        "platform": "Reference",
        "total_time": 1.0,
        "force_evaluations": 100,
        "constraint_tolerance": 1e-8,
        "initial_energy": 0.0,
        "runs": runs,
    }
    return Comparison(**(values | changes))


def test_all_integrators_run(pendulum):
    assert [run.method for run in pendulum.runs] == METHODS
    assert [run.failure for run in pendulum.runs] == [None] * 5
    assert not pendulum.interrupted


def test_force_evaluations_are_equal(pendulum):
    for run in pendulum.runs:
        assert run.force_evaluations == pytest.approx(15_000, rel=0.02), run.name
        assert 0 <= run.force_evaluations - run.steps <= 1, run.name


def test_same_time_and_same_start(pendulum):
    assert pendulum.initial_energy == pytest.approx(-288.493, abs=1e-3)
    for run in pendulum.runs:
        assert pendulum.total_time * (1 - 1e-8) <= run.simulated_time <= pendulum.total_time + run.largest_step
        assert run.series.times[0] == 0.0
        assert run.series.energy_errors[0] == 0.0
        assert np.all(np.diff(run.series.times) > 0)


def test_numbers_agree_with_the_course(pendulum):
    for run in pendulum.runs:
        assert run.energy_samples == len(run.series.times) == run.steps + 1
        assert run.largest_energy_error == np.max(np.abs(run.series.energy_errors))
        assert run.final_energy_error == run.series.energy_errors[-1]
        assert 0 < run.rms_energy_error <= run.largest_energy_error
        assert run.smallest_step == np.min(run.series.step_sizes[1:])
        assert run.largest_step == np.max(run.series.step_sizes[1:])
        assert run.seconds_per_step > 0


def test_fixed_steps_are_fixed_and_variable_steps_vary(pendulum):
    for run in pendulum.runs:
        ratio = run.largest_step / run.smallest_step
        if run.method in ("fixed", "control"):
            assert ratio == pytest.approx(1.0, abs=1e-9)
        if run.method == "vrattle":
            assert ratio > 10


def test_variable_steps_pay_on_the_pendulum(pendulum):
    run = pendulum.run_of("vrattle")
    assert pendulum.best() is run
    assert pendulum.gain(run, "control") > 10
    assert any("Variable steps win" in sentence for sentence in verdict(pendulum))


def test_own_integrators_meet_the_tolerance(pendulum, chain):
    for run in pendulum.runs[2:] + chain.runs[2:]:
        assert run.largest_constraint_error < 2e-8, run.name


def test_inexact_constraints_of_openmm_are_told(chain):
    """On I-H-I OpenMM's solver stops early; its integrator must not be taken for a measure of step control."""
    verlet = chain.run_of("fixed")
    assert verlet.largest_constraint_error > 1e-7
    assert any(sentence.startswith("VerletIntegrator misses its constraints") for sentence in verdict(chain))


def test_failure_is_told_and_the_others_go_on(chain):
    """With no applied force VariableVerletIntegrator has no step size."""
    failed = next(run for run in chain.runs if run.method == "variable")
    assert "step size became inf" in failed.failure
    assert chain.run_of("variable") is None
    assert math.isnan(chain.gain(failed))
    assert chain.run_of("vrattle") is not None
    assert any(sentence.startswith("VariableVerletIntegrator failed: ") for sentence in verdict(chain))


def test_exception_of_an_integrator_is_its_failure():
    test_system = SYSTEMS["rigid-waters"]()
    broken = StepControl(monitors=(MonitorSettings("NoSuchMonitor"),), nominal_step_size=0.001)
    settings = replace(quick_settings(test_system.settings), controls=(broken,))
    result = compare(test_system, settings=settings)
    assert [run.failure is None for run in result.runs] == [True, True, True, False, True]
    assert "NoSuchMonitor" in result.runs[3].failure


def test_energy_that_is_not_a_number_is_a_failure():
    test_system = SYSTEMS["rigid-waters"]()
    settings = replace(test_system.settings, total_time=200.0, force_evaluations=100, controls=())
    result = compare(test_system, settings=settings)
    for run in result.runs:
        if run.method in ("fixed", "control"):
            assert run.failure
    assert verdict(result)


def test_lost_constraints_are_a_failure():
    """Where OpenMM's solver gives up, its integrator goes on with bonds of any length."""
    test_system = SYSTEMS["light-heavy-chain"]()
    settings = replace(test_system.settings, force_evaluations=330, controls=())
    verlet = compare(test_system, settings=settings).runs[0]
    assert verlet.method == "fixed"
    assert verlet.failure.endswith("it had lost its constraints")


def test_interrupt_keeps_what_was_done():
    test_system = SYSTEMS["rigid-waters"]()

    def interrupt_at_control(name, activity, fraction):
        if name == "RATTLE, fixed steps":
            raise KeyboardInterrupt

    result = compare(test_system, settings=quick_settings(test_system.settings), progress=interrupt_at_control)
    assert result.interrupted
    assert [run.method for run in result.runs] == ["fixed", "variable"]
    assert verdict(result)[-1] == "The comparison was interrupted and is not complete."


def test_steps_that_are_too_large_to_start_with_are_made_smaller():
    """With 16 fs at the start a whip cannot be passed; the run that is compared has small enough steps."""
    test_system = SYSTEMS["double-pendulum"]()
    blind = StepControl(monitors=(MonitorSettings("VectorField"),), nominal_step_size=0.016)
    settings = replace(test_system.settings, total_time=2.0, force_evaluations=8000, controls=(blind,))
    run = compare(test_system, settings=settings).run_of("vrattle")
    assert run.parameter < 0.001
    assert run.force_evaluations == pytest.approx(8000, rel=0.02)


def test_calibration_counts_as_force_evaluations():
    test_system = SYSTEMS["light-heavy-chain"]()
    first_value = test_system.settings.controls[0]
    controls = (first_value, replace(first_value, calibration_steps=200))
    settings = replace(test_system.settings, total_time=2.0, force_evaluations=1600, controls=controls)
    runs = compare(test_system, settings=settings, integrators=["VRATTLE"]).runs
    assert runs[1].steps == pytest.approx(1400, rel=0.03)
    assert runs[0].steps == pytest.approx(1600, rel=0.02)
    assert runs[0].parameter != pytest.approx(runs[1].parameter, rel=0.1)
    for run in runs:
        assert run.force_evaluations == pytest.approx(1600, rel=0.02)


def test_progress_reaches_its_end():
    test_system = SYSTEMS["rigid-waters"]()
    reports = []
    settings = replace(quick_settings(test_system.settings), controls=test_system.settings.controls[:1])
    compare(test_system, settings=settings, progress=lambda *report: reports.append(report))
    names = list(dict.fromkeys(name for name, _, _ in reports))
    assert len(names) == 5
    assert all((name, "done", 1.0) in reports for name in names)
    assert all(0.0 <= fraction <= 1.0 for _, _, fraction in reports)


def test_leapfrog_starts_from_the_energy_of_the_others():
    """Without the half step back its energy at time 0 would be off by the work of half a step."""
    test_system = SYSTEMS["alanine-dipeptide-hbonds"]()
    settings = quick_settings(test_system.settings)
    method = measurement_module.methods_of(settings)[0]
    integrator, context = measurement_module._start(method, 0.001, test_system, "Reference", settings)
    expected = measurement_module.initial_energy(test_system, "Reference")
    assert measurement_module._energy(test_system, context) == pytest.approx(expected, abs=1e-6)
    context.setVelocities(test_system.velocities)
    assert abs(measurement_module._energy(test_system, context) - expected) > 1e-3
    assert isinstance(integrator, openmm.VerletIntegrator)


def test_quick_settings_keep_the_mean_step():
    for build in SYSTEMS.values():
        full = build().settings
        quick = quick_settings(full)
        assert quick.total_time < full.total_time
        assert quick.total_time / quick.force_evaluations == pytest.approx(
            full.total_time / full.force_evaluations, rel=0.01
        )
        assert quick.force_evaluations >= 100


@pytest.mark.parametrize(
    ("error", "words"), [(0.1, "Variable steps win"), (1.0, "No difference"), (10.0, "Fixed steps win")]
)
def test_verdict_says_who_wins(error, words):
    result = make_comparison(make_run("fixed"), make_run("control"), make_run("vrattle", error))
    assert sum(sentence.startswith(words) for sentence in verdict(result)) == 1


def test_verdict_when_fixed_steps_fail():
    result = make_comparison(make_run("fixed", failure="a"), make_run("control", failure="b"), make_run("vrattle"))
    assert "vrattle reached the end, where no integrator with fixed steps did." in verdict(result)
    assert math.isnan(result.gain(result.runs[2]))


def test_verdict_when_all_fail():
    assert verdict(make_comparison(make_run(failure="a"))) == ["No integrator reached the end.", "fixed failed: a."]


def test_gain():
    result = make_comparison(make_run("fixed", 8.0), make_run("control", 4.0), make_run("vrattle", 2.0))
    assert result.gain(result.runs[2]) == 2.0
    assert result.gain(result.runs[2], "fixed") == 4.0


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (24_567.0, "25,000"),
        (0.0, "0"),
        (1.04, "1"),
        (99.9, "100"),
        (-734.0, "-730"),
        (1.23e-9, "1.2e-09"),
        (math.nan, "-"),
    ],
)
def test_two_digits(value, text):
    assert two_digits(value) == text
    assert two_digits(math.nan) == "-"


def test_envelope_keeps_peaks():
    times = np.linspace(0.0, 10.0, 5001)
    errors = 1e-3 * np.sin(times)
    errors[3333] = -7.0
    steps = np.full(5001, 2e-3)
    steps[1234] = 1e-5
    steps[0] = math.nan
    reduced = envelope(Series(times, errors, steps), 10.0, windows=50)
    assert len(reduced.times) == 50
    assert reduced.largest_energy_errors.min() == -7.0
    assert np.sum(np.abs(reduced.largest_energy_errors) > 1) == 1
    assert np.all(np.abs(reduced.smallest_energy_errors) <= np.abs(reduced.largest_energy_errors))
    assert reduced.smallest_steps.min() == 1e-5
    assert reduced.largest_steps.max() == 2e-3


def test_envelope_leaves_out_empty_windows():
    series = Series(np.array([0.0, 1.0, 9.0]), np.array([0.0, 2.0, 3.0]), np.array([math.nan, 1.0, 8.0]))
    reduced = envelope(series, 10.0, windows=10)
    np.testing.assert_allclose(reduced.times, [1.5, 9.5])
    np.testing.assert_array_equal(reduced.largest_energy_errors, [2.0, 3.0])
    assert len(envelope(Series(*[np.array([])] * 3), 10.0).times) == 0


def test_files(chain, tmp_path):
    write_summary([chain, chain], tmp_path / "summary.csv")
    write_series(chain, tmp_path / "series.csv")
    write_json(chain, tmp_path / "result.json")
    plots.save_comparison(chain, tmp_path / "picture.png")

    with (tmp_path / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * len(chain.runs)
    assert float(rows[0]["largest_energy_error"]) == chain.runs[0].largest_energy_error

    with (tmp_path / "series.csv").open() as file:
        rows = list(csv.DictReader(file))
    for run in chain.runs:
        errors = [abs(float(row["energy_error_kj_per_mol"])) for row in rows if row["integrator"] == run.name]
        if run.failure is None:
            assert max(errors) == pytest.approx(run.largest_energy_error, rel=1e-6)
        else:
            assert errors == []

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    content = json.loads((tmp_path / "result.json").read_text(), parse_constant=refuse)
    assert [run["name"] for run in content["runs"]] == [run.name for run in chain.runs]
    assert content["runs"][1]["largest_energy_error"] is None
    assert content["verdict"] == verdict(chain)
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("width", [80, 200])
def test_table_is_whole(chain, width):
    """No number may be cut, however narrow the window."""
    console = Console(width=width, file=io.StringIO())
    print_comparison(console, chain)
    text = console.file.getvalue()
    assert "…" not in text
    for run in chain.runs:
        assert run.name in text or width > 80  # where it may be on two lines
        assert two_digits(run.largest_energy_error) in text


def test_command_line_writes_files(tmp_path):
    folder = tmp_path / "deep" / "out"
    names = ["double-pendulum", "alanine-dipeptide-allbonds"]
    result = run_command("compare", "--quick", "--system", *names, "--output", str(folder))
    assert result.returncode == 0, result.stderr
    assert "VerletIntegrator" in result.stdout
    assert "VRATTLE, ConstraintMultipliers" in result.stdout
    for name in names:
        assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert json.loads((folder / f"{name}.json").read_text())["system_name"] == name
        assert len((folder / f"{name}-series.csv").read_text().splitlines()) > 100
    with (folder / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["system"] for row in rows} == set(names)
    assert all(row["failure"] == "" for row in rows)


def test_command_line_changes_time_and_evaluations(tmp_path):
    result = run_command(
        *("compare", "--system", "rigid-waters", "--time", "0.1", "--evaluations", "200"), cwd=tmp_path
    )
    assert result.returncode == 0, result.stderr
    content = json.loads((tmp_path / "out" / "rigid-waters.json").read_text())
    assert content["total_time"] == 0.1
    assert content["force_evaluations"] == 200


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--system", "no-such-system"], "there is no system 'no-such-system'"),
        (["--platform", "NoSuchPlatform"], "there is no platform 'NoSuchPlatform'"),
        (["--evaluations", "0"], "force evaluations"),
        (["--time", "-1"], "simulated time"),
        (["--time", "nan"], "simulated time"),
    ],
)
def test_wrong_usage(arguments, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert command_line.main(["compare", *arguments]) == 2
    message = capsys.readouterr().err
    assert message.startswith("error: ")
    assert words in message
    assert len(message.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_folder_that_cannot_be_made(capsys, tmp_path):
    (tmp_path / "file").write_text("")
    assert command_line.main(["compare", "--output", str(tmp_path / "file" / "out")]) == 2
    assert "cannot be made" in capsys.readouterr().err


def test_help_and_version():
    assert "examples:" in run_command("--help").stdout
    assert "double-pendulum" in run_command("compare", "--help").stdout
    assert run_command("--version").stdout.startswith("openmm-vrattle ")


@pytest.mark.skipif(os.name != "posix", reason="needs signals of POSIX")
def test_interrupt_from_the_keyboard(tmp_path):
    """An interrupt during the second system leaves the files of the first."""
    names = ["rigid-waters", "double-pendulum"]
    process = subprocess.Popen(
        [sys.executable, "-m", "openmmvrattle", "compare", "--output", str(tmp_path), "--system", *names],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # A background job of a shell is started with interrupts ignored, and so would be the command.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        deadline = time.monotonic() + 300
        while not (tmp_path / "summary.csv").exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=300)
    finally:
        process.kill()
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert "Interrupted" in output
    assert (tmp_path / "rigid-waters.png").exists()
