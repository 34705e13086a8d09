# OpenMM-VRATTLE: the CustomIntegrator after something has failed.
# SPDX-License-Identifier: MIT
"""Wherever a step fails, and whatever the user does next: the run is the one of an integrator that never failed.

Compared to the last bit on Reference, counts of forces and passes included.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import openmm
import pytest
from dense_reference import chain, open_context, positions_of, time_of, value, velocities_of
from openmmvrattle import ConstraintWarning
from openmmvrattle import CustomVariableStepRattleIntegrator as Custom
from openmmvrattle.testsystems import constraint_error, light_heavy_chain


class Fault:
    """A Force without force, which at a call of one's choice raises an exception, or gives what is not a number."""

    def __init__(self, particles: int) -> None:
        self.shape = (particles, 3)
        self.calls_left = math.inf
        self.gives_nan = False

    def __call__(self, state: openmm.State) -> tuple[float, np.ndarray]:
        self.calls_left -= 1
        if self.calls_left != 0:
            return 0.0, np.zeros(self.shape)
        if self.gives_nan:
            return 0.0, np.full(self.shape, np.nan)
        raise ValueError("no force here")


class Run:
    """An integrator on a chain of rigid bonds with the Force above."""

    def __init__(self, settings: dict[str, Any]) -> None:
        model = chain()
        system = model.system()
        self.fault = Fault(system.getNumParticles())
        system.addForce(openmm.PythonForce(self.fault))
        pull = openmm.CustomExternalForce("pull*x^2")
        pull.addGlobalParameter("pull", 0.0)
        energy = openmm.CustomExternalForce("1 + x^2")
        energy.setForceGroup(31)
        for particle in range(system.getNumParticles()):
            pull.addParticle(particle)
            energy.addParticle(particle)
        system.addForce(pull)
        if Custom.ForceGroupEnergy in settings.get("monitors", []):
            system.addForce(energy)
        self.integrator = Custom(0.0005, **settings)
        self.context = open_context(system, self.integrator, "Reference", model)

    def seen(self) -> np.ndarray:
        """All that can be seen of the state."""
        i, c = self.integrator, self.context
        numbers = [i.getStepDensity(), value(i.getStepSize()), time_of(c), c.getStepCount(), i.getNumRescues()]
        numbers += [i.getNumForceEvaluations(), i.getNumSolverIterations()]
        numbers += [i.getReferenceMonitorValue(k) for k in range(i.getNumMonitors())]
        return np.concatenate([numbers, positions_of(c).ravel(), velocities_of(c).ravel()])

    def trace(self, steps: int = 8) -> np.ndarray:
        """The same of some more steps."""
        rows = [self.seen()]
        for _ in range(steps):
            self.integrator.step(1)
            rows.append(self.seen())
        return np.array(rows)


SETTINGS: dict[str, dict[str, Any]] = {
    "default": {},
    "reference": {"referenceMonitorValue": 500.0},
    "explicit": {"monitors": [(Custom.AppliedForce, 1.0, 0.5), Custom.ForcePNorm], "updateMethod": Custom.Explicit},
    "bounded": {"monitors": [Custom.VectorField, Custom.ConstraintAndAppliedForce], "updateMethod": Custom.Bounded},
    "group": {"monitors": [Custom.ForceGroupEnergy]},
    "fixed": {"monitors": []},
}


def turned(run: Run) -> None:
    run.context.setVelocities(-0.9 * velocities_of(run.context))


NEXT: dict[str, Callable[[Run], Any]] = {
    "nothing": lambda run: None,
    "nominal step": lambda run: run.integrator.setStepSize(0.0003),
    "minimum": lambda run: run.integrator.setMinimumStepSize(0.0002),
    "maximum": lambda run: run.integrator.setMaximumStepSize(0.0006),
    "tolerance": lambda run: run.integrator.setConstraintTolerance(1e-10),
    "order": lambda run: run.integrator.setNormOrder(4),
    "reference value": lambda run: run.integrator.getNumMonitors() and run.integrator.setReferenceMonitorValue(600.0),
    "reference anew": lambda run: run.integrator.getNumMonitors() and run.integrator.setReferenceMonitorValue(0.0),
    "parameter": lambda run: run.context.setParameter("pull", 5.0),
    "velocities": turned,
    "calibration": lambda run: run.integrator.getNumMonitors() and run.integrator.calibrate(5),
    "reverse": lambda run: run.integrator.reverse(),
}

# What is done before, what is done when it fails, and at which computation of the forces in it; NaN or an exception.
FAILURES: dict[str, tuple[int, Callable[[Run], Any], int, bool]] = {
    "at the start": (0, lambda run: run.integrator.step(5), 1, False),
    "in the first step": (0, lambda run: run.integrator.step(5), 2, False),
    "in the first step, tried again": (0, lambda run: run.integrator.step(5), 3, False),
    "in a later step": (7, lambda run: run.integrator.step(5), 3, False),
    "in a step to a time": (7, lambda run: run.integrator.stepTo(time_of(run.context) + 0.0012), 2, False),
    "in the shortened step": (7, lambda run: run.integrator.stepTo(time_of(run.context) + 0.0002), 2, False),
    "in a calibration": (7, lambda run: run.integrator.calibrate(5), 3, False),
    "in a calibration before the first step": (0, lambda run: run.integrator.calibrate(5), 3, False),
    "in a reversal": (7, lambda run: run.integrator.reverse(), 1, False),
    "after a change by the user": (7, lambda run: (turned(run), run.integrator.step(5)), 2, False),
    "no number in the first step": (0, lambda run: run.integrator.step(5), 2, True),
    "no number in a later step": (7, lambda run: run.integrator.step(5), 3, True),
    "no number in the last of some steps": (7, lambda run: run.integrator.step(3), 3, True),
    "no number in a step to a time": (7, lambda run: run.integrator.stepTo(time_of(run.context) + 0.0012), 2, True),
    "no number in a calibration": (7, lambda run: run.integrator.calibrate(5), 3, True),
    "no number in a reversal": (7, lambda run: run.integrator.reverse(), 1, True),
}


def failed_run(settings: str, failure: str) -> Run:
    """A run in which something has failed."""
    before, act, call, gives_nan = FAILURES[failure]
    run = Run(SETTINGS[settings])
    run.integrator.step(before)
    run.fault.calls_left, run.fault.gives_nan = call, gives_nan
    with pytest.raises(openmm.OpenMMException, match="not finite" if gives_nan else "no force here"):
        act(run)
    run.fault.calls_left = math.inf
    return run


def undisturbed_run(settings: str, failure: str, steps: int) -> Run:
    """One that has never failed, after as many steps."""
    before, _, _, _ = FAILURES[failure]
    run = Run(SETTINGS[settings])
    run.integrator.step(min(before, steps))
    if "user" in failure:
        turned(run)
    if steps > before:
        run.integrator.step(steps - before)
    return run


def cases() -> list[Any]:
    """Each failure with the settings and the next acts that can tell it from others."""
    pairs = [("default", failure, act) for failure in FAILURES for act in ("nothing", "reverse")]
    # The other programs, and what else the user may do, after those failures that leave a step at different places.
    some = ("in the first step", "in a later step", "in the shortened step", "no number in a later step")
    pairs += [(settings, failure, "nothing") for settings in SETTINGS if settings != "default" for failure in some]
    pairs += [("reference", "in the first step, tried again", "nothing")]
    pairs += [("reference", failure, act) for failure in (some[0], some[-1]) for act in NEXT if act != "nothing"]
    return [pytest.param(*pair, id=", ".join(pair)) for pair in pairs]


@pytest.mark.parametrize("settings, failure, act", cases())
def test_a_failure_leaves_nothing_behind(settings: str, failure: str, act: str) -> None:
    run = failed_run(settings, failure)
    steps = run.context.getStepCount()
    expected = undisturbed_run(settings, failure, steps)
    np.testing.assert_array_equal(run.seen()[7:], expected.seen()[7:])
    for each in (run, expected):
        NEXT[act](each)
    np.testing.assert_array_equal(run.trace(), expected.trace())
    if settings == "reference" and "first step" in failure:
        assert steps == 0


def whip(**settings: Any) -> tuple[Custom, openmm.Context]:
    """The chain I-H-I, whose bonds OpenMM's solver loses after some hundred steps."""
    test = light_heavy_chain()
    integrator = Custom(0.00125, minimumStepSize=1.25e-5, maximumStepSize=1.25e-2, **settings)
    return integrator, open_context(test.system, integrator, "Reference", test)


def steps_until_lost(integrator: Custom, context: openmm.Context) -> int:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(openmm.OpenMMException, match="has lost the .* the Context is in the state after step"):
            integrator.step(100_000)
    return context.getStepCount()


@pytest.mark.parametrize("act", ["nothing", "nominal step", "reverse"])
def test_lost_constraints_leave_the_last_state_that_met_them(act: str) -> None:
    """What is left is the run up to where it was last looked at."""
    runs = [whip(), whip()]
    steps = steps_until_lost(*runs[0])
    assert steps > 100
    assert constraint_error(runs[0][1].getSystem(), positions_of(runs[0][1])) < 1e-3
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        runs[1][0].step(steps)
    for integrator, _ in runs:
        if act == "nominal step":
            integrator.setNominalStepSize(0.0003)
        elif act == "reverse":
            integrator.reverse()
    for _ in range(4):
        seen = [
            [time_of(context), *positions_of(context).ravel(), *velocities_of(context).ravel()] for _, context in runs
        ]
        np.testing.assert_array_equal(*seen)
        for integrator, _ in runs:
            integrator.step(1)


def test_a_warning_that_is_raised_leaves_the_steps_that_were_taken() -> None:
    """As docs/custom.md has it, to stop at the first one."""
    runs = [whip(), whip()]
    with warnings.catch_warnings():
        warnings.simplefilter("error", ConstraintWarning)
        with pytest.raises(ConstraintWarning):
            runs[0][0].step(100_000)
        steps = runs[0][1].getStepCount()
        warnings.simplefilter("ignore", ConstraintWarning)
        runs[1][0].step(steps)
    assert 0 < steps < 10_000
    np.testing.assert_array_equal(positions_of(runs[0][1]), positions_of(runs[1][1]))
    assert time_of(runs[0][1]) == time_of(runs[1][1])


def test_a_setting_that_was_changed_stays_when_constraints_are_lost() -> None:
    integrator, context = whip(monitors=[])
    integrator.step(21)
    integrator.setNominalStepSize(0.1)
    integrator.setMaximumStepSize(0.0)
    assert 10 <= steps_until_lost(integrator, context) <= 21
    assert value(integrator.getNominalStepSize()) == 0.1
    assert value(integrator.getMaximumStepSize()) == 0.0


def test_what_the_user_has_set_to_nan_is_said() -> None:
    run = Run({})
    run.integrator.step(5)
    broken = positions_of(run.context)
    broken[2, 0] = math.nan
    run.context.setPositions(broken)
    with pytest.raises(openmm.OpenMMException, match="the position of particle 2 is not a finite number"):
        run.integrator.step(5)
    assert run.context.getStepCount() == 5
    assert np.isnan(positions_of(run.context)[2, 0])
    run.context.setPositions(chain().positions)
    run.integrator.step(5)
    assert run.context.getStepCount() == 10


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("keeps", [True, False])
def test_a_system_that_reinitialize_brings_is_looked_at(settings: str, keeps: bool) -> None:
    """Masses that are negative, and lengths of constraints that are others."""
    run = Run(SETTINGS[settings])
    run.integrator.step(20)
    system = run.context.getSystem()
    system.setParticleMass(4, -1.008)
    run.context.reinitialize(preserveState=keeps)
    if not keeps:
        run.context.setPositions(chain().positions)
    before = positions_of(run.context)
    with pytest.raises(openmm.OpenMMException, match=r"the mass of particle 4 is -1.008 amu"):
        run.integrator.step(5)
    np.testing.assert_array_equal(positions_of(run.context), before)
    system.setParticleMass(4, 12.0)
    for k in range(system.getNumConstraints()):
        i, j, length = system.getConstraintParameters(k)
        system.setConstraintParameters(k, i, j, 1.002 * length)
    run.context.reinitialize(preserveState=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConstraintWarning)
        run.integrator.step(30)  # which looks after ten of them
    assert constraint_error(system, positions_of(run.context)) < 1e-3


def test_an_overlap_is_named() -> None:
    """Two particles so close that the first step leads to what is no number, and two at the same place."""
    system = openmm.System()
    force = openmm.CustomNonbondedForce("r^(-40)")
    for _ in range(5):
        system.addParticle(10.0)
        force.addParticle()
    system.addForce(force)
    positions = np.arange(15.0).reshape(5, 3)
    cases = {1e-5: "the largest force there, .* is on particle 1", 0.0: "the force on particle 1 is infinite"}
    for distance, words in cases.items():
        positions[3] = positions[1] + [distance, 0, 0]
        integrator = Custom(0.001)
        context = openmm.Context(system, integrator, openmm.Platform.getPlatform("Reference"))
        context.setPositions(positions)
        with pytest.raises(openmm.OpenMMException, match=words):
            integrator.step(1)
        np.testing.assert_array_equal(positions_of(context), positions)


@pytest.mark.parametrize("platform", ["Reference", "CPU"])  # CPU raises an exception of its own
def test_redundant_constraints_are_named(platform: str) -> None:
    """A rigid tetrahedron around its centre has one distance too many: no smaller step will help."""
    corners = 0.063 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    positions = np.vstack([[5.0, 0.0, 0.0], np.zeros(3), corners])
    system = openmm.System()
    for mass in (39.9, 14.0, 1.0, 1.0, 1.0, 1.0):
        system.addParticle(mass)
    for i in range(1, 6):
        for j in range(i + 1, 6):
            system.addConstraint(i, j, np.linalg.norm(positions[i] - positions[j]))
    integrator = Custom(0.001)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatform(platform))
    context.setPositions(positions)
    context.setVelocities(np.random.default_rng(1).normal(size=(6, 3)))
    words = "the constraints among the particles 1, 2, 3, 4 and 5 are redundant"
    with pytest.raises(openmm.OpenMMException, match=words) as failure:
        integrator.step(1000)
    assert "smaller" not in str(failure.value)
