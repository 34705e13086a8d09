# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The folder with the results of comparisons: tables, courses, pictures and one report to read in a browser."""

from __future__ import annotations

import base64
import html
import json
import math
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import openmm

from .. import __version__
from . import plots
from .comparison import Comparison, two_digits, verdict, write_json, write_series, write_summary
from .measurement import IntegratorRun

__all__ = ["MeanGain", "ResultFolder", "gain_rows", "mean_gains", "measures_of"]

_INDEX = "comparison.json"
"""Lists the files of a comparison, so that a later one can tell them from files of the user."""


class ResultFolder:
    """A folder into which comparisons are written as they are finished.

    After each of them the folder is complete: an interrupt leaves the files of all that was done.
    """

    def __init__(self, path: Path, command: str = "", overwrite: bool = False) -> None:
        """Make the folder. Results of an earlier comparison in it are moved to a folder earlier-1, earlier-2 and so on.

        Args:
            path: the folder.
            command: the command line, for the report.
            overwrite: whether to replace earlier results instead.
        """
        self.path = path
        self.moved_to: Path | None = None
        """Where earlier results were moved."""
        self._command = command
        self._started = datetime.now().astimezone()
        self._files: list[str] = []
        self._comparisons: dict[int, Comparison] = {}
        path.mkdir(parents=True, exist_ok=True)
        self._clear(overwrite)

    def _clear(self, overwrite: bool) -> None:
        index = self.path / _INDEX
        if not index.exists():
            return
        try:
            names = [str(name) for name in json.loads(index.read_text(encoding="utf-8"))["files"]]
        except (ValueError, KeyError, TypeError):
            names = []
        earlier = [self.path / Path(name).name for name in [*names, _INDEX]]
        if not overwrite:
            number = 1
            while (self.path / f"earlier-{number}").exists():
                number += 1
            self.moved_to = self.path / f"earlier-{number}"
            self.moved_to.mkdir()
        for file in earlier:
            if file.is_file():
                if self.moved_to is None:
                    file.unlink()
                else:
                    file.rename(self.moved_to / file.name)

    def add(self, index: int, comparison: Comparison) -> None:
        """Write the files of one comparison, and those of all anew.

        Args:
            index: its place among all.
            comparison: what to write; one without runs is left out.
        """
        if not comparison.runs:
            return
        self._comparisons[index] = comparison
        name = comparison.label
        files = [f"{name}-series.csv", f"{name}.json", f"{name}.png"]
        everything = ["summary.csv", "report.html"]
        self._files += [file for file in files if file not in self._files]
        # The index first: whatever happens in between, the next comparison knows these files.
        content = {
            "files": [*self._files, *everything],
            "command": self._command,
            "started": self._started.isoformat(timespec="seconds"),
            "openmm_version": openmm.Platform.getOpenMMVersion(),
            "openmm_vrattle_version": __version__,
        }
        (self.path / _INDEX).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        write_series(comparison, self.path / files[0])
        write_json(comparison, self.path / files[1])
        plots.save_comparison(comparison, self.path / files[2])
        comparisons = self.comparisons()
        write_summary(comparisons, self.path / everything[0])
        (self.path / everything[1]).write_text(self._report(comparisons), encoding="utf-8")

    def comparisons(self) -> list[Comparison]:
        """What was written so far, in order."""
        return [comparison for _, comparison in sorted(self._comparisons.items())]

    def _report(self, comparisons: Sequence[Comparison]) -> str:
        title = "Comparison of integrators"
        facts = [
            f"OpenMM-VRATTLE {__version__}, OpenMM {openmm.Platform.getOpenMMVersion()}, Python "
            f"{platform.python_version()}, {platform.machine()}; begun {self._started:%Y-%m-%d %H:%M}.",
            "All integrators start from the same state and cover the same simulated time. RATTLE with fixed steps "
            "differs from VRATTLE in nothing but the steps; the gain is its largest energy error divided by that of "
            "VRATTLE.",
        ]
        body = [f"<h1>{title}</h1>"]
        body += [f"<p>{html.escape(fact)}</p>" for fact in facts]
        if self._command:
            body.append(f"<pre>{html.escape(self._command)}</pre>")
        headings, gains = gain_rows(comparisons)
        if len(comparisons) > 1 and gains:
            body += ["<h2>Gains over RATTLE with fixed steps</h2>", _table(headings, gains)]
        body += [self._section(comparison) for comparison in comparisons]
        return _PAGE.format(title=title, body="\n".join(body))

    def _section(self, comparison: Comparison) -> str:
        picture = base64.b64encode((self.path / f"{comparison.label}.png").read_bytes()).decode("ascii")
        headings = ["integrator", *(heading.replace("\n", " ") for heading in measures_of(comparison.runs[0]))]
        rows = []
        for run in comparison.runs:
            name = run.name if run.failure is None else f"{run.name} (failed)"
            rows.append([name, *measures_of(run).values()])
        best = comparison.best()
        marked = [i for i, run in enumerate(comparison.runs) if run is best]
        failed = [i for i, run in enumerate(comparison.runs) if run.failure is not None]
        start = f"E(0) = {comparison.initial_energy:.6g} kJ/mol"
        facts = f"{comparison.total_time:g} ps, platform {comparison.platform}, {start}"
        sentences = [*comparison.notes, *verdict(comparison)]
        return "\n".join(
            [
                f'<section id="{html.escape(comparison.label)}"><h2>{html.escape(comparison.label)}</h2>',
                f"<p>{html.escape(comparison.description)}; {html.escape(facts)}.</p>",
                _table(headings, rows, marked, failed),
                "<ul>" + "".join(f"<li>{html.escape(sentence)}</li>" for sentence in sentences) + "</ul>",
                f'<img alt="energy error and step size against time" src="data:image/png;base64,{picture}"></section>',
            ]
        )


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
body {{ font-family: system-ui, sans-serif; max-width: 75rem; margin: 2rem auto; padding: 0 1rem; line-height: 1.45; }}
table {{ border-collapse: collapse; font-size: 0.9rem; }}
th, td {{ padding: 0.25rem 0.6rem; text-align: right; border-bottom: 1px solid #ddd; }}
th:first-child, td:first-child {{ text-align: left; }}
tr.best {{ font-weight: bold; background: #e8f5ee; }}
tr.failed {{ color: #a03000; }}
pre {{ background: #f4f4f4; padding: 0.6rem; overflow-x: auto; }}
img {{ max-width: 100%; }}
</style>
</head>
<body>
{body}
</body>
</html>
"""


def _table(
    headings: Sequence[str], rows: Sequence[Sequence[str]], best: Sequence[int] = (), failed: Sequence[int] = ()
) -> str:
    lines = ["<table>", "<tr>" + "".join(f"<th>{html.escape(heading)}</th>" for heading in headings) + "</tr>"]
    for index, row in enumerate(rows):
        kind = ' class="best"' if index in best else ' class="failed"' if index in failed else ""
        lines.append(f"<tr{kind}>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>")
    return "\n".join([*lines, "</table>"])


def measures_of(run: IntegratorRun) -> dict[str, str]:
    """What tables show of a run, by heading."""
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


@dataclass(frozen=True)
class MeanGain:
    """The gains of one integrator on one system over all its starts, at one number of force evaluations."""

    system: str
    asked: str
    """The force evaluations, or the energy error, that was asked for."""
    integrator: str
    starts: int
    failures: int
    mean: float
    """The geometric mean over the starts that were finished; NaN if there is none."""
    smallest: float
    largest: float


def mean_gains(comparisons: Sequence[Comparison]) -> list[MeanGain]:
    """The gains over RATTLE with fixed steps, put together over the starts of each system.

    At equal accuracy they are the force evaluations saved, otherwise the energy errors divided.
    """
    groups: dict[tuple[str, str, str], list[float]] = {}
    for comparison in comparisons:
        by_accuracy = comparison.wanted_error is not None
        asked = f"{comparison.wanted_error:g} kJ/mol" if by_accuracy else f"{comparison.force_evaluations:,}"
        for run in comparison.runs:
            if run.method != "control":
                gain = comparison.saving(run) if by_accuracy else comparison.gain(run)
                groups.setdefault((comparison.system_name, asked, run.name), []).append(gain)
    rows = []
    for (system, asked, integrator), gains in groups.items():
        known = [gain for gain in gains if math.isfinite(gain)]
        mean = math.exp(sum(map(math.log, known)) / len(known)) if known else math.nan
        low, high = min(known, default=math.nan), max(known, default=math.nan)
        rows.append(MeanGain(system, asked, integrator, len(gains), len(gains) - len(known), mean, low, high))
    return rows


def gain_rows(comparisons: Sequence[Comparison]) -> tuple[list[str], list[list[str]]]:
    """The headings and the rows of the table of `mean_gains`."""
    headings = ["system", "asked for", "integrator", "starts", "failures", "mean gain", "from", "to"]
    rows = []
    for gain in mean_gains(comparisons):
        numbers = [two_digits(value) for value in (gain.mean, gain.smallest, gain.largest)]
        rows.append([gain.system, gain.asked, gain.integrator, str(gain.starts), str(gain.failures), *numbers])
    return headings, rows
