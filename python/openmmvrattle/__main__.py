# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The command line: ``python -m openmmvrattle``."""

from __future__ import annotations

import argparse
import importlib.metadata
import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import openmm

from .testsystems import SYSTEMS, ComparisonSettings

if TYPE_CHECKING:
    from .comparison import Comparison, IntegratorRun, Progress

_DEFAULT_SYSTEMS = ("double-pendulum", "alanine-dipeptide-hbonds", "alanine-dipeptide-allbonds")

_WIDTH_OF_TABLE = 160
"""Characters that the table of runs needs with one line for each integrator."""

_EXAMPLES = """examples:
  python -m openmmvrattle compare
      run three systems and write tables and pictures to the folder out
  python -m openmmvrattle compare --system light-heavy-chain --output whip
      run one system
  python -m openmmvrattle compare --system rigid-waters --platform CPU --time 1 --evaluations 2000
      choose platform, simulated time in ps and number of force evaluations
  python -m openmmvrattle compare --quick
      only the first moments of each system, for a look that takes seconds
"""


class _UsageError(Exception):
    """Something on the command line cannot be done; the message says what, in one sentence."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code: 0, 2 for wrong usage, 130 after an interrupt."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.command is None:
        parser.print_help()
        return 0
    try:
        return _compare(options)
    except _UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m openmmvrattle",
        description="Time-reversible variable-step dynamics with constraints for OpenMM.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=_version())
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    compare = commands.add_parser(
        "compare",
        help="compare integrators at an equal number of force evaluations",
        description="Run OpenMM's VerletIntegrator and VariableVerletIntegrator, RATTLE with fixed steps and RATTLE "
        "with variable steps on the same systems, each with the same number of force evaluations, and show how well "
        "they keep the energy.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    compare.add_argument(
        "--system",
        nargs="+",
        default=list(_DEFAULT_SYSTEMS),
        metavar="NAME",
        help="systems to run: " + ", ".join(SYSTEMS) + " (default: " + ", ".join(_DEFAULT_SYSTEMS) + ")",
    )
    compare.add_argument("--platform", default="Reference", metavar="NAME", help="OpenMM platform (default: Reference)")
    compare.add_argument(
        "--output", type=Path, default=Path("out"), metavar="FOLDER", help="folder for the files (default: out)"
    )
    compare.add_argument(
        "--evaluations", type=int, metavar="N", help="force evaluations of each integrator (default: by system)"
    )
    compare.add_argument("--time", type=float, metavar="PS", help="simulated time in ps (default: by system)")
    compare.add_argument("--quick", action="store_true", help="run only the first moments of each system")
    return parser


def _version() -> str:
    try:
        own = importlib.metadata.version("openmm-vrattle")
    except importlib.metadata.PackageNotFoundError:
        own = "not installed"
    return f"openmm-vrattle {own} (OpenMM {openmm.Platform.getOpenMMVersion()})"


def _compare(options: argparse.Namespace) -> int:
    _check(options)
    try:
        from rich.console import Console

        from . import plots
    except ImportError as error:
        raise _UsageError(f"the comparison needs the package {error.name}, which is not installed.") from error
    from .comparison import compare, write_json, write_series, write_summary

    # On a terminal rich finds the width itself; in a file or a pipe the table must not be cut.
    console = Console() if sys.stdout.isatty() else Console(width=_WIDTH_OF_TABLE)
    comparisons = []
    for name in options.system:
        test_system = SYSTEMS[name]()
        settings = _settings(test_system.settings, options)
        with _progress_bar(console, test_system.description) as progress:
            comparison = compare(test_system, options.platform, settings, progress)
        if comparison.runs:
            comparisons.append(comparison)
            _print_comparison(console, comparison)
            write_series(comparison, options.output / f"{name}-series.csv")
            write_json(comparison, options.output / f"{name}.json")
            plots.save_comparison(comparison, options.output / f"{name}.png")
            write_summary(comparisons, options.output / "summary.csv")
        if comparison.interrupted:
            console.print(f"Interrupted; what was done is in {options.output}.", highlight=False, soft_wrap=True)
            return 130
    console.print(f"Tables, courses and pictures are in {options.output}.", highlight=False, soft_wrap=True)
    return 0


def _check(options: argparse.Namespace) -> None:
    for name in options.system:
        if name not in SYSTEMS:
            raise _UsageError(f"there is no system '{name}'; the systems are {', '.join(SYSTEMS)}.")
    platforms = [openmm.Platform.getPlatform(i).getName() for i in range(openmm.Platform.getNumPlatforms())]
    if options.platform not in platforms:
        raise _UsageError(f"there is no platform '{options.platform}' here; the platforms are {', '.join(platforms)}.")
    if options.evaluations is not None and options.evaluations < 10:
        raise _UsageError("the number of force evaluations must be at least 10.")
    if options.time is not None and not 0.0 < options.time < math.inf:
        raise _UsageError("the simulated time must be positive.")
    try:
        options.output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _UsageError(f"the folder {options.output} cannot be made: {error.strerror}.") from error


def _settings(settings: ComparisonSettings, options: argparse.Namespace) -> ComparisonSettings:
    """The settings of a system with what the command line changes; the mean step is kept unless both are given."""
    from .comparison import quick_settings

    total_time, evaluations = settings.total_time, settings.force_evaluations
    if options.time is not None:
        evaluations = max(10, round(evaluations * options.time / total_time))
        total_time = options.time
    if options.evaluations is not None:
        evaluations = options.evaluations
    settings = replace(settings, total_time=total_time, force_evaluations=evaluations)
    return quick_settings(settings) if options.quick else settings


def _progress_bar(console: Any, description: str) -> AbstractContextManager[Progress]:
    """A context that shows a progress bar and gives the function that moves it."""
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as ProgressBar

    @contextmanager
    def bar() -> Iterator[Progress]:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f}% {task.fields[activity]}"),
            TimeElapsedColumn(),
        )
        with ProgressBar(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
            tasks = {}

            def move(name: str, activity: str, fraction: float) -> None:
                if name not in tasks:
                    tasks[name] = progress.add_task(name, total=1.0, activity="")
                progress.update(tasks[name], completed=fraction, activity=activity)

            console.print(f"\n[bold]{description}[/bold]", highlight=False)
            yield move

    return bar()


def _print_comparison(console: Any, comparison: Comparison) -> None:
    """Print the table of a comparison and what it says in words."""
    from rich.table import Table

    from .comparison import verdict

    table = Table(
        title=f"{comparison.system_name}: {comparison.total_time:g} ps, platform {comparison.platform}, "
        f"E(0) = {comparison.initial_energy:.6g} kJ/mol",
        title_justify="left",
    )
    names = [run.name if run.failure is None else f"{run.name} (failed)" for run in comparison.runs]
    measures = [_measures_of(run) for run in comparison.runs]
    styles = [_style_of(run, comparison) for run in comparison.runs]
    if console.width >= _WIDTH_OF_TABLE:
        table.add_column("integrator", no_wrap=True)
        for heading in measures[0]:
            table.add_column(heading, justify="right")
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
    for sentence in verdict(comparison):
        console.print(sentence, highlight=False, soft_wrap=True, markup=False)


def _measures_of(run: IntegratorRun) -> dict[str, str]:
    """What the table shows of a run, by heading."""
    from .comparison import two_digits

    return {
        "largest\nenergy error\n(kJ/mol)": two_digits(run.largest_energy_error),
        "rms\nenergy error\n(kJ/mol)": two_digits(run.rms_energy_error),
        "energy error\nat the end\n(kJ/mol)": two_digits(run.final_energy_error),
        "smallest\nstep\n(ps)": two_digits(run.smallest_step),
        "largest\nstep\n(ps)": two_digits(run.largest_step),
        "force\nevaluations": f"{run.force_evaluations:,}",
        "largest\nconstraint\nerror": two_digits(run.largest_constraint_error),
        "wall time\nper step\n(µs)": f"{run.seconds_per_step * 1e6:.1f}" if run.steps else "-",
        "energy\nsamples": f"{run.energy_samples:,}",
    }


def _style_of(run: IntegratorRun, comparison: Comparison) -> str | None:
    if run.failure is not None:
        return "red"
    return "bold green" if run is comparison.best() else None


if __name__ == "__main__":
    sys.exit(main())
