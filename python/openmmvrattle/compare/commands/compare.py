# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The command ``compare``: integrators side by side on chosen systems."""

from __future__ import annotations

import argparse
import math
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...testsystems import SYSTEMS, ComparisonSettings, StepControl, TestSystem
from .. import require
from .systems import (
    MONITORS,
    UPDATES,
    UsageError,
    add_system_arguments,
    check_platform,
    chosen,
    has_own_system,
    has_seed,
    monitors_from,
    named_system,
    own_system,
)

if TYPE_CHECKING:
    from ..comparison import Case, Comparison
    from ..measurement import IntegratorRun
    from ..sweep import Runner, SweepProgress, Work

DEFAULT_SYSTEMS = ("double-pendulum", "alanine-dipeptide-hbonds", "alanine-dipeptide-allbonds")

_WIDTH_OF_TABLE = 160
"""Characters that the table of runs needs with one line for each integrator."""
_MOST_TABLES = 4
"""A sweep over more cases shows one line for each on the terminal, and the tables in the report."""

EXAMPLES = """examples:
  python -m openmmvrattle compare
      run three systems; tables on the terminal, files and a report in the folder out
  python -m openmmvrattle compare --system light-heavy-chain --output whip
      run one system
  python -m openmmvrattle compare --pdb protein.pdb --forcefield amber14-all.xml implicit/gbn2.xml --time 1
      a molecule of your own; --xml system.xml --state state.xml takes any OpenMM System and start
  python -m openmmvrattle compare --system water-clash --monitors ForcePNorm^0.5 MaxForce --updates Explicit Bounded
      choose monitors and updates; --bounds 0.01 30 sets the steps' bounds relative to the nominal step
  python -m openmmvrattle compare --system light-heavy-chain --accuracy 1e-3 1e-5
      how many force evaluations each integrator needs for these energy errors
  python -m openmmvrattle compare --system rigid-waters water-clash --seeds 1 2 3 4 --evaluations 1000 2000 --jobs 2
      a sweep over systems, starts and steps in two processes; --scheduler tcp://host:8786 sends it to a Dask cluster
  python -m openmmvrattle compare --quick
      only the first moments of each system, for a look that takes seconds
"""


def add_parser(commands: Any) -> None:
    """Add the command to the command line."""
    parser = commands.add_parser(
        "compare",
        help="compare integrators at equal force evaluations or equal accuracy",
        description="Run OpenMM's VerletIntegrator and VariableVerletIntegrator, RATTLE with fixed steps and RATTLE "
        "with variable steps (VRATTLE) on the same systems, each with the same number of force evaluations (or for the "
        "same energy error), and show how well they keep the energy.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument(
        "--system",
        nargs="+",
        default=None,
        metavar="NAME",
        help="systems to run, or all: " + ", ".join(SYSTEMS) + " (default: " + ", ".join(DEFAULT_SYSTEMS) + ")",
    )
    add_system_arguments(parser)
    what = parser.add_argument_group("what is compared")
    what.add_argument(
        "--integrators",
        nargs="+",
        metavar="NAME",
        help="VerletIntegrator, VariableVerletIntegrator, RATTLE (fixed steps), VRATTLE (with monitors), Automatic "
        "(VRATTLE with automatic step control), CustomVRATTLE (the class in Python alone, for every platform); "
        "default: all but the last",
    )
    what.add_argument(
        "--monitors",
        nargs="+",
        metavar="MONITOR",
        help="monitors of VRATTLE, each one run of its own: KIND, KIND^POWER, or several joined by +; kinds: "
        + ", ".join(MONITORS)
        + " (default: by system)",
    )
    what.add_argument(
        "--updates",
        nargs="+",
        metavar="NAME",
        help="updates of VRATTLE: " + ", ".join(UPDATES) + " (default: by system)",
    )
    what.add_argument(
        "--bounds",
        nargs=2,
        type=float,
        metavar=("SMALLEST", "LARGEST"),
        help="bounds of the steps divided by the nominal step, 0 for none (default: by system)",
    )
    what.add_argument(
        "--calibrate", type=int, metavar="N", help="take the monitor's reference value from N trial steps, which count"
    )
    how = parser.add_argument_group("how long and how fine")
    how.add_argument("--time", type=float, metavar="PS", help="simulated time in ps (default: by system)")
    fineness = how.add_mutually_exclusive_group()
    fineness.add_argument(
        "--evaluations",
        type=int,
        nargs="+",
        metavar="N",
        help="force evaluations of each integrator; several make a sweep (default: by system)",
    )
    fineness.add_argument(
        "--step", type=float, nargs="+", metavar="PS", help="instead of --evaluations: mean steps in ps"
    )
    fineness.add_argument(
        "--accuracy",
        type=float,
        nargs="+",
        metavar="KJ",
        help="instead: find the force evaluations that each needs for these largest energy errors, in kJ/mol",
    )
    how.add_argument(
        "--most-evaluations",
        type=int,
        metavar="N",
        help="with --accuracy: give up beyond (default: 20 times the evaluations of the system)",
    )
    how.add_argument("--seeds", type=int, nargs="+", metavar="N", help="seeds of random starts; several make a sweep")
    how.add_argument("--quick", action="store_true", help="run only the first moments of each system")
    where = parser.add_argument_group("where it runs and what it writes")
    where.add_argument(
        "--jobs", type=int, default=1, metavar="N", help="runs at the same time on this machine (default: 1)"
    )
    where.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="run on the Dask cluster with this scheduler, such as tcp://host:8786 (needs the extra `compare`)",
    )
    where.add_argument(
        "--output", type=Path, default=Path("out"), metavar="FOLDER", help="folder for the files (default: out)"
    )
    where.add_argument(
        "--overwrite", action="store_true", help="replace earlier results in the folder instead of moving them aside"
    )


def run(options: argparse.Namespace) -> int:
    """Carry the command out and return the exit code."""
    _check(options)
    require("this command", "matplotlib", "rich")
    from rich.console import Console

    from ..results import ResultFolder
    from ..sweep import run_sweep

    # On a terminal rich finds the width itself; in a file or a pipe the table must not be cut.
    console = Console() if sys.stdout.isatty() else Console(width=_WIDTH_OF_TABLE)
    runner = _runner(options, console)
    cases = _cases(options)
    try:
        folder = ResultFolder(options.output, _command_line(), options.overwrite)
    except OSError as error:
        raise UsageError(f"the folder {options.output} cannot be made: {error.strerror}.") from error
    if folder.moved_to is not None:
        console.print(f"Earlier results were moved to {folder.moved_to}.", highlight=False, soft_wrap=True)
    with _progress_bars(console, cases) as progress:

        def finished(index: int, comparison: Comparison) -> None:
            folder.add(index, comparison)
            if comparison.runs and len(cases) <= _MOST_TABLES:
                print_comparison(console, comparison)
            elif comparison.runs:
                _print_line(console, comparison)

        _, interrupted = run_sweep(cases, runner, progress, finished)
    if len(cases) > 1:
        print_gains(console, folder.comparisons())
    if interrupted:
        done = f"what was done is in {options.output}" if folder.comparisons() else "nothing was finished yet"
        console.print(f"Interrupted; {done}.", highlight=False, soft_wrap=True)
        return 130
    console.print(
        f"Tables, courses and pictures are in {options.output}; to read: {options.output / 'report.html'}.",
        highlight=False,
        soft_wrap=True,
    )
    return 0


def _command_line() -> str:
    return shlex.join(["python", "-m", "openmmvrattle", *sys.argv[1:]])


# ------------------------------------------------------------------------------------------------- what was asked for


def _check(options: argparse.Namespace) -> None:
    """Raise a UsageError for whatever cannot be done, before anything is run or written."""
    from ..measurement import INTEGRATORS

    if options.system is not None:
        names = SYSTEMS if "all" in options.system else options.system
        options.system = list(dict.fromkeys(chosen(name, SYSTEMS, "system") for name in names))
    check_platform(options)
    if options.integrators is not None:
        options.integrators = [chosen(name, INTEGRATORS, "integrator") for name in options.integrators]
    if options.updates is not None:
        options.updates = [chosen(name, UPDATES, "update") for name in options.updates]
    if options.monitors is not None:
        options.monitors = [monitors_from(text) for text in options.monitors]
    if options.evaluations is not None and min(options.evaluations) < 10:
        raise UsageError("the number of force evaluations must be at least 10.")
    for values, what in (
        ([options.time], "the simulated time"),
        (options.step or [], "the step"),
        (options.accuracy or [], "the energy error"),
        ([options.cutoff], "the cutoff"),
    ):
        if any(value is not None and not 0.0 < value < math.inf for value in values):
            raise UsageError(f"{what} must be positive.")
    if options.bounds is not None:
        smallest, largest = options.bounds
        if not (0.0 <= smallest < 1.0 and (largest == 0.0 or 1.0 < largest < math.inf)):
            raise UsageError(
                "the bounds must be below 1 and above 1: they are relative to the nominal step; 0 for none."
            )
    if options.calibrate is not None and options.calibrate < 1:
        raise UsageError("the number of trial steps must be at least 1.")
    if options.jobs < 1:
        raise UsageError("the number of jobs must be at least 1.")
    if options.jobs > 1 and options.scheduler is not None:
        raise UsageError("give either --jobs or --scheduler: on a cluster its workers decide how much runs at a time.")
    if has_own_system(options) and options.quick:
        raise UsageError("--quick is for the systems that come with the package; give --time for your own.")


def _runner(options: argparse.Namespace, console: Any) -> Runner:
    from ..sweep import DaskRunner, ProcessRunner, RunnerError, SerialRunner

    if options.scheduler is not None:
        try:
            runner = DaskRunner(options.scheduler)
        except RunnerError as error:
            raise UsageError(str(error)) from error
        words = f"{runner.workers} worker(s)" if runner.workers else "no workers yet; it starts as soon as one is there"
        console.print(f"Dask cluster at {options.scheduler}: {words}.", highlight=False, soft_wrap=True)
        return runner
    return ProcessRunner(options.jobs) if options.jobs > 1 else SerialRunner()


def _cases(options: argparse.Namespace) -> list[Case]:
    """All comparisons that were asked for: systems times starts times numbers of evaluations."""
    starts: list[tuple[TestSystem, str, int | None]] = []
    if has_own_system(options):
        for seed in options.seeds or (None,):
            system, platform = own_system(options, 1 if seed is None else seed)
            starts.append((system, platform, seed))
    for name in options.system or (() if starts else DEFAULT_SYSTEMS):
        for seed in (options.seeds if has_seed(name) else None) or (None,):
            starts.append((named_system(name, seed), options.platform or "Reference", seed))
    return [case for start in starts for case in _cases_of(*start, options)]


def _cases_of(system: TestSystem, platform: str, seed: int | None, options: argparse.Namespace) -> list[Case]:
    from ..comparison import Case

    cases = []
    for settings, asked in _settings(system.settings, options):
        label = system.name + (f"-seed-{seed}" if seed is not None else "") + (f"-{asked}" if asked else "")
        if options.accuracy is None:
            wanted = None
        else:
            wanted = float(asked) if asked else options.accuracy[0]
        cases.append(
            Case(
                system,
                replace(settings, controls=_controls(settings, options)),
                platform,
                tuple(options.integrators or ()),
                wanted,
                options.most_evaluations,
                label,
                seed,
            )
        )
    return cases


def _settings(settings: ComparisonSettings, options: argparse.Namespace) -> list[tuple[ComparisonSettings, str]]:
    """The settings of a system with what the command line changes, and what sets each apart from the others.

    The mean step is kept where only the time is given.
    """
    from ..comparison import quick_settings

    total_time, evaluations = settings.total_time, settings.force_evaluations
    if options.time is not None:
        evaluations = max(10, round(evaluations * options.time / total_time))
        total_time = options.time
    numbers = [evaluations]
    if options.evaluations is not None:
        numbers = list(dict.fromkeys(options.evaluations))
    elif options.step is not None:
        numbers = list(dict.fromkeys(max(10, round(total_time / step)) for step in options.step))
    variants = [
        (replace(settings, total_time=total_time, force_evaluations=number), str(number) if len(numbers) > 1 else "")
        for number in numbers
    ]
    if options.accuracy is not None:
        wanted = list(dict.fromkeys(options.accuracy))
        variants = [(variants[0][0], f"{error:g}" if len(wanted) > 1 else "") for error in wanted]
    if options.quick:
        variants = [(quick_settings(variant), asked) for variant, asked in variants]
    return variants


def _controls(settings: ComparisonSettings, options: argparse.Namespace) -> tuple[StepControl, ...]:
    """The step controls of VRATTLE: those of the system, with what the command line changes."""
    first = settings.controls[0] if settings.controls else StepControl((), 1e-3)
    controls = list(settings.controls)
    if options.monitors is not None:
        step = settings.total_time / settings.force_evaluations
        controls = [replace(first, monitors=monitors, nominal_step_size=step) for monitors in options.monitors]
    if options.updates is not None:
        controls = [replace(control, update_method=update) for control in controls for update in options.updates]
    if options.bounds is not None:
        smallest, largest = options.bounds
        controls = [replace(c, smallest_step_ratio=smallest, largest_step_ratio=largest) for c in controls]
    if options.calibrate is not None:
        controls = [replace(control, calibration_steps=options.calibrate) for control in controls]
    return tuple(dict.fromkeys(controls))


# ------------------------------------------------------------------------------------------------ what is shown


@contextmanager
def _progress_bars(console: Any, cases: Sequence[Case]) -> Iterator[SweepProgress]:
    """Show one bar for all runs and one for each that is running; gives the function that moves them."""
    from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f}% {task.fields[activity]}"),
        TimeElapsedColumn(),
    )
    names = [[method.name for method in case.methods()] for case in cases]
    total = sum(map(len, names))
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bars:
        overall = bars.add_task("all runs", total=total, activity=f"0 of {total}")
        tasks: dict[Work, TaskID] = {}
        done: set[Work] = set()

        def move(work: Work, activity: str, fraction: float) -> None:
            if work in done:
                return
            if activity == "done":
                done.add(work)
                bars.update(overall, completed=len(done), activity=f"{len(done)} of {total}")
                if work in tasks:
                    bars.remove_task(tasks.pop(work))
                return
            if work not in tasks:
                description = f"{cases[work[0]].label}: {names[work[0]][work[1]]}"
                tasks[work] = bars.add_task(description, total=1.0, activity="")
            bars.update(tasks[work], completed=fraction, activity=activity)

        yield move


def print_comparison(console: Any, comparison: Comparison) -> None:
    """Print the table of a comparison and what it says in words."""
    from rich.table import Table

    from ..comparison import two_digits, verdict
    from ..results import measures_of

    console.print(f"\n{comparison.description}", style="bold", highlight=False, markup=False)
    seed = "" if comparison.seed is None else f", seed {comparison.seed}"
    wanted = comparison.wanted_error
    accuracy = "" if wanted is None else f", largest energy error {two_digits(wanted)} kJ/mol"
    title = f"{comparison.system_name}: {comparison.total_time:g} ps, platform {comparison.platform}{seed}{accuracy}"
    table = Table(title=f"{title}, E(0) = {comparison.initial_energy:.6g} kJ/mol", title_justify="left")
    names = [run.name if run.failure is None else f"{run.name} (failed)" for run in comparison.runs]
    measures = [measures_of(run) for run in comparison.runs]
    styles = [_style_of(run, comparison) for run in comparison.runs]
    if console.width >= _WIDTH_OF_TABLE:
        table.add_column("integrator", overflow="fold")
        for heading in measures[0]:
            table.add_column(heading, justify="right", no_wrap=True)
        for name, values, style in zip(names, measures, styles, strict=True):
            table.add_row(name, *values.values(), style=style)
    else:
        # A narrow window: a column for each integrator, under its number.
        table.add_column("")
        for number, style in enumerate(styles, 1):
            table.add_column(str(number), justify="right", style=style)
        for heading in measures[0]:
            table.add_row(heading.replace("\n", " "), *(values[heading] for values in measures))
    console.print(table)
    if console.width < _WIDTH_OF_TABLE:
        for number, (name, style) in enumerate(zip(names, styles, strict=True), 1):
            console.print(f"{number}: {name}", style=style, highlight=False, markup=False)
    for sentence in [*comparison.notes, *verdict(comparison)]:
        console.print(sentence, highlight=False, soft_wrap=True, markup=False)


def _print_line(console: Any, comparison: Comparison) -> None:
    """Print the best of a comparison in one line."""
    from ..comparison import two_digits

    best = comparison.best()
    words = "no integrator reached the end"
    if best is not None:
        words = (
            f"{best.name}, {two_digits(best.largest_energy_error)} kJ/mol with {best.force_evaluations:,} evaluations"
        )
    console.print(f"{comparison.label}: best {words}", highlight=False, soft_wrap=True, markup=False)


def print_gains(console: Any, comparisons: Sequence[Comparison]) -> None:
    """Print the gains over RATTLE with fixed steps, as means over the starts of each system."""
    from rich.table import Table

    from ..results import gain_rows

    headings, rows = gain_rows(comparisons)
    if not rows:
        return
    table = Table(title="Gain over RATTLE with fixed steps, geometric mean over the starts", title_justify="left")
    for number, heading in enumerate(headings):
        table.add_column(heading, justify="left" if number in (0, 2) else "right", overflow="fold")
    for row in rows:
        table.add_row(*row)
    console.print()
    console.print(table)


def _style_of(run: IntegratorRun, comparison: Comparison) -> str | None:
    if run.failure is not None:
        return "red"
    return "bold green" if run is comparison.best() else None
