# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Section 4 of Barth, Leimkuhler and Reich (1999): which monitor keeps the energy of a double pendulum?

A light bob (1 amu) hangs on the first rod, a heavy one (1000 amu) on the second, both under gravity. Whenever the rods
pass through one line the light bob is whipped around, and for a moment the forces in the rods rise by many orders of
magnitude. Compared are RATTLE with fixed steps and VRATTLE with the paper's two monitors, U1 (speeds and applied
forces) and U2 (constraint forces), and with the mass-weighted constraint force of Gauss's principle, each with as many
force evaluations as the RATTLE that it is held against.

    python examples/double_pendulum.py            the four figures, a table and the paper's claims
    python examples/double_pendulum.py --quick    the same up to the first whip, in a few seconds

The energy is taken after every step, for a whip lasts only a few of the fixed steps and its peak only one or two. On a
GPU (``--platform``) every one of these looks waits for it, so ``--quick`` takes minutes there: some 300,000 steps.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import openmm
from matplotlib.figure import Figure
from openmmvrattle.compare.comparison import Series, envelope, make_integrator, two_digits
from openmmvrattle.platforms import add_platform_arguments, make_context, platform_from
from openmmvrattle.testsystems import MonitorSettings, StepControl, double_pendulum
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

TIME = 12.0
"""ps, as in the paper."""
QUICK_TIME = 2.0
"""ps; the first whip is at 1.57 ps."""
EXCHANGED_TIME = 12.0
"""ps; with the masses exchanged, whatever the time of the others, since that takes few steps."""

platform = "Reference"
"""On which everything runs; ``--platform`` names another."""

Progress = Callable[[str], None]
"""Called with what is about to be run."""


# ------------------------------------------------------------------------------------------------------ what is run


@dataclass(frozen=True)
class Method:
    """A way of choosing the steps, and its name in tables and figures."""

    name: str
    control: StepControl


def _method(name: str, monitor: str, nominal: float, smallest: float, largest: float) -> Method:
    """A method with one monitor, its nominal step and its bounds in ps; a bound of 0 is none."""
    return Method(name, StepControl((MonitorSettings(monitor),), nominal, smallest / nominal, largest / nominal))


U1 = _method("U1", "VectorField", 1e-4, 0.0, 0.0)
U2 = _method("U2", "ConstraintMultipliers", 0.01, 1e-6, 0.02)
U2_SMALLER = _method("U2, min 1e-7", "ConstraintMultipliers", 0.01, 1e-7, 0.02)
U2_NO_MAXIMUM = _method("U2, no max", "ConstraintMultipliers", 0.01, 1e-6, 0.0)
GAUSS = _method("Gauss", "ConstraintForce", 0.02, 0.0, 0.0)
METHODS = (U1, U2, U2_SMALLER, U2_NO_MAXIMUM, GAUSS)

EXCHANGED_STEP = 1e-3
EXCHANGED_METHODS = (
    _method("U1", "VectorField", EXCHANGED_STEP, 0.0, 0.0),
    _method("U2", "ConstraintMultipliers", EXCHANGED_STEP, EXCHANGED_STEP / 50, 2 * EXCHANGED_STEP),
    _method("U2, no max", "ConstraintMultipliers", EXCHANGED_STEP, EXCHANGED_STEP / 50, 0.0),
    _method("Gauss", "ConstraintForce", EXCHANGED_STEP, EXCHANGED_STEP / 50, 2 * EXCHANGED_STEP),
)


@dataclass(frozen=True)
class Run:
    """What was measured along one run, after every step."""

    nominal_step: float
    """ps"""
    force_evaluations: int
    rescues: int
    series: Series = field(repr=False)
    multipliers: np.ndarray = field(repr=False)
    """The Euclidean norm of the multipliers in kJ/mol/nm^2, empty if it was not recorded; one entry for each sample."""
    positions: np.ndarray = field(repr=False)
    """Positions of the two bobs in the plane, nm, empty if not recorded: samples x 2 bobs x (x, y)."""

    @property
    def steps(self) -> int:
        """The number of steps."""
        return len(self.series.times) - 1

    @property
    def largest_error(self) -> float:
        """The largest energy error in kJ/mol."""
        return float(np.max(np.abs(self.series.energy_errors)))

    @property
    def smallest_step(self) -> float:
        """ps"""
        return float(np.min(self.series.step_sizes[1:]))

    @property
    def largest_step(self) -> float:
        """ps"""
        return float(np.max(self.series.step_sizes[1:]))


def run_pendulum(
    control: StepControl,
    time: float,
    masses: tuple[float, float] = (1.0, 1000.0),
    steps: int | None = None,
    record_multipliers: bool = False,
    record_positions: bool = False,
) -> Run:
    """Run the pendulum from rest and look at it after every step.

    Args:
        control: how the steps are chosen.
        time: the run ends with the first step that reaches this time, in ps.
        masses: of the inner and the outer bob, in amu.
        steps: end after this number of steps instead.
        record_multipliers: whether to read the constraint forces as well.
        record_positions: whether to read the positions as well.
    """
    pendulum = double_pendulum(*masses)
    integrator = make_integrator(control)
    context = make_context(pendulum.system, integrator, platform)
    context.setPositions(pendulum.positions)
    context.setVelocities(pendulum.velocities)
    times, energies, sizes = [], [], []
    multipliers: list[float] = []
    positions: list[np.ndarray] = []
    simulated, size = 0.0, math.nan
    end = time * (1.0 - 1e-9)  # a sum of many steps is rounded
    while True:
        state = context.getState(energy=True, positions=record_positions)
        times.append(simulated)
        energies.append(state.getKineticEnergy()._value + state.getPotentialEnergy()._value)
        sizes.append(size)
        if record_multipliers:
            multipliers.append(math.hypot(*(value._value for value in integrator.getMultipliers())))
        if record_positions:
            positions.append(state.getPositions(asNumpy=True)._value[1:, :2])
        if simulated >= end if steps is None else len(times) > steps:
            break
        integrator.step(1)
        size = integrator.getStepSize()._value
        simulated += size
    return Run(
        nominal_step=control.nominal_step_size,
        force_evaluations=int(integrator.getNumForceEvaluations()),
        rescues=int(integrator.getNumRescues()),
        series=Series(np.array(times), np.array(energies) - energies[0], np.array(sizes)),
        multipliers=np.array(multipliers),
        positions=np.array(positions),
    )


@dataclass(frozen=True)
class Trial:
    """A method and RATTLE with fixed steps over the same time, with the same number of force evaluations."""

    masses: tuple[float, float]
    """Of the inner and the outer bob, in amu."""
    method: Method
    variable: Run
    fixed: Run

    @property
    def gain(self) -> float:
        """How many times smaller the largest energy error is than that of fixed steps."""
        return self.fixed.largest_error / self.variable.largest_error


@dataclass(frozen=True)
class Study:
    """All runs."""

    time: float
    """ps"""
    trials: dict[str, Trial]
    """By the name of the method; light inner and heavy outer bob."""
    exchanged: dict[str, Trial]
    """The same with the masses exchanged."""
    u1_as_u2: Run
    """U1 with as many force evaluations as U2."""


def run_trial(method: Method, time: float, masses: tuple[float, float] = (1.0, 1000.0)) -> Trial:
    """Run a method, and then RATTLE with its average step, as the paper does."""
    variable = run_pendulum(method.control, time, masses, record_positions=method is U2)
    average = float(variable.series.times[-1]) / variable.steps
    fixed = run_pendulum(StepControl((), average), time, masses, variable.steps, record_multipliers=method is U1)
    return Trial(masses, method, variable, fixed)


def run_study(time: float = TIME, progress: Progress | None = None) -> Study:
    """Run everything that the figures, the table and the claims need.

    Args:
        time: simulated time of the runs with the light bob inside, in ps.
        progress: called before each part.
    """

    def report(what: str) -> None:
        if progress is not None:
            progress(what)

    trials, exchanged = {}, {}
    for method in METHODS:
        report(f"{method.name} and RATTLE with as many force evaluations")
        trials[method.name] = run_trial(method, time)
    for method in EXCHANGED_METHODS:
        report(f"{method.name} with the masses exchanged")
        exchanged[method.name] = run_trial(method, EXCHANGED_TIME, (1000.0, 1.0))
    report("U1 with as many force evaluations as U2")
    # U1 hardly changes its steps, so that the average step does for its nominal one.
    steps = trials[U2.name].variable.steps
    u1_as_u2 = run_pendulum(StepControl(U1.control.monitors, time / steps, 0.0, 0.0), time, steps=steps)
    return Study(time, trials, exchanged, u1_as_u2)


# ---------------------------------------------------------------------------------------------- the paper's claims


@dataclass(frozen=True)
class Claim:
    """Something that the paper says, the number by which it is judged here, and the verdict."""

    claim: str
    number: float
    meaning: str
    """What the number is."""
    bar: str
    """What it has to be for the claim to hold."""
    held: bool


def _claim(claim: str, number: float, meaning: str, least: float) -> Claim:
    """A claim that holds if its number is at least so large."""
    return Claim(claim, float(number), meaning, f"at least {least:g}", bool(number >= least))


def judge_claims(study: Study) -> list[Claim]:
    """Judge what the paper's section 4 says by the runs.

    "Orders of magnitude" in the plural is taken as a factor of at least 100, "many" as at least 10,000.
    """
    u1, u2, smaller = (study.trials[method.name] for method in (U1, U2, U2_SMALLER))
    fixed = u1.fixed
    errors = np.abs(fixed.series.energy_errors)
    at_peaks = np.median(fixed.multipliers[errors > 0.5 * errors.max()]) / np.median(fixed.multipliers)
    exchanged, exchanged_free = (study.exchanged[method.name] for method in (U2, U2_NO_MAXIMUM))
    return [
        _claim(
            "The constraint force varies over many orders of magnitude along the run with fixed steps",
            fixed.multipliers.max() / fixed.multipliers.min(),
            "largest divided by smallest norm of the multipliers",
            least=1e4,
        ),
        _claim(
            "The peaks of the energy error lie where the constraint force is large",
            at_peaks,
            "median norm of the multipliers where RATTLE's error is above half of its largest, divided by the median "
            "of the whole run",
            least=100,
        ),
        _claim(
            "U1 does not remove the peaks of the energy error",
            u1.variable.largest_error / u1.fixed.largest_error,
            "largest error of U1 divided by that of RATTLE",
            least=0.5,
        ),
        _claim(
            "The energy error is nevertheless much smaller with U1 than with RATTLE, at its peaks",
            u1.gain,
            "largest error of RATTLE divided by that of U1",
            least=2,
        ),
        _claim(
            "The energy error is nevertheless much smaller with U1 than with RATTLE, between its peaks",
            np.median(errors) / np.median(np.abs(u1.variable.series.energy_errors)),
            "median error of RATTLE divided by that of U1",
            least=2,
        ),
        _claim(
            "U2 eliminates the peaks that RATTLE has",
            u2.gain,
            "largest error of RATTLE divided by that of U2",
            least=100,
        ),
        _claim(
            "U2 eliminates the peaks that U1 has",
            study.u1_as_u2.largest_error / u2.variable.largest_error,
            "largest error of U1 divided by that of U2",
            least=100,
        ),
        _claim(
            "The largest step is several orders of magnitude larger with U2 than with U1",
            smaller.variable.largest_step / u1.variable.largest_step,
            "largest step of U2 divided by that of U1",
            least=100,
        ),
        _claim(
            "The smallest step is several orders of magnitude smaller with U2 than with U1",
            u1.variable.smallest_step / smaller.variable.smallest_step,
            "smallest step of U1 divided by that of U2, which its bound of 1e-7 ps limits",
            least=100,
        ),
        _claim(
            "The growth of the step needs a limit",
            exchanged.gain / exchanged_free.gain,
            "with the masses exchanged: gain of U2 over RATTLE with a largest step of twice the nominal one, divided "
            "by its gain without",
            least=10,
        ),
    ]


# ----------------------------------------------------------------------------------------------- tables and files

COLUMNS = (
    "inner_mass_amu",
    "outer_mass_amu",
    "method",
    "nominal_step_ps",
    "minimum_step_ps",
    "maximum_step_ps",
    "force_evaluations",
    "largest_energy_error_kj_per_mol",
    "rattle_force_evaluations",
    "rattle_largest_energy_error_kj_per_mol",
    "gain",
    "smallest_step_taken_ps",
    "largest_step_taken_ps",
    "rescues",
)


def table_rows(study: Study) -> list[dict[str, Any]]:
    """One row for each method and mass ratio; bounds of 0 are none."""
    rows = []
    for trial in (*study.trials.values(), *study.exchanged.values()):
        control, variable = trial.method.control, trial.variable
        values = (
            *trial.masses,
            trial.method.name,
            control.nominal_step_size,
            control.smallest_step_ratio * control.nominal_step_size,
            control.largest_step_ratio * control.nominal_step_size,
            variable.force_evaluations,
            variable.largest_error,
            trial.fixed.force_evaluations,
            trial.fixed.largest_error,
            trial.gain,
            variable.smallest_step,
            variable.largest_step,
            variable.rescues,
        )
        rows.append(dict(zip(COLUMNS, values, strict=True)))
    return rows


def write_table(study: Study, path: Path) -> None:
    """Write the table to a CSV file."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=COLUMNS)
        writer.writeheader()
        writer.writerows(table_rows(study))


def write_claims(study: Study, claims: Sequence[Claim], path: Path) -> None:
    """Write the claims, and what they were judged with, to a JSON file."""
    content = {
        "time_ps": study.time,
        "openmm_version": openmm.Platform.getOpenMMVersion(),
        "claims": [asdict(claim) for claim in claims],
    }
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def print_tables(study: Study, console: Console) -> None:
    """Show the largest energy errors at equal numbers of force evaluations, one table for each mass ratio."""
    console.print("Largest energy error (kJ/mol) of each method and of RATTLE with as many force evaluations")
    for trials, time in ((study.trials, study.time), (study.exchanged, EXCHANGED_TIME)):
        inner, outer = next(iter(trials.values())).masses
        title = f"inner bob {inner:g} amu, outer bob {outer:g} amu, {time:g} ps"
        table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
        table.add_column("method", no_wrap=True)
        for heading in ("evaluations", "its error", "RATTLE's", "gain", "steps (ps)"):
            table.add_column(heading, justify="right", no_wrap=True)
        for trial in trials.values():
            run = trial.variable
            table.add_row(
                trial.method.name,
                f"{run.force_evaluations:,}",
                two_digits(run.largest_error),
                two_digits(trial.fixed.largest_error),
                two_digits(trial.gain),
                f"{run.smallest_step:.0e} to {run.largest_step:.0e}",
            )
        console.print(table)


def print_claims(claims: Sequence[Claim], console: Console) -> None:
    """Show one line for each claim of the paper."""
    console.print("What section 4 of the paper says:")
    for claim in claims:
        verdict = Text("held: ", style="green") if claim.held else Text("did not hold: ", style="bold red")
        console.print(verdict + Text(f"{claim.claim} ({claim.meaning}: {two_digits(claim.number)})", style=""))


# ------------------------------------------------------------------------------------------------------- figures

# Colours that can be told apart with any colour vision (Okabe and Ito).
COLOURS = {"RATTLE": "#555555", "U1": "#0072B2", "U2": "#D55E00", "Gauss": "#009E73"}
ENERGY_FLOOR = 1e-13
"""kJ/mol; smaller errors are rounding."""
WINDOWS = 1200
"""A line shows the largest value in each of so many windows of time, its shade reaches to the smallest."""


def _prepare(axes: Any) -> None:
    axes.grid(True, which="major", color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _draw_error(axes: Any, run: Run, time: float, name: str, **style: Any) -> None:
    """The size of the energy error against time."""
    reduced = envelope(run.series, time, WINDOWS)
    largest = np.maximum(np.abs(reduced.largest_energy_errors), ENERGY_FLOOR)
    smallest = np.maximum(np.abs(reduced.smallest_energy_errors), ENERGY_FLOOR)
    style = {"color": COLOURS[name], "linewidth": 0.9} | style
    axes.plot(reduced.times, largest, label=name, **style)
    axes.fill_between(reduced.times, smallest, largest, color=style["color"], alpha=0.25, linewidth=0)


def draw_trajectory_and_error(study: Study) -> Figure:
    """Figure 4.1: the paths of the bobs, and the energy error of RATTLE and U1."""
    figure = Figure(figsize=(9.6, 4.0), dpi=110, layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.45))
    paths = study.trials[U2.name].variable.positions
    for bob, (name, colour) in enumerate((("inner bob, 1 amu", "#56B4E9"), ("outer bob, 1000 amu", "#D55E00"))):
        x, y = paths[:, bob, 0], paths[:, bob, 1]
        left.plot(x, y, color=colour, linewidth=1.0, label=name)
        left.plot(x[0], y[0], "*", color="black", markersize=10, zorder=4)
    rods = np.concatenate([np.zeros((1, 2)), paths[0]])
    left.plot(rods[:, 0], rods[:, 1], color="black", linewidth=1.4, linestyle=(0, (2, 1.5)), label="rods at the start")
    left.plot(0, 0, "o", color="black", markersize=5)
    left.set_aspect("equal")
    left.set_xlim(-2.15, 2.15)
    left.set_ylim(-2.15, 1.9)  # room for the legend
    left.set_xlabel("x (nm)")
    left.set_ylabel("y (nm)")
    left.set_title("(a) paths of the bobs", fontsize=11)
    left.legend(loc="upper left", frameon=False, fontsize=8.5)
    trial = study.trials[U1.name]
    for name, run, style in (
        ("RATTLE", trial.fixed, {"linewidth": 2.6, "alpha": 0.55}),
        ("U1", trial.variable, {"linewidth": 0.9}),
    ):
        _draw_signed_error(right, run, study.time, name, style)
    right.set_xlim(0, study.time)
    right.set_xlabel("time (ps)")
    right.set_ylabel("energy error (kJ/mol)")
    right.set_title(f"(b) energy error, {trial.variable.force_evaluations:,} force evaluations each", fontsize=11)
    right.legend(frameon=False, fontsize=9)
    for axes in (left, right):
        _prepare(axes)
    return figure


def _draw_signed_error(axes: Any, run: Run, time: float, name: str, style: dict[str, Any]) -> None:
    """The energy error with its sign against time: the largest in size of each window."""
    reduced = envelope(run.series, time, WINDOWS)
    axes.plot(reduced.times, reduced.largest_energy_errors, color=COLOURS[name], label=name, **style)


def draw_multipliers(study: Study) -> Figure:
    """Figure 4.2: the multipliers, times the square of the step, along the run with fixed steps."""
    run = study.trials[U1.name].fixed
    figure = Figure(figsize=(7.6, 3.6), dpi=110, layout="constrained")
    axes = figure.subplots()
    values = run.multipliers * run.nominal_step**2
    # The same reduction to windows as for the energy.
    reduced = envelope(Series(run.series.times, values, run.series.step_sizes), study.time, WINDOWS)
    axes.plot(reduced.times, reduced.largest_energy_errors, color=COLOURS["RATTLE"], linewidth=0.9)
    axes.fill_between(
        reduced.times,
        reduced.smallest_energy_errors,
        reduced.largest_energy_errors,
        color=COLOURS["RATTLE"],
        alpha=0.25,
        linewidth=0,
    )
    axes.set_yscale("log")
    axes.set_xlim(0, study.time)
    axes.set_xlabel("time (ps)")
    axes.set_ylabel("norm of the multipliers × step²\n(kJ ps² / mol nm²)")
    axes.set_title(f"RATTLE, fixed steps of {run.nominal_step:.3g} ps", fontsize=11)
    _prepare(axes)
    return figure


def draw_energy_errors(study: Study) -> Figure:
    """Figure 4.3: the energy error of RATTLE, U1, U2 and Gauss, on the same axes."""
    runs = {"RATTLE": study.trials[U1.name].fixed}
    runs |= {method.name: study.trials[method.name].variable for method in (U1, U2, GAUSS)}
    figure = Figure(figsize=(7.6, 7.4), dpi=110, layout="constrained")
    panels = figure.subplots(4, 1, sharex=True, sharey=True)
    for axes, (name, run) in zip(panels, runs.items(), strict=True):
        _draw_error(axes, run, study.time, name)
        axes.axhline(run.largest_error, color=COLOURS[name], linewidth=0.8, linestyle=(0, (4, 3)))
        axes.set_yscale("log")
        axes.set_title(
            f"{name}: {run.force_evaluations:,} force evaluations, at most {two_digits(run.largest_error)} kJ/mol",
            fontsize=10.5,
            loc="left",
        )
        _prepare(axes)
    panels[0].set_xlim(0, study.time)
    panels[0].set_ylim(1e-9, 300)
    panels[-1].set_xlabel("time (ps)")
    figure.supylabel("energy error |E − E(0)| (kJ/mol)", fontsize=10.5)
    return figure


def draw_step_sizes(study: Study) -> Figure:
    """Figure 4.4: the step sizes of U1 and U2."""
    figure = Figure(figsize=(7.6, 3.8), dpi=110, layout="constrained")
    axes = figure.subplots()
    for method in (U2, U1):
        run = study.trials[method.name].variable
        reduced = envelope(run.series, study.time, WINDOWS)
        colour = COLOURS[method.name]
        axes.plot(reduced.times, reduced.smallest_steps, color=colour, linewidth=1.2, label=method.name)
        axes.fill_between(
            reduced.times, reduced.smallest_steps, reduced.largest_steps, color=colour, alpha=0.25, linewidth=0
        )
    axes.set_yscale("log")
    axes.set_xlim(0, study.time)
    axes.set_ylim(5e-7, 5e-2)
    axes.set_xlabel("time (ps)")
    axes.set_ylabel("step size (ps)")
    axes.legend(frameon=False, fontsize=9.5, loc="center left", bbox_to_anchor=(1.0, 0.5))
    _prepare(axes)
    return figure


FIGURES: dict[str, Callable[[Study], Figure]] = {
    "figure-4-1": draw_trajectory_and_error,
    "figure-4-2": draw_multipliers,
    "figure-4-3": draw_energy_errors,
    "figure-4-4": draw_step_sizes,
}
"""What draws each figure, by the name of its file."""


# ------------------------------------------------------------------------------------------------------ the script


def _arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Section 4 of Barth, Leimkuhler and Reich (1999), reproduced.")
    parser.add_argument(
        "--output", type=Path, default=Path("out/double_pendulum"), help="folder of the files (default: %(default)s)"
    )
    parser.add_argument("--time", type=float, help=f"simulated time in ps (default: {TIME:g})")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_TIME:g} ps only, which have one whip")
    add_platform_arguments(parser, platform)
    options = parser.parse_args(arguments)
    try:
        options.platform = platform_from(options, "Reference")
    except ValueError as error:
        parser.error(f"{error}.")
    if options.time is None:
        options.time = QUICK_TIME if options.quick else TIME
    if not (options.time > 0.0 and math.isfinite(options.time)):
        parser.error("the time must be a positive number of ps")
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, draw, print and write; returns the exit status."""
    global platform
    options = _arguments(arguments)
    platform = options.platform
    console = Console()
    try:
        options.output.mkdir(parents=True, exist_ok=True)
        with console.status("starting") as status:
            study = run_study(options.time, lambda what: status.update(f"running {what}"))
            status.update("drawing")
            for name, draw in FIGURES.items():
                draw(study).savefig(options.output / f"{name}.png")
        claims = judge_claims(study)
        write_table(study, options.output / "table.csv")
        write_claims(study, claims, options.output / "claims.json")
    except (OSError, openmm.OpenMMException) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print_tables(study, console)
    print_claims(claims, console)
    console.print(f"Figures, table.csv and claims.json are in {options.output}.", highlight=False)
    return 0


if __name__ == "__main__":
    sys.exit(main())
