# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Draw the picture of the README anew: `make pictures`, about ten seconds.

It is the picture of `python -m openmmvrattle compare --system double-pendulum`, with a headline and words for readers
who have seen none of it before. The other pictures of the documentation are made by the scripts that their pages name.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from openmmvrattle.compare.comparison import Comparison, compare, two_digits
from openmmvrattle.compare.plots import draw_comparison
from openmmvrattle.testsystems import SYSTEMS

DEFAULT_PATH = Path(__file__).parent / "images" / "double-pendulum.png"

INTEGRATORS = ["VerletIntegrator", "VariableVerletIntegrator", "RATTLE", "VRATTLE"]
NAMES = {
    "fixed": "OpenMM's VerletIntegrator",
    "variable": "OpenMM's VariableVerletIntegrator",
    "control": "this plugin, fixed steps (RATTLE)",
    "vrattle": "this plugin, variable steps (VRATTLE)",
}


def run_comparison() -> Comparison:
    """The four runs of the picture."""
    return compare(SYSTEMS["double-pendulum"](), integrators=INTEGRATORS)


def draw(comparison: Comparison) -> Figure:
    """The picture: energy errors above, step sizes below."""
    figure = draw_comparison(comparison)
    top, bottom = figure.axes
    variable = comparison.run_of("vrattle")
    gain = comparison.gain(variable)
    top.set_title("")
    figure.suptitle(
        f"A double pendulum, {comparison.force_evaluations:,} force evaluations each: with steps that follow\n"
        f"the constraint forces, the energy error is {two_digits(gain)} times smaller than with fixed ones",
        fontsize=12.5,
    )
    names = [f"{NAMES[run.method]}: up to {two_digits(run.largest_energy_error)} kJ/mol" for run in comparison.runs]
    handles, _ = top.get_legend_handles_labels()
    for legend in figure.legends:
        legend.remove()
    figure.legend(handles, names, loc="outside lower center", ncols=2, frameon=False, fontsize=9.5)
    annotate_whip(bottom, variable.series.times, variable.series.step_sizes)
    return figure


def annotate_whip(axes: Axes, times: np.ndarray, steps: np.ndarray) -> None:
    """Say what the moments are at which the steps are small, at the one with most room after it."""
    small = times[steps < 10 * np.nanmin(steps)]
    whips = small[np.flatnonzero(np.diff(small, prepend=-1.0) > 0.2)]
    before = whips[np.argmax(np.diff(whips))]
    axes.annotate(
        "each dip is a whip: the\nlight bob between the\nrods is flung around",
        xy=(before + 0.04, 1e-5),
        xytext=(before + 0.4, 8e-6),
        fontsize=9.5,
        va="center",
        arrowprops={"arrowstyle": "->", "color": "#555555"},
    )


def main() -> None:
    """Run the comparison and save the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=DEFAULT_PATH)
    path = parser.parse_args().output
    draw(run_comparison()).savefig(path)
    print(f"{path}: {path.stat().st_size // 1000} kB")


if __name__ == "__main__":
    main()
