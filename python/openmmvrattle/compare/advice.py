# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Would variable steps pay on this system? A short run with fixed steps tells, without trying every setting.

>>> import openmmvrattle
>>> from openmmvrattle.testsystems import light_heavy_chain
>>> chain = light_heavy_chain()
>>> advice = openmmvrattle.advise(chain.system, chain.positions, chain.velocities, step_size=0.00125, steps=16_000)
>>> advice.verdict
'variable steps'
>>> integrator = advice.make_integrator()

The trial has fixed steps (RATTLE) and records the energy and every monitor U after each step. The energy error of
Verlet's method is local: it grows where the motion is hard, comes back afterwards, and is proportional to the square of
the step. So with e the energy error, e0 its mean over the calmest tenth of the points (those with the lowest U), and
rho the step density that a monitor with given bounds would have asked for,

    P = max |e - e0| / max |e - e0| (mean(rho) / rho)^2

says by how much the largest energy error would shrink at an equal number of force evaluations. Measured gains are about
0.45 P, since the density lags behind the monitor and steps that vary have errors of their own. Below P = 2.2 variable
steps have nothing to offer, above 5 they practically always pay, and in between it depends.

Where the steps of the trial are too large for the hardest moments, the energy does not come back, and e is no local
error any more. Then e is replaced by the leading term of the error, -step^2 (V''/12 + U^2/24) with V'' the second time
derivative of the potential energy and U the monitor ``ConstraintAndAppliedForce``; both are known from the trial.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import openmm
from openmm import unit

from .. import VariableStepRattleIntegrator
from .._arguments import number
from ..platforms import make_context
from ..testsystems import MonitorSettings, StepControl, TestSystem

__all__ = [
    "BOUNDS",
    "MONITORS",
    "Advice",
    "AdviceError",
    "Candidate",
    "Trial",
    "advise",
    "advise_on",
    "measured_gain",
    "predictor",
]

MONITORS = (
    MonitorSettings("ConstraintAndAppliedForce"),
    MonitorSettings("ConstraintForce"),
    MonitorSettings("ConstraintMultipliers"),
    MonitorSettings("AppliedForce"),
    MonitorSettings("ForcePNorm"),
    MonitorSettings("ForcePNorm", power=0.5),
    MonitorSettings("MaxForce"),
    MonitorSettings("MultiplierPNorm"),
    MonitorSettings("VectorField"),
    MonitorSettings("ArcLength"),
    MonitorSettings("MaxParticleArcLength"),
)
"""The monitors that are judged by default."""
BOUNDS = ((1 / 20, 1.25), (1 / 50, 2.0), (1 / 100, 4.0), (1 / 100, 10.0), (1e-4, 10.0))
"""The bounds that are judged by default, the smallest and the largest step divided by the nominal one."""
GAIN_OF_PREDICTOR = 0.45
"""The gain that is expected for P = 1."""
SURE_PREDICTOR = 5.0
"""Variable steps are recommended from this P on."""
LEAST_PREDICTOR = 2.2
"""Below this P nothing is gained."""
_NEARLY_AS_GOOD = 0.67
"""Of candidates whose P is at least this part of the best one, the one with the narrowest bounds is recommended."""
_LAST_RESORT = ("VectorField", "ArcLength", "MaxParticleArcLength", "MaxForce", "MultiplierPNorm")
"""Monitors that mix units, have kinks, or follow from how constraints are written: only where no other is as good."""
_LOST_ENERGY = 10.0
"""A trial whose energy error is that many times the energies at the start has failed."""
_NEED_CONSTRAINTS = ("ConstraintMultipliers", "ConstraintForce", "MultiplierPNorm")
_HALVINGS = 4
"""How often the step of a trial that fails is halved."""


class AdviceError(Exception):
    """The trial cannot be run; the message says why."""


@dataclass(frozen=True)
class Trial:
    """A run with fixed steps; one entry for each step, and one for the start."""

    step_size: float
    """ps"""
    times: np.ndarray
    """ps"""
    energy_errors: np.ndarray
    """The energy minus that at the start, kJ/mol."""
    potential_energies: np.ndarray
    """kJ/mol"""
    monitor_values: dict[str, np.ndarray]
    """The value U of each kind of monitor, in its unit."""

    @property
    def largest_energy_error(self) -> float:
        """In kJ/mol."""
        return float(np.max(np.abs(self.energy_errors)))

    def leading_errors(self) -> np.ndarray:
        """The leading term of the energy error, kJ/mol, but for a constant."""
        size = self.step_size
        curvature = np.zeros_like(self.potential_energies)
        curvature[1:-1] = np.diff(self.potential_energies, 2) / size**2
        curvature[0], curvature[-1] = curvature[1], curvature[-2]
        return -(size**2) * (curvature / 12 + self.monitor_values["ConstraintAndAppliedForce"] ** 2 / 24)

    def is_resolved(self) -> bool:
        """Whether the energy comes back after hard moments, so that its error says where the motion is hard."""
        difficulty = self.monitor_values["ConstraintAndAppliedForce"]
        calm = difficulty <= np.median(difficulty)
        measured, leading = (_deviations(e, difficulty) for e in (self.energy_errors, self.leading_errors()))
        if not measured.max() > 0.0 or not leading.max() > 0.0:
            return True
        remains = float(measured[calm].max() / measured.max())
        expected = float(leading[calm].max() / leading.max())
        return remains < 0.01 or remains < 5.0 * expected


@dataclass(frozen=True)
class Candidate:
    """A monitor with bounds, and what it would bring."""

    control: StepControl
    """The settings, with the nominal step that gives as many force evaluations as the trial had."""
    predictor: float
    """P, by how much the largest error of the energy would shrink if steps followed the monitor at once."""
    largest_step: float
    """The largest step that the monitor would have asked for in the trial, ps."""
    smallest_step: float
    """The smallest one, ps."""

    @property
    def expected_gain(self) -> float:
        """The largest energy error of fixed steps divided by that of these settings, at equal force evaluations."""
        return GAIN_OF_PREDICTOR * self.predictor

    @property
    def monitor(self) -> str:
        """The monitor, with its power where that is not 1."""
        return _name_of(self.control.monitors[0])

    @property
    def bounds(self) -> tuple[float, float]:
        """The smallest and the largest step divided by the nominal one."""
        return self.control.smallest_step_ratio, self.control.largest_step_ratio


@dataclass(frozen=True)
class Advice:
    """What a trial says. ``print(advice)`` explains it, `make_integrator` does what it says."""

    verdict: str
    """``variable steps``, ``little to gain`` or ``fixed steps``."""
    best: Candidate | None
    """The candidate that promises most; None if no monitor sees anything."""
    trial: Trial = field(repr=False)
    candidates: tuple[Candidate, ...] = field(repr=False)
    """All of them, those that promise most first."""
    resolved: bool
    """Whether the steps of the trial were small enough for the hardest moments."""
    notes: tuple[str, ...] = ()
    """What was done to get the trial to run, and what was left out of the System, in sentences."""
    constraint_tolerance: float = 1e-8

    def __str__(self) -> str:
        return "\n".join([*self.sentences(), "", self.code()])

    def sentences(self) -> list[str]:
        """The advice in plain words."""
        from .comparison import two_digits

        trial = self.trial
        lines = [
            *self.notes,
            f"{len(trial.times) - 1:,} fixed steps of {trial.step_size:.4g} ps have a largest energy error of "
            f"{two_digits(trial.largest_energy_error)} kJ/mol.",
        ]
        if not self.resolved:
            lines.append(
                "These steps are too large for the hardest moments: the energy does not come back afterwards. P is "
                "taken from the leading term of the error instead, and says less about the size of the gain."
            )
        if self.best is None:
            lines.append("Use fixed steps: no monitor sees any force here.")
            return lines
        p, expected = two_digits(self.best.predictor), two_digits(self.best.expected_gain)
        gain = f"P = {p}, so a gain of about {expected} is expected"
        what = f"{self.best.monitor} with bounds {_bounds_in_words(self.best.bounds)}"
        if self.verdict == "variable steps":
            # The error of fixed steps falls with the square of their number.
            saved = math.sqrt(self.best.expected_gain)
            lines.append(
                f"Use variable steps: {what}. {gain} in the largest energy error, or the same error with about "
                f"{two_digits(saved)} times fewer force evaluations."
            )
            lines.append("Or without any settings: useAutomaticStepControl(), which mostly gains somewhat less.")
        elif self.verdict == "little to gain":
            lines.append(f"Use fixed steps: there is little to gain, if anything. The best was {what}: {gain}.")
            lines.append("Measure it before you use it: the option --check, or measured_gain().")
        else:
            lines.append(
                f"Use fixed steps: nothing promises a gain. The largest P is {two_digits(self.largest_predictor)}."
            )
            lines.append("useAutomaticStepControl() would hardly ever leave them here.")
        return lines

    @property
    def largest_predictor(self) -> float:
        """The largest P of all candidates; 0 if there are none."""
        return max((candidate.predictor for candidate in self.candidates), default=0.0)

    def make_integrator(self) -> VariableStepRattleIntegrator:
        """The integrator that is recommended: with variable steps, or without a monitor, which is fixed steps."""
        from .measurement import make_integrator

        control = StepControl((), self.trial.step_size)
        if self.verdict == "variable steps" and self.best is not None:
            control = self.best.control
        integrator = make_integrator(control)
        integrator.setConstraintTolerance(self.constraint_tolerance)
        return integrator

    def code(self) -> str:
        """The same as lines of Python."""
        name = "VariableStepRattleIntegrator"
        if self.verdict != "variable steps" or self.best is None:
            return (
                f"integrator = {name}({self.trial.step_size:.6g})  # ps\n"
                "integrator.clearMonitors()  # fixed steps; or OpenMM's VerletIntegrator"
            )
        control = self.best.control
        monitor, nominal = control.monitors[0], control.nominal_step_size
        lines = [
            f"integrator = {name}({nominal:.6g})  # ps, where the monitor has its reference value",
            "integrator.clearMonitors()",
            f"integrator.addMonitor({name}.{monitor.kind}, 1.0, {monitor.power:g})",
            f"integrator.setReferenceMonitorValue({control.reference_values[0]:.6g})",
            f"integrator.setUpdateMethod({name}.{control.update_method})",
            f"integrator.setMinimumStepSize({nominal * control.smallest_step_ratio:.6g})",
            f"integrator.setMaximumStepSize({nominal * control.largest_step_ratio:.6g})",
        ]
        return "\n".join(lines)


def advise(
    system: openmm.System,
    positions: Any,
    velocities: Any = None,
    *,
    step_size: float | unit.Quantity = 0.001,
    steps: int = 2000,
    platform: str = "Reference",
    temperature: float = 300.0,
    seed: int = 1,
    constraint_tolerance: float = 1e-8,
    monitors: Sequence[MonitorSettings] = MONITORS,
    bounds: Sequence[tuple[float, float]] = BOUNDS,
    progress: Callable[[float], None] | None = None,
) -> Advice:
    """Find out by a trial run with fixed steps whether variable steps would pay, and with which settings.

    The trial should be long enough to meet what is hard in the system, with steps as you would take them. Forces that
    change the energy, such as barostats, are left out of it. The System itself is not changed.

    Args:
        system: the System.
        positions: where it starts, nm or a Quantity.
        velocities: nm/ps or a Quantity; by default drawn at the temperature.
        step_size: the fixed step, ps or a Quantity.
        steps: the number of steps.
        platform: name of the OpenMM platform, as for `openmmvrattle.platforms`.
        temperature: of the velocities if none are given, K.
        seed: of these velocities.
        constraint_tolerance: relative tolerance of constrained distances.
        monitors: what to judge.
        bounds: the bounds to judge with each of them, the smallest and the largest step divided by the nominal one.
        progress: called with the fraction of the trial that is done.
    """
    from .inputs import from_system

    start = from_system("system", system, positions, velocities, temperature, seed, platform)
    size = number(step_size, "step_size", unit.picosecond)
    return advise_on(start, size, steps, platform, constraint_tolerance, monitors, bounds, progress)


def advise_on(
    start: TestSystem,
    step_size: float,
    steps: int,
    platform: str = "Reference",
    constraint_tolerance: float = 1e-8,
    monitors: Sequence[MonitorSettings] = MONITORS,
    bounds: Sequence[tuple[float, float]] = BOUNDS,
    progress: Callable[[float], None] | None = None,
) -> Advice:
    """The same as `advise` for a system as the comparisons take it; see there for what is not explained here.

    Args:
        start: a System with its start, which must meet the constraints.
        step_size: the fixed step, ps.
        steps: the number of steps.
        platform: name of the OpenMM platform, as for `openmmvrattle.platforms`.
        constraint_tolerance: relative tolerance of constrained distances.
        monitors: what to judge.
        bounds: the bounds to judge with each monitor.
        progress: called with the fraction of the trial that is done.
    """
    if not 0.0 < step_size < math.inf:
        raise ValueError(f"The step size must be positive, and not {step_size:g} ps.")
    if steps < 10:
        raise ValueError(f"A trial needs at least 10 steps, and not {steps}.")
    # A monitor that was made for the system, as a distance from its walls.
    own = [m for control in start.settings.controls for m in control.monitors if m.kind == "ForceGroupEnergy"]
    if monitors is MONITORS and start.monitor_force_group is not None:
        monitors = [*MONITORS, *dict.fromkeys(own)]
    if not start.system.getNumConstraints() and not start.expression_constraints:
        monitors = [monitor for monitor in monitors if monitor.kind not in _NEED_CONSTRAINTS]
    kinds = list(dict.fromkeys([*(monitor.kind for monitor in monitors), "ConstraintAndAppliedForce"]))
    trial, notes = _trial_that_works(start, step_size, steps, platform, constraint_tolerance, kinds, progress)
    resolved = trial.is_resolved()
    candidates = _candidates(trial, resolved, monitors, bounds)
    best = _recommended(candidates)
    if best is None or best.predictor < LEAST_PREDICTOR:
        verdict = "fixed steps"
    elif best.predictor < SURE_PREDICTOR:
        verdict = "little to gain"
    else:
        verdict = "variable steps"
    return Advice(verdict, best, trial, tuple(candidates), resolved, (*start.notes, *notes), constraint_tolerance)


def predictor(
    errors: np.ndarray, monitor_values: np.ndarray, smallest_step_ratio: float, largest_step_ratio: float
) -> float:
    """The number P from a run with fixed steps, as explained at the top of this module.

    Args:
        errors: energy errors along the run.
        monitor_values: the monitor, to its power, at the same points.
        smallest_step_ratio: the smallest step divided by the nominal one; 0 for no bound.
        largest_step_ratio: the largest step divided by the nominal one; 0 for no bound.

    Returns:
        P, or NaN where the monitor or the energy error is zero throughout.
    """
    mean = float(np.mean(monitor_values))
    deviations = _deviations(errors, monitor_values)
    if not mean > 0.0 or not deviations.max() > 0.0:
        return math.nan
    density = _density(monitor_values / mean, smallest_step_ratio, largest_step_ratio)
    scaled = deviations * (density.mean() / np.maximum(density, 1e-12)) ** 2
    return float(deviations.max() / scaled.max())


def _deviations(errors: np.ndarray, difficulty: np.ndarray) -> np.ndarray:
    """The size of energy errors, counted from their mean at the calmest tenth of the points."""
    calmest = np.argsort(difficulty, kind="stable")[: max(1, len(difficulty) // 10)]
    return np.abs(errors - errors[calmest].mean())


def _density(u: np.ndarray, smallest_step_ratio: float, largest_step_ratio: float) -> np.ndarray:
    """The step density that bounds make of a monitor relative to its reference value (docs/method.md, section 5)."""
    a = 1.0 / largest_step_ratio if largest_step_ratio else 0.0
    if not smallest_step_ratio:
        return a + (1.0 - a) * u
    b = 1.0 / smallest_step_ratio
    k = (1.0 - a) / (b - 1.0)
    return (a + b * k * u) / (1.0 + k * u)


def _candidates(
    trial: Trial, resolved: bool, monitors: Sequence[MonitorSettings], bounds: Sequence[tuple[float, float]]
) -> list[Candidate]:
    errors = trial.energy_errors if resolved else trial.leading_errors()
    candidates = []
    for monitor in monitors:
        values = trial.monitor_values[monitor.kind] ** monitor.power
        mean = float(values.mean())
        for smallest, largest in bounds:
            p = predictor(errors, values, smallest, largest)
            if not math.isfinite(p):
                continue
            density = _density(values / mean, smallest, largest)
            nominal = trial.step_size * float(density.mean())
            control = StepControl(
                monitors=(monitor,),
                nominal_step_size=nominal,
                smallest_step_ratio=smallest,
                largest_step_ratio=largest,
                update_method="Explicit",
                reference_values=(mean ** (1.0 / monitor.power),),
            )
            candidates.append(Candidate(control, p, nominal / float(density.min()), nominal / float(density.max())))
    return sorted(candidates, key=lambda candidate: candidate.predictor, reverse=True)


def _recommended(candidates: Sequence[Candidate]) -> Candidate | None:
    """Of those that promise nearly as much as the best, the first with the narrowest bounds: it is the safest."""
    if not candidates:
        return None
    good = [c for c in candidates if c.predictor >= _NEARLY_AS_GOOD * candidates[0].predictor]
    good = [c for c in good if c.control.monitors[0].kind not in _LAST_RESORT] or good
    return min(good, key=lambda candidate: (candidate.bounds[1] or math.inf, -candidate.bounds[0]))


def _trial_that_works(
    start: TestSystem,
    step_size: float,
    steps: int,
    platform: str,
    tolerance: float,
    kinds: Sequence[str],
    progress: Callable[[float], None] | None,
) -> tuple[Trial, list[str]]:
    """A trial over the time that was asked for, with smaller steps where it fails."""
    for halving in range(_HALVINGS + 1):
        size, number = step_size / 2**halving, steps * 2**halving
        try:
            trial = _run_trial(start, size, number, platform, tolerance, kinds, progress)
        except AdviceError as error:
            failure = str(error)
            continue
        notes = (
            [f"Fixed steps of {step_size:.4g} ps fail here ({failure.split(';')[0].rstrip('.')})."] if halving else []
        )
        return trial, notes
    raise AdviceError(f"fixed steps fail down to {size:.3g} ps: {failure}")


def _run_trial(
    start: TestSystem,
    step_size: float,
    steps: int,
    platform: str,
    tolerance: float,
    kinds: Sequence[str],
    progress: Callable[[float], None] | None,
) -> Trial:
    """Run fixed steps and read all monitors on the way.

    The integrator has all the monitors at once, but bounds that leave the steps no freedom: so the monitors are
    exactly those of the run, and cost no force evaluation.
    """
    integrator = VariableStepRattleIntegrator(step_size, VariableStepRattleIntegrator.Explicit)
    integrator.clearMonitors()
    for index, kind in enumerate(kinds):
        integrator.addMonitor(getattr(VariableStepRattleIntegrator, kind))
        integrator.setReferenceMonitorValue(1.0, index)
    integrator.setMinimumStepSize(step_size * (1.0 - 1e-9))
    integrator.setMaximumStepSize(step_size * (1.0 + 1e-9))
    integrator.setConstraintTolerance(tolerance)
    try:
        start.prepare(integrator)
        context = make_context(start.system, integrator, platform)
        for name, value in start.parameters:
            context.setParameter(name, value)
        context.setPositions(start.positions)
        context.setVelocities(start.velocities)
        energies = np.empty((steps + 1, 2))
        values = np.empty((steps + 1, len(kinds)))
        for step in range(steps + 1):
            if step:
                integrator.step(1)
            state = context.getState(energy=True, groups=start.force_groups)
            energies[step] = state.getPotentialEnergy()._value, state.getKineticEnergy()._value
            values[step] = [integrator.getMonitorValue(index) for index in range(len(kinds))]
            if not np.all(np.isfinite(energies[step])):
                raise AdviceError(f"at {step * step_size:.4g} ps the energy is not a number any more")
            if abs(energies[step].sum() - energies[0].sum()) > _LOST_ENERGY * (np.abs(energies[0]).sum() + 1.0):
                raise AdviceError(f"at {step * step_size:.4g} ps the energy is lost")
            if progress is not None and step % 64 == 0:
                progress(step / steps)
    except AdviceError:
        raise
    except Exception as error:
        raise AdviceError(" ".join(str(error).split()) or type(error).__name__) from error
    total = energies.sum(axis=1)
    return Trial(
        step_size=step_size,
        times=np.arange(steps + 1) * step_size,
        energy_errors=total - total[0],
        potential_energies=energies[:, 0],
        monitor_values={kind: values[:, index] for index, kind in enumerate(kinds)},
    )


def measured_gain(
    advice: Advice, start: TestSystem, platform: str = "Reference", automatic: bool = False
) -> tuple[float, str | None]:
    """Check an advice: run fixed and variable steps, both with as many force evaluations as the trial had.

    Args:
        advice: what to check.
        start: the system that it is about.
        platform: name of the OpenMM platform, as for `openmmvrattle.platforms`.
        automatic: whether to run the automatic step control, and not the best candidate of the advice.

    Returns:
        The largest energy error of fixed steps divided by that of variable ones, and None; or NaN and why they failed.
        Infinity, where fixed steps fail and variable ones do not.
    """
    from .measurement import methods_of, run_method

    if advice.best is None:
        return 1.0, None
    steps = len(advice.trial.times) - 1
    settings = replace(
        start.settings,
        total_time=float(advice.trial.times[-1]),
        force_evaluations=steps,
        controls=(advice.best.control,),
        constraint_tolerance=advice.constraint_tolerance,
    )
    fixed, variable = (
        run_method(method, start, platform, settings)
        for method in methods_of(settings, ("RATTLE", "Automatic" if automatic else "VRATTLE"))
    )
    if variable.failure is not None:
        return math.nan, variable.failure
    if fixed.failure is not None:
        return math.inf, None
    return fixed.largest_energy_error / max(variable.largest_energy_error, np.finfo(float).tiny), None


def _name_of(monitor: MonitorSettings) -> str:
    return monitor.kind if monitor.power == 1.0 else f"{monitor.kind}^{monitor.power:g}"


def _bounds_in_words(bounds: tuple[float, float]) -> str:
    smallest, largest = bounds
    low = f"1/{1 / smallest:,.0f}" if smallest else "none"
    return f"{low} and {f'{largest:g}' if largest else 'none'} of the nominal step"
