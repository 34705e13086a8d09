# OpenMM-VRATTLE: a run with everything that the public interface gives, and the equations of the method on it.
# SPDX-License-Identifier: MIT

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import openmm
import pytest
from dense_reference import (
    Array,
    Control,
    DenseConstraints,
    Model,
    monitor,
    open_context,
    positions_of,
    time_of,
    value,
    velocities_of,
)
from openmmvrattle import VariableStepRattleIntegrator


@dataclass
class Run:
    """States 0..n of a run and the n steps between them."""

    q: Array
    p: Array
    gradient: Array
    energy: Array
    dt: Array
    rho: Array
    time: Array
    multipliers: Array
    monitors: Array


def make_integrator(control: Control, tolerance: float) -> Any:
    integrator = VariableStepRattleIntegrator(control.nominal)
    integrator.setMinimumStepSize(control.minimum)
    integrator.setMaximumStepSize(control.maximum)
    integrator.setUpdateMethod(getattr(VariableStepRattleIntegrator, control.update))
    integrator.clearMonitors()
    for kind, weight, power in control.monitors:
        integrator.addMonitor(getattr(VariableStepRattleIntegrator, kind), weight, power, control.order)
    integrator.setConstraintTolerance(tolerance)
    return integrator


def record(model: Model, system: Any, control: Control, platform: str, tolerance: float, steps: int = 200) -> Run:
    """Run, and read everything after every step; forces come from a second Context with another integrator."""
    integrator = make_integrator(control, tolerance)
    model.constrain(integrator)
    context = open_context(system, integrator, platform, model)
    other_integrator = openmm.VerletIntegrator(0.001)
    groups = {31} if any(kind == "ForceGroupEnergy" for kind, _, _ in control.monitors) else set()
    other = open_context(system, other_integrator, platform, model)
    rows: list[tuple[Any, ...]] = []
    c = model.constraints()

    def look() -> None:
        q = positions_of(context)
        other.setPositions(q)
        state = other.getState(forces=True, groups=set(range(32)) - groups)
        energy = value(other.getState(energy=True, groups=groups).getPotentialEnergy()) if groups else 0.0
        rows.append(
            (
                q.ravel().copy(),
                c.m3 * velocities_of(context).ravel(),
                -state.getForces(asNumpy=True)._value.ravel(),
                energy,
                value(integrator.getStepSize()),
                integrator.getStepDensity(),
                time_of(context),
                [value(x) for x in integrator.getMultipliers()],
                [value(integrator.getMonitorValue(i)) for i in range(integrator.getNumMonitors())],
            )
        )

    look()
    for _ in range(steps):
        integrator.step(1)
        look()
    assert integrator.getNumRescues() == 0  # A rescued step does not obey the recursion.
    assert value(integrator.getNominalStepSize()) == control.nominal
    control.references = [value(integrator.getReferenceMonitorValue(i)) for i in range(integrator.getNumMonitors())]
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    columns[4], columns[5] = columns[4][1:], columns[5][1:]
    return Run(*columns)


def check_equations(run: Run, c: DenseConstraints, control: Control, tolerance: float, exact: float) -> None:
    h = control.nominal
    steps = run.dt.size
    np.testing.assert_allclose(run.dt, h / run.rho, rtol=1e-14)
    # A sum of steps in a different order of additions.
    np.testing.assert_allclose(np.diff(run.time), run.dt, rtol=0, atol=1e-15 * steps)
    assert run.time[-1] == pytest.approx(np.sum(run.dt), rel=1e-13)
    # The first step has the nominal size, because the reference value was left to be taken there.
    assert run.dt[0] == pytest.approx(h, rel=1e-12)
    half = c.m3 * (run.q[1:] - run.q[:-1]) / run.dt[:, None]  # (3.9)
    for n in range(steps + 1):
        q, p, gradient = run.q[n], run.p[n], run.gradient[n]
        if n > 0:
            # (3.11); 1e-15 for rounding of |r| - L where the tolerance is near it.
            assert np.max(np.abs(c.relative_errors(q))) <= tolerance + 1e-15 / np.min(c.lengths)
            # (3.13) relative to the velocities.
            velocity = c.w3 * p
            assert np.max(np.abs(c.jacobian(q) @ velocity)) <= exact * np.max(c.lengths) * np.linalg.norm(velocity)
            # (3.12): p[n] - p[n-1/2] + dt/2 grad V is in the range of G^T.
            lam = c.multipliers(q, p, gradient)
            impulse = run.dt[n - 1] / 2 * (c.norm(gradient) + c.norm(c.jacobian(q).T @ lam))
            assert c.outside_range(q, p - half[n - 1] + run.dt[n - 1] / 2 * gradient) <= exact * impulse
        # The constraint forces and the monitors as given by the integrator.
        lam = c.multipliers(q, p, gradient)
        np.testing.assert_allclose(run.multipliers[n], lam, rtol=exact, atol=exact * np.max(np.abs(lam)))
        for k, (kind, _, _) in enumerate(control.monitors):
            dense = monitor(kind, c, q, p, gradient, control.order, run.energy[n])[0]
            assert run.monitors[n, k] == pytest.approx(dense, rel=exact)
        if 0 < n < steps:
            # (3.10): p[n+1/2] - p[n-1/2] + c grad V is in the range of G^T.
            factor = (run.dt[n - 1] + run.dt[n]) / 2
            impulse = factor * (c.norm(gradient) + c.norm(c.jacobian(q).T @ lam))
            assert c.outside_range(q, half[n] - half[n - 1] + factor * gradient) <= exact * impulse
            # The recursion of the density.
            energy = run.energy[n]
            u_after, u_before, u_on = (control.u(c, q, x, gradient, energy)[0] for x in (half[n], half[n - 1], p))
            rest = control.density_residual(run.rho[n], run.rho[n - 1], u_after, u_before, u_on)
            assert abs(rest) <= exact * (run.rho[n] + run.rho[n - 1]), (n, rest)
