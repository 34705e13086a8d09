# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The advice on variable steps: its numbers against plain statements of them, its verdict against measured gains."""

from __future__ import annotations

import csv
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import openmm
import openmmvrattle
import pytest
from openmm import unit
from openmmvrattle import VariableStepRattleIntegrator
from openmmvrattle.compare.advice import (
    BOUNDS,
    MONITORS,
    AdviceError,
    Trial,
    advise,
    advise_on,
    measured_gain,
    predictor,
)
from openmmvrattle.compare.measurement import methods_of, run_method
from openmmvrattle.testsystems import SYSTEMS, MonitorSettings, light_heavy_chain, rigid_waters, water_clash


def advice_on(name, evaluations=None, **options):
    """The advice on one of our systems, for its own time with a number of steps."""
    start = SYSTEMS[name]()
    steps = evaluations or start.settings.force_evaluations
    return advise_on(start, start.settings.total_time / steps, steps, **options), start


# System, evaluations, verdict, and the bounds of the measured gain of the best candidate. A gain below 1.25
# is no difference, as in the verdict of a comparison.
VERDICTS = [
    ("double-pendulum", 40_000, "variable steps", 100, math.inf),
    ("double-pendulum-heavy-inside", 20_000, "little to gain", 1.2, 2),
    ("light-heavy-chain", None, "variable steps", 100, math.inf),
    ("light-heavy-chain-repulsion", None, "variable steps", 10, math.inf),
    ("water-clash", None, "variable steps", 10, math.inf),
    ("nitrogen-collision-5", None, "variable steps", 1.5, 10),
    ("nitrogen-collision-20", None, "variable steps", 1.5, 10),
    ("diatomic-on-wall", None, "variable steps", 1.5, 10),
    ("diatomic-on-wall-10", None, "variable steps", 1.5, 10),
    ("elastic-rod", None, "variable steps", 3, 10),
    ("long-light-heavy-chain", 4000, "variable steps", 3, 30),
    ("ion-pair", None, "little to gain", 0.8, 3),
    ("independent-whips", None, "little to gain", 0.8, 3),
    ("colliding-water-clusters", None, "fixed steps", 0.0, 1.25),
    ("alanine-dipeptide-hbonds", None, "fixed steps", 0.0, 1.25),
    ("alanine-dipeptide-allbonds", None, "fixed steps", 0.0, 1.25),
    ("alanine-dipeptide-hbonds-1000-kelvin", None, "fixed steps", 0.0, 1.25),
    ("rigid-waters", None, "fixed steps", 0.0, 1.25),
    ("rigid-waters-32", 1000, "fixed steps", 0.0, 1.25),
]


# Of each verdict one here, and all with the claims.
QUICK_VERDICTS = ("light-heavy-chain", "ion-pair", "rigid-waters")


@pytest.mark.parametrize(
    ("name", "evaluations", "verdict", "lowest", "highest"),
    [
        pytest.param(*case, marks=[] if case[0] in QUICK_VERDICTS else [pytest.mark.claims], id=case[0])
        for case in VERDICTS
    ],
)
def test_the_verdict_is_what_is_measured(name, evaluations, verdict, lowest, highest):
    """At an equal number of force evaluations: where it says variable steps, they win, and nowhere else."""
    advice, start = advice_on(name, evaluations)
    gain, failure = measured_gain(advice, start)
    assert failure is None
    assert advice.verdict == verdict, (advice.best, gain)
    assert lowest <= gain <= highest
    if verdict == "variable steps":
        # The size is expected to a factor of 4, except where the trial could not resolve the motion.
        assert not advice.resolved or 0.25 < gain / advice.best.expected_gain < 4


@pytest.mark.parametrize("name", ["alanine-dipeptide-hbonds", "rigid-waters"])
def test_automatic_step_control_does_nothing_where_nothing_pays(name):
    """Its steps are those of fixed steps to 1 %, but for those of its calibration."""
    start = SYSTEMS[name]()
    (method,) = methods_of(start.settings, ("Automatic",))
    run = run_method(method, start, "Reference", start.settings)
    assert run.failure is None
    assert run.force_evaluations == pytest.approx(start.settings.force_evaluations, rel=0.02)
    assert run.largest_step / run.smallest_step < 1.01


def test_automatic_step_control_pays_where_something_does():
    advice, start = advice_on("light-heavy-chain")
    gain, failure = measured_gain(advice, start, automatic=True)
    assert failure is None
    assert gain > 100


def test_the_trial_is_the_run_with_fixed_steps():
    """The monitors do not change the steps: the energies are those of the integrator without a monitor."""
    start = rigid_waters(4)
    advice = advise_on(start, 0.001, 200)
    integrator = VariableStepRattleIntegrator(0.001)
    integrator.clearMonitors()
    context = openmm.Context(start.system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(start.positions)
    context.setVelocities(start.velocities)
    energies = []
    for step in range(201):
        if step:
            integrator.step(1)
        state = context.getState(energy=True)
        energies.append((state.getKineticEnergy() + state.getPotentialEnergy())._value)
    np.testing.assert_allclose(advice.trial.energy_errors, np.array(energies) - energies[0], rtol=0, atol=1e-8)
    assert advice.trial.times[-1] == pytest.approx(0.2)


def test_the_monitors_of_the_trial_are_those_of_single_integrators():
    """Each monitor alone, in an integrator of its own, at the states of the trial."""
    start = rigid_waters(4)
    trial = advise_on(start, 0.001, 20).trial
    assert set(trial.monitor_values) == {monitor.kind for monitor in MONITORS} >= {"ConstraintAndAppliedForce"}
    for kind, values in trial.monitor_values.items():
        for steps in (0, 20):
            integrator = VariableStepRattleIntegrator(0.001)
            integrator.clearMonitors()
            context = openmm.Context(start.system, integrator, openmm.Platform.getPlatformByName("Reference"))
            context.setPositions(start.positions)
            context.setVelocities(start.velocities)
            integrator.step(steps)
            state = context.getState(positions=True, velocities=True)
            alone = VariableStepRattleIntegrator(0.001)
            alone.clearMonitors()
            alone.addMonitor(getattr(VariableStepRattleIntegrator, kind))
            other = openmm.Context(start.system, alone, openmm.Platform.getPlatformByName("Reference"))
            other.setPositions(state.getPositions())
            other.setVelocities(state.getVelocities())
            assert values[steps] == pytest.approx(alone.getMonitorValue(0), rel=1e-6), kind


def test_the_predictor_is_its_formula():
    """Written out with sums and loops, on numbers made up."""
    rng = np.random.default_rng(3)
    errors = rng.normal(size=50)
    u = rng.uniform(0.1, 30.0, size=50)
    smallest, largest = 0.02, 2.0
    calmest = sorted(range(50), key=lambda i: u[i])[:5]
    e0 = sum(errors[i] for i in calmest) / 5
    a, b = 1 / largest, 1 / smallest
    k = (1 - a) / (b - 1)
    mean = sum(u) / 50
    rho = [(a + b * k * x / mean) / (1 + k * x / mean) for x in u]
    mean_rho = sum(rho) / 50
    expected = max(abs(e - e0) for e in errors) / max(
        abs(e - e0) * (mean_rho / r) ** 2 for e, r in zip(errors, rho, strict=True)
    )
    assert predictor(errors, u, smallest, largest) == pytest.approx(expected, rel=1e-12)


def test_the_predictor_in_cases_that_are_known():
    errors = np.array([0.0] * 90 + [1.0] * 10)
    u = np.array([1.0] * 90 + [10.0] * 10)
    # Steps a tenth of the others where the error is: they shrink it by (10 / mean)^2, the mean density being 1.9 / 1.9.
    assert predictor(errors, u, 0.0, 0.0) == pytest.approx((10.0 / 1.9) ** 2)
    assert predictor(errors, np.ones(100), 0.02, 2.0) == pytest.approx(1.0)  # a monitor that sees nothing
    # One that is wrong: steps 8.2 times too large where the error is largest, in the calm.
    errors = np.array([1.0, -1.0] * 10 + [0.5] * 80)
    u = np.array([1.0] * 20 + [10.0] * 80)
    assert predictor(errors, u, 0.0, 0.0) == pytest.approx(1 / 8.2**2)
    assert math.isnan(predictor(errors, np.zeros(100), 0.02, 2.0))
    assert math.isnan(predictor(np.zeros(100), u, 0.02, 2.0))


def test_the_leading_term_is_the_error_of_fixed_steps():
    """Against the measured error where it is all that matters: on the whip it agrees to a few per cent."""
    trial = advice_on("light-heavy-chain")[0].trial
    leading = trial.leading_errors()
    largest = np.max(np.abs(leading - leading[0]))
    assert largest == pytest.approx(trial.largest_energy_error, rel=0.05)
    assert np.corrcoef(leading, trial.energy_errors)[0, 1] > 0.99


def test_steps_that_are_too_large_are_noticed():
    """On the pendulum the energy does not come back after a whip that the steps cannot follow."""
    advice, _ = advice_on("double-pendulum", 40_000)
    assert not advice.resolved
    assert "does not come back" in str(advice)
    assert advice_on("light-heavy-chain")[0].resolved


def test_the_recommended_integrator_is_what_was_judged():
    advice, start = advice_on("water-clash")
    best = advice.best
    integrator = advice.make_integrator()
    nominal = best.control.nominal_step_size
    assert integrator.getNominalStepSize().value_in_unit(unit.picosecond) == nominal
    assert integrator.getMinimumStepSize().value_in_unit(unit.picosecond) == pytest.approx(nominal * best.bounds[0])
    assert integrator.getMaximumStepSize().value_in_unit(unit.picosecond) == pytest.approx(nominal * best.bounds[1])
    assert integrator.getNumMonitors() == 1
    # The lines of Python make the same integrator.
    namespace = {"VariableStepRattleIntegrator": VariableStepRattleIntegrator}
    exec(advice.code(), namespace)
    written = namespace["integrator"]
    assert list(written.getMonitor(0)) == list(integrator.getMonitor(0))
    assert written.getUpdateMethod() == integrator.getUpdateMethod()
    for name in ("getNominalStepSize", "getMinimumStepSize", "getMaximumStepSize"):
        assert getattr(written, name)() / getattr(integrator, name)() == pytest.approx(1.0, rel=1e-5)
    assert written.getReferenceMonitorValue() == pytest.approx(integrator.getReferenceMonitorValue(), rel=1e-5)
    # It takes about as many steps as the trial, without being adjusted.
    context = openmm.Context(start.system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(start.positions)
    context.setVelocities(start.velocities)
    integrator.stepTo(0.2)
    assert integrator.getNumForceEvaluations() == pytest.approx(800, rel=0.2)


def test_fixed_steps_are_recommended_as_an_integrator_too():
    advice, _ = advice_on("rigid-waters", 500)
    assert advice.verdict == "fixed steps"
    integrator = advice.make_integrator()
    assert integrator.getNumMonitors() == 0
    assert integrator.getStepSize().value_in_unit(unit.picosecond) == pytest.approx(2.0 / 500)
    assert "Use fixed steps" in str(advice)
    assert "clearMonitors" in advice.code()


def test_from_python_with_units_and_random_velocities():
    """As a user calls it, with a System, positions and nothing else."""
    start = rigid_waters(2)
    positions = start.positions * unit.nanometer
    forces = start.system.getNumForces()
    start.system.addForce(openmm.AndersenThermostat(300.0, 1.0))
    advice = openmmvrattle.advise(start.system, positions, step_size=1 * unit.femtosecond, steps=100, seed=4)
    assert start.system.getNumForces() == forces + 1  # the System itself is left as it is
    assert any("AndersenThermostat is left out" in note for note in advice.notes)
    assert advice.trial.step_size == pytest.approx(0.001)
    again = advise(start.system, positions, step_size=0.001, steps=100, seed=4)
    other = advise(start.system, positions, step_size=0.001, steps=100, seed=5)
    assert np.array_equal(again.trial.energy_errors, advice.trial.energy_errors)
    assert not np.array_equal(again.trial.energy_errors, other.trial.energy_errors)
    assert repr(advice).startswith("Advice(verdict=")
    assert len(repr(advice)) < 1000


def test_nothing_to_see():
    """Particles that move freely: no monitor sees anything, and the energy has no error."""
    system = openmm.System()
    for _ in range(2):
        system.addParticle(1.0)
    advice = advise(system, [[0, 0, 0], [1, 0, 0]], [[0, 1, 0], [0, 0, 1]], steps=20)
    assert advice.verdict == "fixed steps"
    assert "fixed steps" in str(advice)


def test_a_trial_that_fails_is_repeated_with_smaller_steps():
    chain = light_heavy_chain()
    # A collision at 2 ps, which steps of 0.0125 ps do not survive; the next is at 11 ps, when all depends on rounding.
    advice = advise_on(chain, 0.1, 50)
    assert advice.trial.step_size in (0.05, 0.025, 0.0125, 0.00625)
    assert advice.trial.times[-1] == pytest.approx(5.0)
    assert advice.notes[0].startswith("Fixed steps of 0.1 ps fail here")


def test_a_trial_that_always_fails():
    clash = water_clash()
    wild = replace(clash, velocities=clash.velocities + 1e6)
    with pytest.raises(AdviceError, match="fixed steps fail down to"):
        advise_on(replace(wild, positions=clash.positions), 10.0, 20)


def test_only_what_is_asked_for_is_judged():
    chosen = [MonitorSettings("ForcePNorm", power=0.5)]
    advice, _ = advice_on("nitrogen-collision-5", monitors=chosen, bounds=[(0.0, 0.0), (0.05, 1.25)])
    assert {(c.monitor, c.bounds) for c in advice.candidates} == {
        ("ForcePNorm^0.5", (0.0, 0.0)),
        ("ForcePNorm^0.5", (0.05, 1.25)),
    }
    assert len(BOUNDS) == 5


@pytest.mark.parametrize(("options", "words"), [({"steps": 5}, "10 steps"), ({"step_size": -1.0}, "positive")])
def test_wrong_numbers(options, words):
    start = rigid_waters(1)
    with pytest.raises(ValueError, match=words):
        advise(start.system, start.positions, **options)


def test_the_measured_gain_is_that_of_a_comparison():
    advice, start = advice_on("water-clash")
    settings = replace(start.settings, controls=(advice.best.control,))
    runs = [run_method(method, start, "Reference", settings) for method in methods_of(settings, ("RATTLE", "VRATTLE"))]
    gain, _ = measured_gain(advice, start)
    assert gain == pytest.approx(runs[0].largest_energy_error / runs[1].largest_energy_error)


def test_progress_of_the_trial():
    fractions: list[float] = []
    advise_on(rigid_waters(1), 0.001, 200, progress=fractions.append)
    assert fractions == sorted(fractions) and fractions[0] == 0.0 and fractions[-1] <= 1.0 and len(fractions) > 2
    assert isinstance(advise_on(rigid_waters(1), 0.001, 20).trial, Trial)


SCRIPT = Path(__file__).parents[2] / "benchmarks" / "advise.py"


@pytest.mark.skipif(not SCRIPT.exists(), reason="needs the folder benchmarks")
def test_the_benchmark_of_the_advice(tmp_path):
    """It measures what it says: each candidate once, at the number of steps that is recommended for the system."""
    command = [sys.executable, str(SCRIPT), "--systems", "nitrogen-collision-5", "--output", str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert result.returncode == 0, result.stderr
    assert "3 of 3 verdicts are right." in result.stdout
    with (tmp_path / "advise.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [sum(row["steps"] == steps for row in rows) for steps in ("200", "400", "800")] == [1, 55, 1]
    best = next(row for row in rows if row["steps"] == "400" and row["is_best"] == "True")
    advice, start = advice_on("nitrogen-collision-5")
    assert float(best["gain"]) == pytest.approx(measured_gain(advice, start)[0], rel=1e-6)
    assert (tmp_path / "advise.png").read_bytes().startswith(b"\x89PNG")
