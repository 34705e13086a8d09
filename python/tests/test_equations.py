# OpenMM-VRATTLE: every equation of the method, checked at every step of a run from what the public interface gives.
# SPDX-License-Identifier: MIT

from __future__ import annotations

from typing import Any

import numpy as np
import openmm
import pytest
from dense_reference import (
    EXPLICIT,
    KINDS,
    SEMI_EXPLICIT,
    UPDATES,
    Array,
    Control,
    DenseStepper,
    Model,
    chain,
    double_pendulum,
    general,
    monitor,
    open_context,
    pendulum_potential,
    ring,
    value,
    waters,
)
from recorded_run import check_equations, make_integrator, record

MODELS = {"pendulum": double_pendulum, "chain": chain, "ring": ring, "waters": waters, "general": general}
# The equations hold to rounding, which is amplified by 1/dt when p[n+1/2] is taken from differences of positions:
# 1e-16 nm / 1e-3 ps against velocities of 0.1 nm/ps is 1e-12, which constraint matrices amplify by up to 1e2.
EXACT = 1e-9


def exactness(platform: str, model: str) -> float:
    """CPU computes nonbonded forces in single precision; here they are the same numbers in both Contexts, except that
    tables and order of the sums may give 1e-6."""
    return 1e-5 if platform == "CPU" and model == "waters" else EXACT


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("name", MODELS)
def test_equations(name: str, update: str, platform: str) -> None:
    # 1e-12 is allowed by rounding: |q| < 2 nm in units of 1e-16 against distances of 0.1 nm gives 4e-15.
    model = MODELS[name]()
    control = Control(model.step, update=update)
    run = record(model, model.system(), control, platform, 1e-12)
    check_equations(run, model.constraints(), control, 1e-12, exactness(platform, name))
    # Something has been tested only if the steps vary.
    assert np.max(run.dt) > 1.02 * np.min(run.dt)


@pytest.mark.parametrize("update", UPDATES)
def test_equations_default_tolerance(update: str, platform: str) -> None:
    # The tolerance enters only g = 0. The momentum equations hold for whatever multipliers the solver stopped at, and
    # the recursion may be solved to the tolerance too.
    model = chain()
    control = Control(model.step, update=update)
    run = record(model, model.system(), control, platform, 1e-8)
    check_equations(run, model.constraints(), control, 1e-8, 1e-8)


@pytest.mark.parametrize("name", ["chain", "general"])
@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "ForceGroupEnergy"])
def test_monitors(kind: str, name: str, platform: str) -> None:
    model = MODELS[name]()
    control = Control(model.step, monitors=[(kind, 1.0, 1.0)])
    run = record(model, model.system(), control, platform, 1e-12, 200 if name == "chain" else 50)
    check_equations(run, model.constraints(), control, 1e-12, EXACT)
    assert np.max(run.dt) > 1.02 * np.min(run.dt)


@pytest.mark.parametrize("update", UPDATES)
def test_powers_weights_and_combination(update: str, platform: str) -> None:
    model = chain()
    monitors = [("ConstraintForce", 2.0, 0.5), ("ForcePNorm", 0.7, 1.5), ("VectorField", 1.0, 1.0)]
    control = Control(model.step, update=update, monitors=monitors, order=5.0)
    run = record(model, model.system(), control, platform, 1e-12)
    check_equations(run, model.constraints(), control, 1e-12, EXACT)
    assert np.max(run.dt) > 1.02 * np.min(run.dt)


def test_one_bound_and_none(platform: str) -> None:
    for minimum, maximum in ((0.0, 0.0), (0.0, 0.003), (0.0001, 0.0)):
        model = chain()
        control = Control(model.step, minimum, maximum, monitors=[("ConstraintForce", 1.0, 1.0)])
        run = record(model, model.system(), control, platform, 1e-12, 60)
        check_equations(run, model.constraints(), control, 1e-12, EXACT)


@pytest.mark.parametrize("update", UPDATES)
def test_force_group_energy(update: str, platform: str) -> None:
    """A monitor written as a force: positive, a function of q, and no part of the dynamics."""
    model = chain()
    system = model.system()
    force = openmm.CustomBondForce("(0.4/r)^3")
    force.addBond(0, 7, [])
    force.setForceGroup(31)
    system.addForce(force)
    control = Control(model.step, update=update, monitors=[("ForceGroupEnergy", 1.0, 1.0)])
    run = record(model, system, control, platform, 1e-12)
    check_equations(run, model.constraints(), control, 1e-12, EXACT)
    assert np.max(run.dt) > 1.02 * np.min(run.dt)


def test_plain_rattle(platform: str) -> None:
    model = chain()
    control = Control(model.step, monitors=[])
    run = record(model, model.system(), control, platform, 1e-12)
    check_equations(run, model.constraints(), control, 1e-12, EXACT)
    assert np.all(run.dt == model.step) and np.all(run.rho == 1)


@pytest.mark.parametrize("kind", ["ConstraintMultipliers", "ConstraintForce", "ConstraintAndAppliedForce"])
@pytest.mark.parametrize("update", UPDATES)
def test_start_of_the_density(update: str, kind: str) -> None:
    """U_ref is U0 + (U1 - U-1)/4, with the neighbours one plain step of the nominal size away."""
    model = chain()
    errors = []
    for step in (0.001, 0.0005):
        control = Control(step, update=update, monitors=[(kind, 1.0, 1.0)])
        stepper = DenseStepper(
            model.constraints(), model.potential(), control, model.positions.ravel(), start_momentum(model)
        )
        stepper.start()
        integrator = make_integrator(control, 1e-12)
        context = open_context(model.system(), integrator, "Reference", model)
        at_start = value(integrator.getMonitorValue(0))
        assert value(integrator.getReferenceMonitorValue(0)) == 0
        integrator.step(1)
        errors.append(abs(value(integrator.getReferenceMonitorValue(0)) / control.references[0] - 1))
        # The change itself is of first order in h and much larger than the difference.
        assert abs(control.references[0] / at_start - 1) > 3 * errors[-1]
        del context
    # What U1 and U-1 are taken at may differ in second order.
    assert errors[1] < max(0.4 * errors[0], 1e-9)


@pytest.mark.parametrize("factor", [0.5, 1.7])
@pytest.mark.parametrize("update", UPDATES)
def test_start_with_a_given_reference(update: str, factor: float) -> None:
    """The density starts at u + (u1 - u-1)/4 without the oscillation, up to second order in h."""
    model = chain()
    c, potential = model.constraints(), model.potential()
    q, p = model.positions.ravel(), start_momentum(model)
    at_start = monitor("ConstraintMultipliers", c, q, p, potential(q)[1])[0]
    differences = []
    for step in (0.001, 0.0005):
        control = Control(step, update=update, references=[factor * at_start])
        stepper = DenseStepper(c, potential, control, q, p)
        stepper.start()
        stepper.step()
        integrator = make_integrator(control, 1e-12)
        integrator.setReferenceMonitorValue(factor * at_start)
        context = open_context(model.system(), integrator, "Reference", model)
        integrator.step(1)
        assert integrator.getReferenceMonitorValue() == factor * at_start
        differences.append(abs(integrator.getStepDensity() / stepper.rho - 1))
        # The paper's first start, rho[-1/2] = u, is wrong in first order: by far more.
        here = control.u(c, q, p, potential(q)[1])[0]
        assert abs(here / stepper.rho - 1) > 5 * differences[-1]
        del context
    # A quarter for second order.
    assert differences[1] < 0.35 * differences[0]


def start_momentum(model: Model) -> Array:
    return model.constraints().m3 * model.velocities.ravel()


@pytest.mark.parametrize("name", ["pendulum", "chain", "ring", "general"])
@pytest.mark.parametrize("update", UPDATES)
def test_trajectory_of_the_dense_stepper(name: str, update: str) -> None:
    """The dense stepper, started from the state after the plugin's first step, takes the same steps."""
    model = MODELS[name]()
    control = Control(model.step, update=update)
    run = record(model, model.system(), control, "Reference", 1e-12, 100)
    c = model.constraints()
    potential = pendulum_potential(model) if name == "pendulum" else model.potential()
    stepper = DenseStepper(c, potential, control, run.q[1], run.p[1])
    stepper.rho = run.rho[0]
    stepper.p_half = c.m3 * (run.q[1] - run.q[0]) / run.dt[0]
    for n in range(2, 101):
        stepper.step()
        # Two solvers that stop at 1e-12 and 1e-13; errors grow as in any mechanical system, here 1e2 to 1e3 times.
        assert stepper.rho == pytest.approx(run.rho[n - 1], rel=1e-8)
        np.testing.assert_allclose(stepper.q, run.q[n], rtol=0, atol=1e-9)
        np.testing.assert_allclose(stepper.p, run.p[n], rtol=0, atol=1e-8 * np.max(np.abs(run.p)))


# The dense statement itself.


@pytest.mark.parametrize("name", ["chain", "general"])
def test_gradients_of_the_monitors(name: str) -> None:
    model = MODELS[name]()
    c = model.constraints()
    rng = np.random.default_rng(3)
    q = model.positions.ravel() + 0.005 * rng.normal(size=c.m3.size)
    p = start_momentum(model) + 0.3 * rng.normal(size=c.m3.size) * np.sqrt(c.m3)
    gradient = model.potential()(q)[1]

    def differences(function: Any) -> Array:
        result = np.zeros(p.size)
        for i in np.flatnonzero(c.m3):
            # Central differences of order four, with a step of a thousandth of p.
            step = 1e-3 * np.sqrt(c.m3[i]) * np.eye(p.size)[i]
            near, far = (function(p + k * step) - function(p - k * step) for k in (1, 2))
            result[i] = (8 * near - far) / (12 * step[i])
        return result

    for kind in KINDS:
        for order in (2.0, 5.0, 8.0):
            analytic = monitor(kind, c, q, p, gradient, order, 1.0)[1]
            numeric = differences(lambda x, k=kind, o=order: monitor(k, c, q, x, gradient, o, 1.0)[0])
            # step^4, and rounding of 1e-16 U/step.
            np.testing.assert_allclose(analytic, numeric, rtol=1e-6, atol=1e-6 * max(np.max(np.abs(numeric)), 1e-12))
    monitors = [("ConstraintForce", 2.0, 0.5), ("MultiplierPNorm", 0.7, 1.5), ("VectorField", 1.0, 1.0)]
    references = [monitor(kind, c, q, p, gradient)[0] * 1.3 for kind, _, _ in monitors]
    for update in UPDATES:
        control = Control(0.001, update=update, monitors=monitors, references=references)
        analytic = control.u(c, q, p, gradient)[1]
        numeric = differences(lambda x, k=control: k.u(c, q, x, gradient)[0])
        np.testing.assert_allclose(analytic, numeric, rtol=1e-6, atol=1e-6 * np.max(np.abs(numeric)))


def test_bounds_and_recursions_of_the_dense_statement() -> None:
    for update in UPDATES:
        control = Control(0.01, 0.0005, 0.03, update)
        assert control.mobius(1.0)[0] == pytest.approx(1, abs=1e-15)
        start = 1 / 3 if update != "Bounded" else 4 / 9
        assert control.mobius(0.0)[0] == pytest.approx(start, abs=1e-15)
        assert control.mobius(1e12)[0] == pytest.approx(20, rel=1e-9)
    for y in (-1e6, -1.0, 0.0, 1e-3, 1e6):
        assert control.f(control.f_inverse(y)) == pytest.approx(y, rel=1e-9, abs=1e-12)
    assert control.f_inverse(0.0) == pytest.approx(1, abs=1e-15)


def test_numbers_of_the_double_pendulum() -> None:
    """Measured for the double pendulum with other prototypes; the step density's first values follow from them."""
    model = double_pendulum()
    c, potential = model.constraints(), pendulum_potential(model)
    q, p = model.positions.ravel(), np.zeros(9)
    energy, gradient = potential(q)
    assert energy == pytest.approx(-288.493, abs=1e-3)
    assert monitor("ConstraintMultipliers", c, q, p, gradient)[0] == pytest.approx(0.3017, abs=1e-4)
    assert monitor("ConstraintForce", c, q, p, gradient)[0] == pytest.approx(0.5934, abs=1e-4)


@pytest.mark.parametrize("update", [SEMI_EXPLICIT, EXPLICIT])
def test_dense_stepper_conserves_energy(update: str) -> None:
    model = double_pendulum()
    control = Control(0.01, 1e-6, 0.02, update)
    stepper = DenseStepper(
        model.constraints(), pendulum_potential(model), control, model.positions.ravel(), np.zeros(9)
    )
    stepper.start()
    start = stepper.total_energy()
    while stepper.time < 1.0:
        stepper.step()
        assert abs(stepper.total_energy() - start) < 2e-3  # 1.8e-3 over the whole 12 ps
    assert stepper.control.nominal / stepper.rho < 0.02
