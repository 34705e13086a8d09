# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Many comparisons at once: equal accuracy, processes, a Dask cluster, interrupts, and the folder of results."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import openmm
import pytest
from openmmvrattle.compare.comparison import Case, compare, run_case, verdict
from openmmvrattle.compare.measurement import (
    ACCURACY_TOLERANCE,
    INTEGRATORS,
    make_integrator,
    methods_of,
    run_method,
    run_to_accuracy,
)
from openmmvrattle.compare.results import ResultFolder, mean_gains
from openmmvrattle.compare.sweep import DaskRunner, ProcessRunner, RunnerError, SerialRunner, run_sweep
from openmmvrattle.testsystems import (
    ComparisonSettings,
    MonitorSettings,
    StepControl,
    light_heavy_chain,
    rigid_waters,
    water_clash,
)
from project_scripts import run_command
from rich.console import Console


def small_case(label="clash", **changes):
    clash = water_clash()
    return Case(clash, replace(clash.settings, total_time=0.05, force_evaluations=200), label=label, **changes)


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "summary.csv").open(newline="") as file:
        return list(csv.DictReader(file))


# ------------------------------------------------------------------------------------------------ integrators by name


def test_integrators_are_chosen_by_name():
    settings = water_clash().settings
    assert [m.method for m in methods_of(settings)] == ["fixed", "variable", "control", "vrattle", "vrattle"]
    assert [m.method for m in methods_of(settings, ["VRATTLE", "RATTLE"])] == ["vrattle", "control"]
    assert set(INTEGRATORS) >= {"VerletIntegrator", "VariableVerletIntegrator", "RATTLE", "VRATTLE", "Automatic"}


def test_runs_have_names_of_their_own():
    one = StepControl((MonitorSettings("ForcePNorm"),), 1e-3)
    controls = (
        one,
        replace(one, update_method="Explicit"),
        replace(one, largest_step_ratio=4.0),
        replace(one, calibration_steps=10),
        StepControl((MonitorSettings("MaxForce"),), 1e-3),
    )
    settings = ComparisonSettings(1.0, 100, controls)
    names = [method.name for method in methods_of(settings)]
    assert len(set(names)) == len(names) == 9
    assert names[-2:] == ["VRATTLE, MaxForce", "VRATTLE, automatic"]
    assert "VRATTLE, ForcePNorm, Explicit" in names


def test_the_custom_integrator_can_be_compared():
    """With the monitors that it has it gives nearly the same energies; what it lacks is a failed run."""
    waters = rigid_waters(2)
    controls = tuple(
        StepControl((MonitorSettings(kind),), 1e-3, update_method="Explicit")
        for kind in ("ForcePNorm", "ConstraintForce")
    )
    controls += (StepControl((MonitorSettings("MaxForce"),), 1e-3),)
    settings = ComparisonSettings(0.2, 200, controls)
    runs = {run.name: run for run in compare(waters, settings=settings, integrators=["VRATTLE", "CustomVRATTLE"]).runs}
    for name, custom in (
        ("VRATTLE, ForcePNorm", "VRATTLE (custom), ForcePNorm"),
        ("VRATTLE, ConstraintForce", "VRATTLE (custom), ConstraintForce, SemiExplicit"),
    ):
        assert runs[custom].failure is None
        assert runs[custom].largest_energy_error == pytest.approx(runs[name].largest_energy_error, rel=0.1)
    assert "MaxForce" in runs["VRATTLE (custom), MaxForce"].failure


def test_a_long_name_does_not_cut_a_column(clash_result):
    from openmmvrattle.compare.commands.compare import print_comparison

    run = replace(
        clash_result.runs[0], name="an integrator with a name that goes on and on and on", failure="it failed"
    )
    console = Console(width=160, file=io.StringIO())
    print_comparison(console, replace(clash_result, runs=(run, *clash_result.runs[1:])))
    assert "…" not in console.file.getvalue()


def test_reference_values_are_set():
    control = StepControl((MonitorSettings("ForcePNorm"),), 1e-3, reference_values=(123.0,))
    assert make_integrator(control).getReferenceMonitorValue(0) == 123.0


# ------------------------------------------------------------------------------------------------------ equal accuracy


def test_equal_accuracy():
    """The number that is found is enough, a few per cent less are not, and it grows with the root of the accuracy."""
    chain = light_heavy_chain()
    settings = replace(chain.settings, force_evaluations=4000)
    numbers = []
    for wanted in (4e-3, 1e-3):
        method = methods_of(settings, ["RATTLE"])[0]
        run = run_to_accuracy(method, chain, "Reference", settings, wanted)
        assert run.failure is None
        assert 0.8 * wanted < run.largest_energy_error <= wanted
        fewer = replace(settings, force_evaluations=round(run.force_evaluations * (1 - 2 * ACCURACY_TOLERANCE)))
        poorer = run_method(methods_of(fewer, ["RATTLE"])[0], chain, "Reference", fewer)
        assert poorer.largest_energy_error > wanted
        numbers.append(run.force_evaluations)
    assert numbers[1] / numbers[0] == pytest.approx(2.0, rel=0.1)


@pytest.mark.parametrize("name", ["VariableVerletIntegrator", "VRATTLE"])
def test_equal_accuracy_of_variable_steps(name):
    clash = water_clash()
    method = methods_of(clash.settings, [name])[0]
    run = run_to_accuracy(method, clash, "Reference", clash.settings, 10.0)
    assert run.failure is None
    assert 1.0 < run.largest_energy_error <= 10.0


def test_accuracy_that_is_too_much_to_ask():
    clash = water_clash()
    method = methods_of(clash.settings, ["RATTLE"])[0]
    run = run_to_accuracy(method, clash, "Reference", clash.settings, 1e-9, most_evaluations=3000)
    assert re.match(
        r"it needs more than 3,000 force evaluations; with [23],?\d+ its largest energy error is", run.failure
    )


def test_comparison_at_equal_accuracy():
    chain = light_heavy_chain()
    settings = replace(chain.settings, total_time=20.0, force_evaluations=4000)
    result = compare(chain, settings=settings, integrators=["RATTLE", "VRATTLE"], wanted_error=1e-2)
    fixed, variable = result.runs
    assert result.saving(variable) == fixed.force_evaluations / variable.force_evaluations > 5
    assert result.best() is variable
    sentences = " ".join(verdict(result))
    assert "Fewest force evaluations for an energy error of 0.01 kJ/mol: VRATTLE" in sentences
    assert "their force evaluations divided by its own" in sentences


# ----------------------------------------------------------------------------------------------- several processes


def numbers_of(comparisons):
    return [
        (c.label, run.name, run.largest_energy_error, run.steps, run.failure) for c in comparisons for run in c.runs
    ]


def test_processes_give_the_same_results():
    cases = [small_case("one"), small_case("two", integrators=("RATTLE", "VRATTLE"), seed=3)]
    order = []
    serial, interrupted = run_sweep(cases, SerialRunner())
    assert not interrupted
    parallel, interrupted = run_sweep(cases, ProcessRunner(2), finished=lambda index, comparison: order.append(index))
    assert not interrupted
    assert numbers_of(parallel) == numbers_of(serial)
    assert sorted(order) == [0, 1]
    assert [len(c.runs) for c in parallel] == [5, 2]
    for one, other in zip(parallel[0].runs, serial[0].runs, strict=True):
        assert np.array_equal(one.series.energy_errors, other.series.energy_errors)


class _EndsTheProcess:
    """Ends the process that unpickles it, as a crash does."""

    def __reduce__(self):
        return exec, ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)",)


def deadly(case):
    return replace(case, test_system=replace(case.test_system, topology=_EndsTheProcess()))


def test_a_process_that_dies_is_a_failed_run():
    good, bad = small_case("good", integrators=("RATTLE",)), small_case("bad", integrators=("RATTLE",))
    results, _ = run_sweep([deadly(bad), good], ProcessRunner(2))
    assert results[0].runs[0].failure == "its process ended by signal SIGKILL"
    assert results[1].runs[0].failure is None


def test_an_integrator_that_cannot_be_made_is_a_failed_run():
    case = small_case()
    broken = StepControl((MonitorSettings("NoSuchMonitor"),), 1e-3)
    case = replace(case, settings=replace(case.settings, controls=(broken,)), wanted_error=10.0)
    results, _ = run_sweep([case], SerialRunner())
    assert "NoSuchMonitor" in results[0].runs[3].failure
    assert results[0].runs[2].failure is None


def test_progress_is_told_from_other_processes():
    seen = []
    run_sweep([small_case(integrators=("RATTLE",))], ProcessRunner(1), lambda *report: seen.append(report))
    assert seen[0] == ((0, 0), "starting", 0.0)
    assert ((0, 0), "done", 1.0) in seen
    assert any(activity == "running" for _, activity, _ in seen)


# ------------------------------------------------------------------------------------------------------ a Dask cluster


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0"
    ) as local_cluster:
        yield local_cluster


def test_a_cluster_gives_the_same_results(cluster):
    cases = [small_case("one"), small_case("two", integrators=("RATTLE",))]
    serial, _ = run_sweep(cases, SerialRunner())
    runner = DaskRunner(cluster.scheduler_address)
    assert runner.workers == 2
    distributed_ones, interrupted = run_sweep(cases, runner)
    assert not interrupted
    assert numbers_of(distributed_ones) == numbers_of(serial)


@pytest.mark.parametrize(("threads", "deadly_one"), [(1, 0), (2, 1)])
def test_a_worker_that_dies_is_a_failed_run(threads, deadly_one):
    """Dask tries again and gives up, and only on the run that is to blame: the others are lost with it at first.

    On a single worker all of them are: they run or wait there, or their results do.
    """
    distributed = pytest.importorskip("distributed")
    cases = [small_case(label, integrators=("RATTLE",)) for label in ("one", "two")]
    cases[deadly_one] = deadly(cases[deadly_one])
    with distributed.LocalCluster(n_workers=1, threads_per_worker=threads, dashboard_address=":0") as local_cluster:
        results, _ = run_sweep(cases, DaskRunner(local_cluster.scheduler_address))
    for index, result in enumerate(results):
        if index == deadly_one:
            assert "died" in result.runs[0].failure
        else:
            assert result.runs[0].failure is None


NO_WORD = "the cluster has no word of its result"


@pytest.mark.parametrize(("times", "failure"), [(1, None), (100, "scheduler-connection-lost"), (100, NO_WORD)])
@pytest.mark.parametrize("error", ["CancelledError", "TimeoutError"])
def test_a_run_that_is_cancelled_is_begun_again(monkeypatch, times, failure, error):
    """As all are when the scheduler is started anew, or of whose result there is no word; but not for ever."""
    distributed = pytest.importorskip("distributed")

    runner = DaskRunner.__new__(DaskRunner)
    runner._client = SimpleNamespace(close=lambda: None)
    cases = [small_case("one", integrators=("RATTLE",)), small_case("two", integrators=("RATTLE",))]
    begun = []

    def outcomes(self, sent, works):
        begun.append(list(works))
        for work in works:
            cancelled = work == (1, 0) and len(begun) <= times
            lost = getattr(distributed, error)(*([failure] if failure != NO_WORD else []))
            yield work, lost if cancelled else run_case(cases[work[0]], work[1])

    monkeypatch.setattr(DaskRunner, "_outcomes", outcomes)
    results, _ = run_sweep(cases, runner)
    assert [result.runs[0].failure for result in results] == [None, failure]
    assert begun == [[(0, 0), (1, 0)]] + [[(1, 0)]] * (1 if failure is None else 3)


def test_the_command_line_on_a_cluster(cluster, tmp_path):
    result = run_command(
        *("compare", "--system", "water-clash", "--time", "0.05", "--seeds", "1", "2"),
        *("--integrators", "RATTLE", "VRATTLE", "--scheduler", cluster.scheduler_address, "--output", str(tmp_path)),
    )
    assert result.returncode == 0, result.stderr
    assert re.search(r"[12] worker\(s\)", result.stdout)  # the second may still be starting
    assert [row["name"] for row in rows_of(tmp_path)] == ["RATTLE, fixed steps", "VRATTLE, ForcePNorm^0.5"]


def test_no_scheduler():
    pytest.importorskip("distributed")
    with pytest.raises(RunnerError, match="there is no Dask scheduler at tcp://127.0.0.1:9"):
        DaskRunner("tcp://127.0.0.1:9", timeout=1)


def test_dask_that_is_not_installed(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(RunnerError, match=re.escape('pip install "openmm-vrattle[compare]"')):
        DaskRunner("tcp://127.0.0.1:9")


@pytest.mark.parametrize(
    ("answer", "words"), [("0.0.1", "has openmm-vrattle 0.0.1, but this"), (ImportError(), "has no openmm-vrattle")]
)
def test_workers_with_other_versions_are_refused(answer, words):
    class Client:
        def run(self, function, package, on_error):
            return {"tcp://worker": answer}

    runner = DaskRunner.__new__(DaskRunner)
    runner._client = Client()
    with pytest.raises(RunnerError, match=words):
        runner._check_versions()


# ------------------------------------------------------------------------------------------------------ interrupts


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs the list of processes of Linux")
@pytest.mark.parametrize("whom", ["the command alone", "all processes, as Ctrl-C does"])
def test_interrupt_of_several_processes(tmp_path, whom):
    """What was finished stays, no process is left behind, and nothing but words is shown."""
    process = subprocess.Popen(
        [
            *(sys.executable, "-m", "openmmvrattle", "compare", "--output", str(tmp_path), "--jobs", "2"),
            *("--system", "water-clash", "double-pendulum", "--evaluations", "3000000"),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # A background job of a shell is started with interrupts ignored, and so would be the command.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        # The command, the process from which others are copied, the one that watches over resources, and two at work.
        deadline = time.monotonic() + 300
        while _processes_of(process.pid) < 5:
            assert time.monotonic() < deadline and process.poll() is None
            time.sleep(0.05)
        time.sleep(0.5)
        if whom == "the command alone":
            process.send_signal(signal.SIGINT)
        else:
            os.killpg(process.pid, signal.SIGINT)
        output, errors = process.communicate(timeout=300)
        assert process.returncode == 130, errors
        assert "Interrupted" in output
        assert "Traceback" not in errors
        deadline = time.monotonic() + 120
        while _group_lives(process.pid):
            assert time.monotonic() < deadline, "a process was left behind"
            time.sleep(0.1)
    finally:
        if _group_lives(process.pid):
            os.killpg(process.pid, signal.SIGKILL)


def _processes_of(group: int) -> int:
    number = 0
    for process in Path("/proc").glob("[0-9]*"):
        try:
            # After the name, which stands in brackets: state, parent, group.
            number += int((process / "stat").read_text().rpartition(")")[2].split()[2]) == group
        except (OSError, IndexError):  # it has ended meanwhile
            continue
    return number


def _group_lives(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_interrupt_keeps_the_runs_that_were_done(tmp_path):
    """Of two cases the first is finished, the second has one run, and a third none."""
    cases = [small_case(label, integrators=("RATTLE", "VRATTLE")) for label in ("first", "second", "third")]
    folder = ResultFolder(tmp_path)

    def interrupt(work, activity, fraction):
        if work == (1, 1):
            raise KeyboardInterrupt

    results, interrupted = run_sweep(cases, SerialRunner(), interrupt, folder.add)
    assert interrupted
    assert [(c.label, len(c.runs), c.interrupted) for c in results] == [("first", 2, False), ("second", 1, True)]
    assert len(rows_of(tmp_path)) == 3
    assert "The comparison was interrupted" in (tmp_path / "report.html").read_text()
    assert json.loads((tmp_path / "second.json").read_text())["interrupted"] is True


# ------------------------------------------------------------------------------------------------------ results


@pytest.fixture(scope="module")
def clash_result():
    return run_sweep([small_case()], SerialRunner())[0][0]


def test_folder_of_results(tmp_path, clash_result):
    folder = ResultFolder(tmp_path / "deep" / "folder", command="python -m openmmvrattle compare <here>")
    folder.add(0, clash_result)
    folder.add(1, replace(clash_result, label="<b>& again", seed=2))
    index = json.loads((folder.path / "comparison.json").read_text())
    assert all((folder.path / file).exists() for file in index["files"])
    report = (folder.path / "report.html").read_text()
    assert report.count("data:image/png;base64,") == 2
    assert "&lt;here&gt;" in report and "<here>" not in report
    assert "&lt;b&gt;&amp; again" in report and "<b>&" not in report
    for run in clash_result.runs:
        assert run.name in report
    assert "Gains over RATTLE with fixed steps" in report
    assert [row["seed"] for row in rows_of(folder.path)] == [""] * 5 + ["2"] * 5


def test_earlier_results_are_moved_aside(tmp_path, clash_result):
    """And nothing else that lies in the folder."""
    (tmp_path / "mine.csv").write_text("mine")
    ResultFolder(tmp_path).add(0, clash_result)
    first = (tmp_path / "clash.json").read_text()
    again = ResultFolder(tmp_path)
    assert again.moved_to == tmp_path / "earlier-1"
    assert (tmp_path / "earlier-1" / "clash.json").read_text() == first
    assert sorted(path.name for path in tmp_path.iterdir()) == ["earlier-1", "mine.csv"]
    again.add(0, clash_result)
    assert ResultFolder(tmp_path).moved_to == tmp_path / "earlier-2"


def test_earlier_results_can_be_replaced(tmp_path, clash_result):
    ResultFolder(tmp_path).add(0, clash_result)
    again = ResultFolder(tmp_path, overwrite=True)
    assert again.moved_to is None
    assert list(tmp_path.iterdir()) == []


def test_mean_gains(clash_result):
    """The geometric mean over the starts; failed ones are counted and left out."""
    control = next(run for run in clash_result.runs if run.method == "control")
    variable = next(run for run in clash_result.runs if run.method == "vrattle")
    starts = []
    for gain in (2.0, 8.0, None):
        run = replace(variable, largest_energy_error=control.largest_energy_error / (gain or 1.0))
        starts.append(replace(clash_result, runs=(control, replace(run, failure=None if gain else "it failed"))))
    (row,) = mean_gains(starts)
    assert (row.starts, row.failures) == (3, 1)
    assert row.mean == pytest.approx(4.0)
    assert (row.smallest, row.largest) == (pytest.approx(2.0), pytest.approx(8.0))
    saved = [replace(start, wanted_error=1.0) for start in starts]
    assert mean_gains(saved)[0].mean == pytest.approx(control.force_evaluations / variable.force_evaluations)


def test_a_sweep_over_systems_starts_and_steps(tmp_path):
    result = run_command(
        *("compare", "--system", "rigid-waters", "water-clash", "--seeds", "1", "2", "--evaluations", "100", "200"),
        *("--time", "0.1", "--integrators", "rattle", "vrattle", "--monitors", "ForcePNorm^0.5"),
        *("--updates", "Explicit", "Bounded", "--jobs", "2", "--output", str(tmp_path)),
    )
    assert result.returncode == 0, result.stderr
    rows = rows_of(tmp_path)
    assert {(row["system"], row["seed"], row["evaluations_asked_for"]) for row in rows} == {
        *(("rigid-waters", seed, number) for seed in "12" for number in ("100", "200")),
        *(("water-clash", "", number) for number in ("100", "200")),
    }
    assert len(rows) == 6 * 3
    energies = {row["largest_energy_error"] for row in rows if row["system"] == "rigid-waters"}
    assert len(energies) == 12  # each start is another one
    assert "geometric mean over the starts" in result.stdout
    assert (tmp_path / "rigid-waters-seed-2-200.png").exists()


def test_all_systems_are_known_by_one_name():
    from openmmvrattle.__main__ import _parser
    from openmmvrattle.compare.commands import compare as command
    from openmmvrattle.testsystems import SYSTEMS

    options = _parser().parse_args(["compare", "--system", "all"])
    command._check(options)
    assert options.system == list(SYSTEMS)


def test_failure_to_compute_the_first_energy():
    """A System that cannot be run at all gives rows with the reason and no energy."""
    waters = rigid_waters(1)
    force = openmm.CustomExternalForce("no_such_parameter*x")
    force.addParticle(0, [])
    waters.system.addForce(force)
    (result,), _ = run_sweep([Case(waters, waters.settings)], SerialRunner())
    assert all("no_such_parameter" in run.failure for run in result.runs)
    assert math.isnan(result.initial_energy)
    assert verdict(result)[0] == "No integrator reached the end."
