# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The advice on variable steps against what is measured: does `advise` say the right thing?

On each system of `openmmvrattle.testsystems`, with its own time and several numbers of steps, a trial with fixed steps
gives a verdict and a number P for each monitor and each pair of bounds. Then the best candidate and the automatic step
control are run with as many force evaluations as the trial had, and for one number of steps all other candidates too.

- gain: the largest energy error of RATTLE with fixed steps divided by that of the candidate;
- the verdict is right if the best candidate gains more than 1.25 where it says variable steps, and less where it says
  fixed steps; ``little to gain`` is right between 0.8 and 3.

Written to the folder ``--output``: advise.csv (one line a candidate), advise.md (tables), advise.png (gain against P);
with ``--page`` tables and picture go into docs/advice.md.

The limits of the verdicts were set with these systems in view. Ten others, of benchmarks/automatic_unseen.py, are run
with --unseen in their place.

    python benchmarks/advise.py                # everything, about ten minutes
    python benchmarks/advise.py --best-only    # the verdicts, without the other candidates: about a minute
    python benchmarks/advise.py --unseen --best-only
"""

from __future__ import annotations

import argparse
import csv
import math
import platform
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import automatic_unseen
import numpy as np
import openmm
import pages
from openmm import app
from openmmvrattle.compare.advice import Advice, AdviceError, Candidate, advise_on, measured_gain
from openmmvrattle.compare.comparison import two_digits
from openmmvrattle.compare.measurement import IntegratorRun, methods_of, run_method
from openmmvrattle.testsystems import SYSTEMS, ComparisonSettings, TestSystem, project_onto_constraints

PARTS = (0.5, 1.0, 2.0)
"""Steps of the trial, relative to those that are recommended for the system."""
LEAST_STEPS_OF_PENDULUM = 40_000
"""Fixed steps fail altogether below about 33,000."""
UNSEEN = (
    "hot gas",
    "sheared gas",
    "two species",
    "reactive collision",
    "peptide against a wall",
    "clash at rest",
    "comet",
    "collapse",
    "two N2, 3 nm",
    "warm water",
)
"""Systems of automatic_unseen, and two of its that begin warm."""


@dataclass(frozen=True)
class Row:
    """One candidate on one system."""

    system: str
    steps: int
    resolved: bool
    verdict: str
    is_best: bool
    """Whether it is the one that the advice names."""
    monitor: str
    smallest_step_ratio: float
    largest_step_ratio: float
    predictor: float
    expected_gain: float
    gain: float
    """Measured; NaN if the run failed."""
    automatic_gain: float
    """Measured with the automatic step control; the same in all rows of a trial."""
    failure: str | None

    @property
    def is_right(self) -> bool:
        """Whether the verdict agrees with the gain of the best candidate."""
        if self.verdict == "variable steps":
            return self.gain > 1.25
        if self.verdict == "little to gain":
            return 0.8 < self.gain < 3.0
        return not self.gain > 1.25


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--systems", nargs="+", choices=SYSTEMS, default=list(SYSTEMS), metavar="NAME")
    parser.add_argument("--unseen", action="store_true", help="the ten systems that the limits were not set on")
    parser.add_argument("--best-only", action="store_true", help="do not run the other candidates")
    parser.add_argument("--output", type=Path, default=Path("out/advise"), metavar="FOLDER")
    parser.add_argument("--page", action="store_true", help="put tables and figures into docs/advice.md")
    options = parser.parse_args(arguments)
    if options.page and options.systems != list(SYSTEMS):
        parser.error("a page shows a run of everything")
    options.output.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    rows: list[Row] = []
    for name in UNSEEN if options.unseen else options.systems:
        start = _unseen(name) if options.unseen else SYSTEMS[name]()
        for steps in _steps_of(start):
            try:
                rows += _measured(start, steps, options.best_only or steps != start.settings.force_evaluations)
            except AdviceError as error:
                print(f"{name}, {steps:,} steps: {error}", file=sys.stderr)
                continue
            print(f"{name}, {steps:,} steps: {rows[-1].verdict}", file=sys.stderr)
    with (options.output / "advise.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(Row.__dataclass_fields__))
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)
    report = "\n".join([*_verdicts(rows), "", *_statistics(rows)])
    (options.output / "advise.md").write_text(report + "\n", encoding="utf-8")
    if not options.best_only:
        _draw(rows, options.output / "advise.png")
    if options.page:
        page, provenance = pages.DOCS / "advice.md", pages.provenance()
        pages.write(page, "unseen" if options.unseen else "verdicts", [provenance, "", *_verdicts(rows)])
        if not options.best_only and not options.unseen:
            picture = "![Gain against P for all candidates](images/advise.png)"
            pages.write(page, "candidates", [provenance, "", *_statistics(rows), "", picture])
            _draw(rows, pages.DOCS / "images" / "advise.png")
    print(report)
    seconds = time.perf_counter() - started
    print(f"\n{seconds:.0f} s, OpenMM {openmm.Platform.getOpenMMVersion()}, {platform.machine()}.")
    print(f"Files are in {options.output}.")
    return 0


def _unseen(name: str) -> TestSystem:
    """A start of automatic_unseen as the comparisons take it."""
    source = {"hot gas": "heated gas", "warm water": "cold water"}.get(name, name)
    start = {**automatic_unseen.SYSTEMS, **automatic_unseen.SEEN}[source]()
    system, velocities, time_ = start.system, start.velocities, start.time
    if name == "hot gas":
        velocities = automatic_unseen.maxwell(system, 3000, 2)
    if name == "warm water":
        system, positions, _ = automatic_unseen.water_box()
        velocities, time_ = automatic_unseen.maxwell(system, 300, 3), 1.0
    positions, velocities = project_onto_constraints(system, start.positions, velocities)
    settings = ComparisonSettings(time_, round(time_ / start.step), ())
    return TestSystem(name, system, app.Topology(), positions, velocities, name, settings)


def _steps_of(start: TestSystem) -> list[int]:
    numbers = [round(start.settings.force_evaluations * part) for part in PARTS]
    if start.name == "double-pendulum":
        numbers = [max(LEAST_STEPS_OF_PENDULUM, number) for number in numbers]
    return numbers


def _measured(start: TestSystem, steps: int, best_only: bool) -> list[Row]:
    advice = advise_on(start, start.settings.total_time / steps, steps)
    fixed = _fixed(start, advice)
    automatic, _ = measured_gain(advice, start, automatic=True)
    candidates = [advice.best] if best_only else advice.candidates
    rows = []
    for candidate in candidates:
        if candidate is None:
            continue
        gain, failure = _gain(start, advice, candidate, fixed)
        rows.append(
            Row(
                start.name,
                len(advice.trial.times) - 1,
                advice.resolved,
                advice.verdict,
                candidate is advice.best,
                candidate.monitor,
                *candidate.bounds,
                candidate.predictor,
                candidate.expected_gain,
                gain,
                automatic,
                failure,
            )
        )
    return rows


def _fixed(start: TestSystem, advice: Advice) -> IntegratorRun:
    return _run(start, advice, "RATTLE", None)


def _gain(start: TestSystem, advice: Advice, candidate: Candidate, fixed: IntegratorRun) -> tuple[float, str | None]:
    run = _run(start, advice, "VRATTLE", candidate)
    if run.failure is not None or fixed.failure is not None:
        return math.nan, run.failure or fixed.failure
    return fixed.largest_energy_error / run.largest_energy_error, None


def _run(start: TestSystem, advice: Advice, integrator: str, candidate: Candidate | None) -> IntegratorRun:
    settings = replace(
        start.settings,
        total_time=float(advice.trial.times[-1]),
        force_evaluations=len(advice.trial.times) - 1,
        controls=(candidate.control,) if candidate else (),
    )
    (method,) = methods_of(settings, (integrator,))
    return run_method(method, start, "Reference", settings)


def _verdicts(rows: Sequence[Row]) -> list[str]:
    lines = [
        "| system | steps of the trial | verdict | monitor, bounds | P | expected gain | measured | automatic | |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        if row.is_best:
            low = f"1/{1 / row.smallest_step_ratio:,.0f}" if row.smallest_step_ratio else "none"
            settings = f"{row.monitor}, {low} and {row.largest_step_ratio:g}"
            lines.append(
                f"| {row.system} | {row.steps:,}{'' if row.resolved else ' ¹'} | {row.verdict} | {settings} | "
                f"{two_digits(row.predictor)} | {two_digits(row.expected_gain)} | {two_digits(row.gain)} | "
                f"{two_digits(row.automatic_gain)} | {'right' if row.is_right else 'WRONG'} |"
            )
    best = [row for row in rows if row.is_best]
    lines += ["", f"{sum(row.is_right for row in best)} of {len(best)} verdicts are right."]
    if not all(row.resolved for row in best):
        lines += ["", "¹ The steps are too large for the hardest moments; P is from the leading term of the error."]
    return lines


def _statistics(rows: Sequence[Row]) -> list[str]:
    known = [row for row in rows if row.resolved and math.isfinite(row.gain) and row.gain > 0.0]
    if len(known) < 10:
        return []
    p, gain = (np.log([getattr(row, name) for row in known]) for name in ("predictor", "gain"))
    systems = len({row.system for row in known})
    lines = [
        f"{len(known)} candidates on {systems} systems that came to the end, in trials that resolve the motion: the",
        f"correlation of log P and log gain is {np.corrcoef(p, gain)[0, 1]:.2f}, and the gain is "
        f"{np.exp(np.median(gain - p)):.2f} P in the median.",
        "",
        "| P | candidates | failed | gain above 1.25 | median gain |",
        "|---|---|---|---|---|",
    ]
    for low, high in ((0.0, 1.0), (1.0, 2.2), (2.2, 3.3), (3.3, 5.0), (5.0, math.inf)):
        own = [row for row in rows if row.resolved and low <= row.predictor < high]
        gains = [row.gain for row in own if math.isfinite(row.gain)]
        if own:
            words = f"{low:g} to {high:g}" if math.isfinite(high) else f"above {low:g}"
            failed = sum(row.failure is not None for row in own)
            share = sum(gain > 1.25 for gain in gains) / len(own)
            median = two_digits(float(np.median(gains))) if gains else "-"
            lines.append(f"| {words} | {len(own)} | {failed} | {100 * share:.0f} % | {median} |")
    return lines


def _draw(rows: Sequence[Row], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 5.5), dpi=100, layout="constrained")
    axes = figure.subplots()
    known = [row for row in rows if row.resolved and math.isfinite(row.gain)]
    colours = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#555555")
    for index, system in enumerate(dict.fromkeys(row.system for row in known)):
        own = [row for row in known if row.system == system]
        axes.scatter(
            [row.predictor for row in own],
            [row.gain for row in own],
            s=14,
            color=colours[index % len(colours)],
            marker="os^D"[index // len(colours)],
            label=system,
            alpha=0.8,
            linewidths=0,
        )
    ends = np.array(axes.get_xlim())
    ends[0] = max(ends[0], 1e-2)
    axes.plot(ends, 0.45 * ends, color="black", linewidth=1.0, label="0.45 P")
    axes.axhline(1.0, color="#bbbbbb", linewidth=0.8, zorder=0)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("P, from a trial with fixed steps")
    axes.set_ylabel("gain, measured")
    axes.set_title("Each monitor with each pair of bounds, update Explicit", fontsize=11)
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=8)
    figure.savefig(path, pil_kwargs={"optimize": True})


if __name__ == "__main__":
    sys.exit(main())
