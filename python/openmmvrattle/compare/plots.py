# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Pictures of comparisons: energy error and step size against time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from . import require
from .advice import Advice
from .comparison import Comparison, envelope, two_digits
from .measurement import IntegratorRun

require("a picture", "matplotlib")
from matplotlib.figure import Figure  # noqa: E402 - after the plain sentence for where it is missing

__all__ = ["draw_comparison", "draw_trial", "save_comparison", "save_trial"]

# Colours that can be told apart with any colour vision (Okabe and Ito).
_COLOURS = {"fixed": "#E69F00", "variable": "#56B4E9", "control": "#555555"}
_PRODUCT_COLOURS = ("#D55E00", "#009E73", "#CC79A7", "#0072B2")
# Fixed steps and OpenMM's variable steps often coincide: a wide line, a narrow one on it and dashes can all be seen.
_STYLES: dict[str, dict[str, Any]] = {
    "fixed": {"linewidth": 3.2, "alpha": 0.7, "zorder": 2},
    "variable": {"linewidth": 1.3, "zorder": 2.2},
    "control": {"linewidth": 1.3, "linestyle": (0, (4, 2)), "zorder": 2.4},
    "vrattle": {"linewidth": 1.8, "zorder": 3},
}
_ENERGY_FLOOR = 1e-12
"""kJ/mol; smaller errors cannot be told from rounding."""


def draw_comparison(comparison: Comparison, windows: int = 300) -> Figure:
    """Draw the energy error of all runs above their step sizes.

    Each line shows the largest value in each of many short windows of time, the shade below it reaches to the smallest.

    Args:
        comparison: the runs to draw.
        windows: the number of windows across the picture.
    """
    figure = Figure(figsize=(9.0, 6.4), dpi=110, layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    product_colours = iter(_PRODUCT_COLOURS * 3)
    for run in comparison.runs:
        colour = _COLOURS.get(run.method) or next(product_colours)
        if len(run.series.times) > 1:
            _draw_run(top, bottom, comparison, run, colour, windows)
        else:
            top.plot([], [], color=colour, label=_label(comparison, run))
    top.set_yscale("log")
    top.set_ylim(bottom=_lower_limit(top, comparison))
    top.set_ylabel("energy error |E - E(0)|\n(kJ/mol)")
    top.set_title(f"{comparison.description}\n{_what_is_equal(comparison)}", fontsize=11)
    bottom.set_yscale("log" if _step_range(comparison) > 5.0 else "linear")
    bottom.set_ylabel("step size (ps)")
    bottom.set_xlabel("time (ps)")
    bottom.set_xlim(0.0, comparison.total_time)
    for axes in (top, bottom):
        axes.grid(True, which="major", color="#dddddd", linewidth=0.6)
        axes.set_axisbelow(True)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    figure.legend(*top.get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False, fontsize=9.5)
    return figure


def save_comparison(comparison: Comparison, path: Path) -> None:
    """Draw a comparison and write it to a PNG file."""
    draw_comparison(comparison).savefig(path)


def _what_is_equal(comparison: Comparison) -> str:
    """What all integrators were given."""
    if comparison.wanted_error is not None:
        return f"as many force evaluations as a largest energy error of {comparison.wanted_error:g} kJ/mol takes"
    return f"about {comparison.force_evaluations:,} force evaluations each"


def _label(comparison: Comparison, run: IntegratorRun) -> str:
    """The name of a run and what came of it."""
    if run.failure is not None:
        return f"{run.name}: failed at {run.simulated_time:.3g} ps" if run.steps else f"{run.name}: failed"
    if comparison.wanted_error is not None:
        return f"{run.name}: {run.force_evaluations:,} evaluations"
    return f"{run.name}: at most {two_digits(run.largest_energy_error)} kJ/mol"


def _lower_limit(axes: Any, comparison: Comparison) -> float | None:
    """Where an axis of energy errors may begin: below the lines, but not far below what the best run has at its worst.

    Many begin at rounding, which would take half of the picture.
    """
    values = np.concatenate([np.asarray(line.get_ydata(), dtype=float) for line in axes.lines] or [np.array([])])
    if not len(values):
        return None
    best = comparison.best()
    floor = 1e-5 * best.largest_energy_error if best is not None else 0.0
    return max(float(values.min()) / 3.0, floor)


def _step_range(comparison: Comparison) -> float:
    """The largest step of any run divided by the smallest."""
    runs = [run for run in comparison.runs if run.steps]
    return max(run.largest_step for run in runs) / min(run.smallest_step for run in runs) if runs else 1.0


def _draw_run(top: Any, bottom: Any, comparison: Comparison, run: IntegratorRun, colour: str, windows: int) -> None:
    reduced = envelope(run.series, comparison.total_time, windows)
    largest = np.maximum(np.abs(reduced.largest_energy_errors), _ENERGY_FLOOR)
    smallest = np.maximum(np.abs(reduced.smallest_energy_errors), _ENERGY_FLOOR)
    style: dict[str, Any] = {"color": colour} | _STYLES[run.method]
    order = style["zorder"]
    top.plot(reduced.times, largest, label=_label(comparison, run), **style)
    top.fill_between(reduced.times, smallest, largest, color=colour, alpha=0.1, linewidth=0, zorder=order - 1.5)
    bottom.plot(reduced.times, reduced.smallest_steps, **style)
    bottom.fill_between(
        reduced.times,
        reduced.smallest_steps,
        reduced.largest_steps,
        color=colour,
        alpha=0.2,
        linewidth=0,
        zorder=order - 1.5,
    )


def draw_trial(advice: Advice, description: str) -> Figure:
    """Draw the energy error of a trial above the monitors along it, each relative to its mean.

    Args:
        advice: what the trial says.
        description: of the system, for the title.
    """
    trial = advice.trial
    figure = Figure(figsize=(9.0, 6.2), dpi=110, layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True)
    windows = max(1, len(trial.times) // 2000)

    def reduced(values: np.ndarray) -> np.ndarray:
        """The largest of each few values, so that a long trial keeps its peaks."""
        whole = len(values) // windows * windows
        return values[:whole].reshape(-1, windows).max(axis=1)

    times = reduced(trial.times)
    errors = np.maximum(reduced(np.abs(trial.energy_errors)), _ENERGY_FLOOR)
    top.plot(times[1:], errors[1:], color=_COLOURS["control"])
    top.set_yscale("log")
    top.set_ylim(bottom=max(float(errors[1:].min()) / 3.0, 1e-6 * float(errors.max())))
    top.set_ylabel("energy error |E - E(0)|\n(kJ/mol)")
    top.set_title(f"{description}: fixed steps of {trial.step_size:.4g} ps", fontsize=11)
    best: dict[str, float] = {}
    for candidate in advice.candidates:
        kind = candidate.control.monitors[0].kind
        best[kind] = max(best.get(kind, 0.0), candidate.predictor)
    leading = sorted(best, key=lambda kind: -best[kind])[: len(_PRODUCT_COLOURS)]
    for colour, kind in zip(_PRODUCT_COLOURS, leading, strict=False):
        values = trial.monitor_values[kind]
        label = f"{kind}, P up to {best[kind]:.2g}"
        bottom.plot(times, reduced(values / values.mean()), color=colour, linewidth=1.2, label=label)
    bottom.set_yscale("log")
    bottom.set_ylabel("monitor U / mean U")
    bottom.set_xlabel("time (ps)")
    for axes in (top, bottom):
        axes.grid(True, which="major", color="#dddddd", linewidth=0.6)
        axes.set_axisbelow(True)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    if leading:
        figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=9.5)
    return figure


def save_trial(advice: Advice, description: str, path: Path) -> None:
    """Draw a trial and write it to a PNG file.

    Args:
        advice: what the trial says.
        description: of the system, for the title.
        path: the file.
    """
    draw_trial(advice, description).savefig(path)
