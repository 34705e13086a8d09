# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The command ``advise``: would variable steps pay on a system, and with which settings?"""

from __future__ import annotations

import argparse
import csv
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...testsystems import SYSTEMS, TestSystem
from .. import require
from .systems import (
    UsageError,
    add_system_arguments,
    check_platform,
    chosen,
    has_own_system,
    monitors_from,
    named_system,
    own_system,
)

if TYPE_CHECKING:
    from ..advice import Advice

EXAMPLES = """examples:
  python -m openmmvrattle advise --system water-clash
      a system that comes with the package
  python -m openmmvrattle advise --pdb protein.pdb --step 0.002 --steps 5000
      a molecule of your own, with the step that you would take
  python -m openmmvrattle advise --xml system.xml --state state.xml --check --output advice
      any OpenMM System and start; measure the gain as well, and write tables and a picture
"""


def add_parser(commands: Any) -> None:
    """Add the command to the command line."""
    parser = commands.add_parser(
        "advise",
        help="would variable steps pay on your system, and with which settings?",
        description="Run a trial with fixed steps, look at the energy error and at every monitor along it, and say "
        "whether variable steps would pay, with which monitor, nominal step and bounds.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument("--system", metavar="NAME", help="a system of ours: " + ", ".join(SYSTEMS))
    add_system_arguments(parser)
    trial = parser.add_argument_group("the trial")
    trial.add_argument("--step", type=float, metavar="PS", help="its fixed step in ps (default: 0.001, or by system)")
    trial.add_argument("--steps", type=int, metavar="N", help="its number of steps (default: 2000, or by system)")
    trial.add_argument("--seed", type=int, metavar="N", help="seed of a random start")
    trial.add_argument(
        "--monitors", nargs="+", metavar="MONITOR", help="judge only these: KIND or KIND^POWER (default: all)"
    )
    trial.add_argument(
        "--bounds",
        nargs=2,
        type=float,
        action="append",
        metavar=("SMALLEST", "LARGEST"),
        help="judge these bounds of the steps, divided by the nominal step, 0 for none; can be given more than once",
    )
    parser.add_argument(
        "--check", action="store_true", help="run the best settings too, and measure the gain over the trial"
    )
    parser.add_argument("--output", type=Path, metavar="FOLDER", help="write the trial and the advice to a folder")


def run(options: argparse.Namespace) -> int:
    """Carry the command out and return the exit code."""
    require("this command", "rich", *(["matplotlib"] if options.output is not None else []))
    from rich.console import Console
    from rich.progress import Progress

    from ..advice import BOUNDS, MONITORS, AdviceError, advise_on, measured_gain

    check_platform(options)
    start, platform = _start(options)
    step, steps = _trial(options, start)
    monitors = _monitors(options) or MONITORS
    bounds = [tuple(pair) for pair in options.bounds] if options.bounds else BOUNDS
    for smallest, largest in bounds:
        if not (0.0 <= smallest < 1.0 and (largest == 0.0 or 1.0 < largest < math.inf)):
            raise UsageError(
                "the bounds must be below 1 and above 1: they are relative to the nominal step; 0 for none."
            )
    if options.output is not None:
        try:
            options.output.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"the folder {options.output} cannot be made: {error.strerror}.") from error
    console = Console() if sys.stdout.isatty() else Console(width=120)
    console.print(f"{start.description}, platform {platform}", style="bold", highlight=False, markup=False)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bars:
        task = bars.add_task(f"{steps:,} fixed steps of {step:.4g} ps", total=1.0)
        try:
            advice = advise_on(
                start,
                step,
                steps,
                platform,
                start.settings.constraint_tolerance,
                monitors,
                bounds,
                lambda fraction: bars.update(task, completed=fraction),
            )
        except AdviceError as error:
            raise UsageError(f"the trial cannot be run: {error}.") from error
        gains = {}
        if options.check and advice.best is not None:
            bars.reset(task, description="measuring the gain", total=None)
            gains["the best settings"] = measured_gain(advice, start, platform)
            gains["automatic step control"] = measured_gain(advice, start, platform, automatic=True)
    print_advice(console, advice)
    if gains:
        console.print("\nMeasured over this trial, at equal force evaluations:", style="bold")
    for name, gain in gains.items():
        console.print(f"- {name}: {_gain_in_words(*gain)}", highlight=False, soft_wrap=True, markup=False)
    if options.output is not None:
        _write(advice, start, gains, options.output)
        console.print(f"The trial and the advice are in {options.output}.", highlight=False, soft_wrap=True)
    return 0


def _start(options: argparse.Namespace) -> tuple[TestSystem, str]:
    own = has_own_system(options)
    if own == (options.system is not None):
        raise UsageError("give one system: --system NAME, --pdb FILE, or --xml FILE with --state FILE.")
    if own:
        return own_system(options, 1 if options.seed is None else options.seed)
    return named_system(chosen(options.system, SYSTEMS, "system"), options.seed), options.platform or "Reference"


def _trial(options: argparse.Namespace, start: TestSystem) -> tuple[float, int]:
    """Step and number of steps; with one of our systems and one of the two given, its time is kept."""
    settings = start.settings
    if options.step is not None and not 0.0 < options.step < math.inf:
        raise UsageError("the step must be positive.")
    if options.steps is not None and options.steps < 10:
        raise UsageError("a trial needs at least 10 steps.")
    step, steps = settings.total_time / settings.force_evaluations, settings.force_evaluations
    if options.system is None:
        return options.step or step, options.steps or steps
    if options.step is not None:
        return options.step, options.steps or max(10, round(settings.total_time / options.step))
    if options.steps is not None:
        return settings.total_time / options.steps, options.steps
    return step, steps


def _monitors(options: argparse.Namespace) -> list[Any]:
    monitors = []
    for text in options.monitors or ():
        one = monitors_from(text)
        if len(one) > 1:
            raise UsageError("advise judges one monitor at a time; compare runs several together.")
        if one[0].kind == "ForceGroupEnergy":
            raise UsageError("advise does not know your force group for ForceGroupEnergy; compare runs it.")
        monitors += one
    return monitors


def print_advice(console: Any, advice: Advice) -> None:
    """Print what each monitor was in the trial, what it promises with each bound, and the advice."""
    from rich.table import Table

    from ..comparison import two_digits

    bounds = sorted({candidate.bounds for candidate in advice.candidates}, key=lambda pair: (pair[1] or 1e9, -pair[0]))
    table = Table(
        title="Each monitor along the trial, and P for bounds of the steps: below 2.2 no gain, above 5 it pays",
        title_justify="left",
    )
    table.add_column("monitor", no_wrap=True)
    for heading in ("smallest", "mean", "largest"):
        table.add_column(heading, justify="right")
    for smallest, largest in bounds:
        low = f"1/{1 / smallest:,.0f}" if smallest else "none"
        table.add_column(f"{low} to {f'{largest:g}' if largest else 'none'}", justify="right")
    names = list(dict.fromkeys(candidate.monitor for candidate in advice.candidates))
    for name in sorted(names, key=lambda name: -max(c.predictor for c in advice.candidates if c.monitor == name)):
        values = advice.trial.monitor_values[name.split("^")[0]]
        found = {c.bounds: c for c in advice.candidates if c.monitor == name}
        cells = []
        for pair in bounds:
            text = two_digits(found[pair].predictor)
            best = found[pair] is advice.best and advice.verdict == "variable steps"
            cells.append(f"[bold green]{text}[/bold green]" if best else text)
        table.add_row(name, *(two_digits(float(x)) for x in (values.min(), values.mean(), values.max())), *cells)
    if names:
        console.print(table)
    for sentence in advice.sentences():
        style = "bold" if sentence.startswith("Use ") else None
        console.print(sentence, style=style, highlight=False, soft_wrap=True, markup=False)
    console.print()
    console.print(advice.code(), highlight=False, soft_wrap=True, markup=False)


def _gain_in_words(gain: float, failure: str | None) -> str:
    from ..comparison import two_digits

    if failure is not None:
        return f"failed ({failure.rstrip('.')})."
    if math.isinf(gain):
        return "reach the end, where fixed steps fail."
    return f"a gain of {two_digits(gain)}."


def _write(advice: Advice, start: TestSystem, gains: dict[str, tuple[float, str | None]], folder: Path) -> None:
    """Write advice.json, trial.csv and trial.png."""
    from ..plots import save_trial

    trial = advice.trial
    content = {
        "system": start.name,
        "verdict": advice.verdict,
        "sentences": advice.sentences(),
        "code": advice.code(),
        "resolved": advice.resolved,
        "step_size": trial.step_size,
        "largest_energy_error": trial.largest_energy_error,
        "measured_gains": {name: gain if math.isfinite(gain) else None for name, (gain, _) in gains.items()},
        "candidates": [
            {
                "monitor": candidate.monitor,
                "smallest_step_ratio": candidate.bounds[0],
                "largest_step_ratio": candidate.bounds[1],
                "predictor": candidate.predictor,
                "expected_gain": candidate.expected_gain,
                "nominal_step_size": candidate.control.nominal_step_size,
                "reference_monitor_value": candidate.control.reference_values[0],
                "smallest_step": candidate.smallest_step,
                "largest_step": candidate.largest_step,
            }
            for candidate in advice.candidates
        ],
    }
    (folder / "advice.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    with (folder / "trial.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["time_ps", "energy_error_kj_per_mol", *trial.monitor_values])
        for row in zip(trial.times, trial.energy_errors, *trial.monitor_values.values(), strict=True):
            writer.writerow([f"{value:.9g}" for value in row])
    save_trial(advice, start.description, folder / "trial.png")
