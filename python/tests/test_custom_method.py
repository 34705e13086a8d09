# OpenMM-VRATTLE: the method as a CustomIntegrator: its equations, order, reversibility, and agreement with the plugin.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import numpy as np
import openmm
import pytest
from custom_support import largest, light_molecules, open_on, platform_parameters, variable
from dense_reference import (
    BOUNDED,
    SEMI_EXPLICIT,
    Control,
    Model,
    chain,
    double_pendulum,
    energy_of,
    open_context,
    positions_of,
    ring,
    runge_kutta,
    time_of,
    value,
    velocities_of,
    waters,
)
from openmmvrattle import CustomVariableStepRattleIntegrator as Custom
from openmmvrattle import VariableStepRattleIntegrator
from openmmvrattle.testsystems import rigid_waters

MODELS = {"waters": waters, "chain": chain, "ring": ring, "pendulum": double_pendulum, "methyls": light_molecules}


@pytest.mark.parametrize("update", [SEMI_EXPLICIT, BOUNDED])
@pytest.mark.parametrize("name", ["chain", "ring", "pendulum"])
def test_every_step_satisfies_the_equations(name: str, update: str) -> None:
    """From positions and velocities alone: both constraint forces are constraint forces, and the recursion holds."""
    model = MODELS[name]()
    c, potential = model.constraints(), model.potential()
    integrator = Custom(model.step / 2, getattr(Custom, update), constraintTolerance=1e-12)
    context = open_context(model.system(), integrator, "Reference", model)
    integrator.step(1)
    reference = integrator.getReferenceMonitorValue()
    control = Control(model.step / 2, update=update)

    def u(acceleration: np.ndarray) -> float:
        return control.mobius(np.linalg.norm(np.sqrt(c.m3) * acceleration) / reference)[0]

    states, densities, sizes, last = [], [], [], np.zeros(0)
    for n in range(60):
        x, v = positions_of(context).ravel(), velocities_of(context).ravel()
        states.append((x, v, -c.w3 * potential(x)[1]))
        densities.append(integrator.getStepDensity())
        sizes.append(value(integrator.getStepSize()))
        if n:
            (x0, v0, a0), (x1, v1, a1), dt = states[-2], states[-1], sizes[-1]
            assert dt == pytest.approx(model.step / 2 / densities[-1], rel=1e-14)
            # The constraint forces of the two half kicks of this step, from the definition of a RATTLE step.
            after = 2 / dt**2 * (x1 - x0 - dt * v0) - a0
            before = 2 / dt * (v1 - (x1 - x0) / dt) - a1
            for x, acceleration in ((x0, after), (x1, before)):
                assert c.outside_range(x, c.m3 * acceleration) < 1e-6 * reference
            assert largest(c.relative_errors(x1)) < 1e-11
            assert largest(c.jacobian(x1) @ v1) < 1e-9
            if n > 1:
                residual = control.density_residual(densities[-1], densities[-2], u(after), u(last), 0.0)
                if update == BOUNDED:
                    f = control.f
                    residual = f(densities[-1]) + f(densities[-2]) - f(u(after)) - f(u(last))
                assert abs(residual) < 1e-6
            last = before
        integrator.step(1)
    assert max(densities) / min(densities) > 1.02


# Waters not on CPU: its nonbonded forces are of single precision, and differ where positions differ by rounding.
# On OpenCL the waters and the methyls only: OpenMM's constraint solver there is not exact enough for the others, see
# the test of the limits; and in single precision the waters, whose constraint forces are large. Bounded is the same
# program there as SemiExplicit but for one formula, and compiling takes seconds.
THERE_AND_BACK = [
    (name, platform, "double", 1e-12, 1e-9, update)
    for name in ("waters", "pendulum", "chain", "ring", "methyls")
    for platform in ("Reference", "CPU")
    for update in ("SemiExplicit", "Bounded")
    if (name, platform) != ("waters", "CPU")
] + [
    (name, "OpenCL", precision, tolerance, bound, update)
    for precision, tolerance, bound in (("double", 1e-12, 1e-8), ("mixed", 1e-8, 1e-6), ("single", 1e-5, 1e-3))
    for name, update in (("waters", "SemiExplicit"), ("waters", "Bounded"), ("methyls", "SemiExplicit"))
    if (precision, name) != ("single", "methyls")
]


@pytest.mark.parametrize("name, platform, precision, tolerance, bound, update", THERE_AND_BACK)
def test_there_and_back(name: str, platform: str, precision: str, tolerance: float, bound: float, update: str) -> None:
    """Retrace 200 steps."""
    model = MODELS[name]()
    integrator = Custom(model.step / 2, getattr(Custom, update), constraintTolerance=tolerance)
    context = open_on(platform, precision, model.system(), integrator, model)
    integrator.step(200)
    turning, velocities, time = positions_of(context), velocities_of(context), time_of(context)
    integrator.reverse()
    assert np.array_equal(positions_of(context), turning)
    assert np.array_equal(velocities_of(context), -velocities)
    assert time_of(context) == time
    integrator.step(200)
    back = largest(positions_of(context) - model.positions)
    print(f"{name} on {platform} ({precision}): back to {back:.1e} nm of the start")
    assert largest(turning - model.positions) > 0.02
    assert back < (1e-12 if name == "waters" and platform == "Reference" else bound)
    assert time_of(context) == pytest.approx(2 * time, rel=1e-2)
    assert integrator.getNumRescues() == 0


@pytest.mark.parametrize(
    "kind, update", [("AppliedForce", "Explicit"), ("ForcePNorm", "Bounded"), ("VectorField", "SemiExplicit")]
)
def test_there_and_back_with_other_monitors(kind: str, update: str, platform: str) -> None:
    model = chain()
    monitor = (getattr(Custom, kind), 1.0, 0.5 if kind == "ForcePNorm" else 1.0)
    integrator = Custom(0.0005, getattr(Custom, update), monitors=[monitor], constraintTolerance=1e-12)
    context = open_context(model.system(), integrator, platform, model)
    integrator.step(300)
    integrator.reverse()
    integrator.reverse()
    integrator.reverse()
    integrator.step(300)
    assert largest(positions_of(context) - model.positions) < 1e-10
    assert largest(velocities_of(context) + model.velocities) < 1e-8


def test_velocities_turned_by_the_user_start_afresh() -> None:
    """The density is then u at the turning point and not the next of the sequence: it does not come back exactly."""
    model, distances = chain(), []
    for turn in (Custom.reverse, None):
        integrator = Custom(model.step, constraintTolerance=1e-12)
        context = open_context(model.system(), integrator, "Reference", model)
        integrator.step(100)
        if turn is None:
            context.setVelocities(-velocities_of(context))
        else:
            turn(integrator)
        integrator.step(100)
        distances.append(largest(positions_of(context) - model.positions))
    assert 100 * distances[0] < distances[1] < 1e-2


@pytest.mark.parametrize("update", ["SemiExplicit", "Bounded"])
def test_second_order(update: str) -> None:
    """Against the continuous flow, with steps that differ by a factor of 2 and more."""
    model, time = chain(), 0.06
    c = model.constraints()
    momenta = (model.masses[:, None] * model.velocities).ravel()
    exact, exact_momenta = runge_kutta(c, model.potential(), model.positions.ravel(), momenta, time, 1000)
    exact_velocities = (c.w3 * exact_momenta).reshape(-1, 3)
    steps = model.step / np.array([1, 2, 4, 8])
    errors = []
    for step in steps:
        monitors = [(Custom.ConstraintForce, 1.0, 2.0)]
        integrator = Custom(step, getattr(Custom, update), 0, 3 * step, 1e-12, monitors, referenceMonitorValue=900.0)
        context = open_context(model.system(), integrator, "Reference", model)
        sizes = []
        while time_of(context) < 0.95 * time:
            integrator.step(1)
            sizes.append(value(integrator.getStepSize()))
        integrator.stepTo(time)
        assert time_of(context) == time
        assert max(sizes) / min(sizes) > 2
        assert integrator.getNumRescues() == 0
        velocity_error = largest(velocities_of(context) - exact_velocities)
        errors.append([largest(positions_of(context) - exact.reshape(-1, 3)), velocity_error])
    for column in np.array(errors).T:
        slope = np.polyfit(np.log(steps), np.log(column), 1)[0]
        print(update, "slope", slope, "errors", column)
        assert 1.9 < slope < 2.1


def run_both(model: Model, step: float, time: float, update: str, kind: str) -> tuple[float, float]:
    """The largest difference of densities along a run, relative, and of positions at its end, between the plugin and
    us."""
    histories, ends = [], []
    for cls in (VariableStepRattleIntegrator, Custom):
        integrator = cls(step, getattr(cls, update), constraintTolerance=1e-12, monitors=[getattr(cls, kind)])
        # The same function of the state for every step size.
        integrator.setMinimumStepSize(step / 50)
        integrator.setMaximumStepSize(2 * step)
        integrator.setReferenceMonitorValue({"chain": 900.0, "ring": 270.0, "methyls": 1500.0}[model.name])
        context = open_context(model.system(), integrator, "Reference", model)
        history = []
        while time_of(context) < time:
            integrator.step(1)
            # A step belongs to the time of its middle.
            history.append((time_of(context) - value(integrator.getStepSize()) / 2, integrator.getStepDensity()))
        histories.append(np.array(history))
        integrator.stepTo(1.1 * time)
        ends.append(positions_of(context))
    (times, densities), (other_times, other_densities) = (history.T for history in histories)
    interpolated = np.interp(times, other_times, other_densities)
    return largest((interpolated / densities - 1)[1:-1]), largest(ends[0] - ends[1])


@pytest.mark.parametrize("update", ["SemiExplicit", "Bounded"])
@pytest.mark.parametrize("name, time", [("chain", 0.05), ("ring", 0.05), ("methyls", 0.05)])
def test_agrees_with_the_plugin_to_second_order(name: str, time: float, update: str) -> None:
    """Under the same monitor and update; the constant of the error is printed."""
    model = MODELS[name]()
    steps = model.step / 2 / np.array([1, 2, 4])
    differences = np.array([run_both(model, step, time, update, "ConstraintForce") for step in steps])
    for what, column in zip(("densities, relative,", "positions in nm"), differences.T, strict=True):
        slope = np.polyfit(np.log(steps), np.log(column), 1)[0]
        constant = column[-1] / (steps[-1] / model.step) ** 2
        print(f"{name}, {update}: {what} differ by {constant:.2g} (h/{model.step} ps)^2, slope {slope:.2f}")
        assert slope > 1.8
        assert constant < 1


def take_first_step(integrator: Custom, context: openmm.Context, density: float) -> None:
    """The first step with a given density, not with the one that it would take itself."""
    integrator._set("prescribed", density)
    openmm.CustomIntegrator.step(integrator, 1)
    context.setTime(variable(integrator, "clock"))


@pytest.mark.parametrize("update", ["SemiExplicit", "Explicit", "Bounded"])
@pytest.mark.parametrize(
    "kinds", [["AppliedForce"], ["ForcePNorm"], ["VectorField"], ["ArcLength"], ["VectorField", "ForcePNorm"]]
)
def test_the_same_as_the_plugin_without_constraint_forces(kinds: list[str], update: str) -> None:
    """These monitors are the same functions of the state, so from the same first density on the runs are the same."""
    model = chain()
    runs = []
    for cls in (VariableStepRattleIntegrator, Custom):
        monitors = [(getattr(cls, kind), 1.0 + k, 0.5 + k / 4) for k, kind in enumerate(kinds)]
        integrator = cls(0.0005, getattr(cls, update), constraintTolerance=1e-12, monitors=monitors, normOrder=6)
        for k in range(len(kinds)):
            integrator.setReferenceMonitorValue(1000.0 + k, k)
        context = open_context(model.system(), integrator, "Reference", model)
        run = []
        for n in range(100):
            if cls is Custom and n == 0:
                take_first_step(integrator, context, runs[0][0][0])
            else:
                integrator.step(1)
            run.append([integrator.getStepDensity(), time_of(context), *positions_of(context).ravel()])
        values = [integrator.getMonitorValue(k) for k in range(len(kinds))]
        runs.append((*np.array(run).T[:2], np.array(run)[:, 2:], values))
    plugin, custom = runs
    np.testing.assert_allclose(custom[0], plugin[0], rtol=1e-9)
    np.testing.assert_allclose(custom[1], plugin[1], rtol=1e-9)
    np.testing.assert_allclose(custom[2], plugin[2], rtol=0, atol=1e-10)
    # With SemiExplicit ours is that of the half step before.
    np.testing.assert_allclose(custom[3], plugin[3], rtol=5e-3 if update == "SemiExplicit" else 1e-9)
    assert np.ptp(custom[0]) > 0.05


@pytest.mark.parametrize("kind", ["ConstraintForce", "ConstraintAndAppliedForce", "AppliedForce"])
def test_energy_as_good_as_that_of_the_plugin(kind: str, platform: str) -> None:
    """On rigid waters, at the same number of force evaluations over the same time, within 2 %."""
    test = rigid_waters()
    errors, times = [], []
    for cls in (VariableStepRattleIntegrator, Custom):
        integrator = cls(0.001, cls.SemiExplicit, monitors=[getattr(cls, kind)])
        context = open_context(test.system, integrator, platform, test)
        start, energies = energy_of(context), []
        for _ in range(600):
            integrator.step(1)
            energies.append(energy_of(context) - start)
        assert integrator.getNumForceEvaluations() == 601
        errors.append((largest(np.array(energies)), np.sqrt(np.mean(np.square(energies)))))
        times.append(time_of(context))
    print(kind, platform, "largest and rms energy errors of plugin and custom integrator", errors)
    assert times[1] == pytest.approx(times[0], rel=0.02)
    np.testing.assert_allclose(errors[1], errors[0], rtol=0.1)


@pytest.mark.parametrize("platform, precision, bound", platform_parameters(double=0.1, mixed=0.1, single=0.4))
def test_energy_on_every_platform(platform: str, precision: str, bound: float) -> None:
    """The largest energy error of 8 waters differs from that of Reference by no more than a fraction."""
    test = rigid_waters()

    def error(name: str, digits: str) -> tuple[float, float, float]:
        integrator = Custom(0.001, monitors=[Custom.ConstraintAndAppliedForce])
        context = open_on(name, digits, test.system, integrator, test)
        energies = []
        for _ in range(150):
            integrator.step(1)
            energies.append(energy_of(context))
        assert integrator.getNumRescues() == 0
        assert integrator.getNumSolverIterations() < 6 * 150
        return float(np.ptp(energies)), time_of(context), value(integrator.getStepSize())

    expected, measured = error("Reference", "double"), error(platform, precision)
    print(platform, precision, measured, "Reference", expected)
    assert measured[0] == pytest.approx(expected[0], rel=bound)
    # CPU computes nonbonded forces in single precision, whatever else is double. A relative change of 1e-5 in the
    # forces changes u as much, and ten times as much after 0.15 ps, in which nearby trajectories of water separate.
    accuracy = 1e-3 if platform == "CPU" else {"single": 1e-3, "mixed": 1e-5, "double": 1e-6}[precision]
    assert measured[1:] == pytest.approx(expected[1:], rel=accuracy)


def oscillation(densities: np.ndarray) -> float:
    """Fourth differences single out what changes sign from step to step."""
    return float(np.mean(np.abs(np.diff(densities, 4)))) / 16


@pytest.mark.parametrize("reference", [0.0, 800.0])
def test_the_density_starts_without_oscillation(reference: float) -> None:
    """Against a start with the density u at the start, and against that of the plugin."""
    model = chain()

    def run(integrator: Custom | VariableStepRattleIntegrator, first: float = 0.0) -> np.ndarray:
        context = open_context(model.system(), integrator, "Reference", model)
        densities = []
        for n in range(60):
            if first and n == 0:
                take_first_step(integrator, context, first)
            else:
                integrator.step(1)
            densities.append(integrator.getStepDensity())
        assert context.getStepCount() == 60
        return np.array(densities)

    settings = {"constraintTolerance": 1e-12, "referenceMonitorValue": reference}
    good = Custom(0.00025, **settings)
    densities = run(good)
    assert densities[0] == 1 if reference == 0 else densities[0] != 1
    assert good.getNumForceEvaluations() == (61 if reference == 0 else 63)
    # U at the start, from the two half steps around it, as the step becomes small.
    plain = Custom(1e-6, constraintTolerance=1e-13)
    run(plain)
    bad = Custom(0.00025, constraintTolerance=1e-12, referenceMonitorValue=good.getReferenceMonitorValue())
    x = plain.getReferenceMonitorValue() / good.getReferenceMonitorValue()
    worse = run(bad, first=Control(0.00025).mobius(x)[0])
    plugin = run(
        VariableStepRattleIntegrator(0.00025, monitors=[VariableStepRattleIntegrator.ConstraintForce], **settings)
    )
    print("oscillation", oscillation(densities), "plugin", oscillation(plugin), "from u", oscillation(worse))
    assert oscillation(densities) < 0.1 * oscillation(worse)
    assert oscillation(densities) < 10 * oscillation(plugin)


def test_the_program_of_fixed_steps_is_velocity_verlet() -> None:
    model = chain()
    integrator = Custom(0.0005, monitors=[], constraintTolerance=1e-12)
    rattle = VariableStepRattleIntegrator(0.0005, monitors=[], constraintTolerance=1e-12)
    contexts = [open_context(model.system(), each, "Reference", model) for each in (integrator, rattle)]
    for each in (integrator, rattle):
        each.step(100)
    assert integrator.getStepDensity() == 1
    assert largest(positions_of(contexts[0]) - positions_of(contexts[1])) < 1e-11
    assert time_of(contexts[0]) == pytest.approx(0.05, rel=1e-12)


def test_a_step_that_the_recursion_refuses_is_rescued() -> None:
    """A monitor that falls to nothing within a step: the sum of densities would give a negative one."""
    system = openmm.System()
    system.addParticle(1.0)
    energy = openmm.CustomExternalForce("1 + 1000*step(0.1 - x)")
    energy.addParticle(0)
    energy.setForceGroup(3)
    system.addForce(energy)
    for update in ("SemiExplicit", "Bounded"):
        integrator = Custom(
            0.001, getattr(Custom, update), 0, 0, monitors=[Custom.ForceGroupEnergy], monitorForceGroup=3
        )
        integrator.setReferenceMonitorValue(1.0)
        context = openmm.Context(system, integrator, openmm.Platform.getPlatform("Reference"))
        context.setPositions([[0.0999, 0, 0]])
        context.setVelocities([[10.0, 0, 0]])
        integrator.step(500)
        densities = integrator.getStepDensity()
        assert positions_of(context)[0, 0] > 0.1
        assert densities > 0
        assert (integrator.getNumRescues() > 0) == (update == "SemiExplicit")
        assert variable(integrator, "clock") == time_of(context)
