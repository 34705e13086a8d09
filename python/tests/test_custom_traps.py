# OpenMM-VRATTLE: what goes wrong silently in a CustomIntegrator of this kind, and limits of OpenMM's constraint solver.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import re
import warnings

import numpy as np
import openmm
import pytest
from custom_support import largest, open_on, platform_parameters, variable
from dense_reference import chain, energy_of, open_context, positions_of, time_of, value, waters
from openmm import app, unit
from openmmvrattle import ConstraintWarning, VariableStepRattleIntegrator
from openmmvrattle import CustomVariableStepRattleIntegrator as Custom
from openmmvrattle.custom.program import make_program
from openmmvrattle.custom.settings import MONITOR_KINDS, Monitor, Settings
from openmmvrattle.testsystems import constraint_error, light_heavy_chain, rigid_waters

# Names that mean something else to OpenMM: forces and energies of groups, and its own variables.
RESERVED = {"x", "v", "f", "m", "dt", "energy", "gaussian", "uniform"} | {f"{a}{i}" for a in "f" for i in range(32)}
FUNCTIONS = {"sqrt", "max", "min", "abs", "step", "delta", "select", "dot"}


@pytest.mark.parametrize("name", ["ConstraintForce", "ForcePNorm", "VectorField", "ForceGroupEnergy"])
def test_no_variable_has_a_reserved_name(name: str) -> None:
    """A stored force called f0 would be the forces of group 0."""
    settings = Settings(0.001, update=2, monitors=[Monitor(MONITOR_KINDS.index(name))], group=7)
    integrator = make_program(settings).make(0.001)
    ours = {integrator.getGlobalVariableName(i) for i in range(integrator.getNumGlobalVariables())}
    ours |= {integrator.getPerDofVariableName(i) for i in range(integrator.getNumPerDofVariables())}
    assert all(variable.startswith("vrattle_") for variable in ours)
    used = set()
    for i in range(integrator.getNumComputations()):
        _, _, expression = integrator.getComputationStep(i)
        # Definitions at the end of an expression have names of their own.
        local = set(re.findall(r";\s*(\w+)\s*=", expression))
        used |= set(re.findall(r"(?<![\w.])[A-Za-z_]\w*", expression)) - local
        assert not local & (RESERVED | ours)
    expected = {"x", "v", "f", "m"} | ({"energy7"} if name == "ForceGroupEnergy" else set())
    assert used - ours - FUNCTIONS == expected


def test_parameters_of_forces_may_have_any_name() -> None:
    """A variable of an integrator must not be called like a parameter of a Force: ours never are."""
    model = chain()
    system, plain = model.system(), model.system()
    force = openmm.CustomExternalForce("0*(force + trial + step_ + rho + density)*x")
    for name in ("force", "trial", "step_", "rho", "density"):
        force.addGlobalParameter(name, 1.0)
    force.addParticle(0)
    system.addForce(force)
    results = []
    for each in (system, plain):
        integrator = Custom(0.0005)
        context = open_context(each, integrator, "Reference", model)
        integrator.step(20)
        results.append(positions_of(context))
    assert np.array_equal(*results)


def without_going_back(monitors: list[Monitor]) -> openmm.CustomIntegrator:
    """The program with one thing left out: going back to the stored positions between two passes."""
    program = make_program(Settings(0.001, monitors=monitors))
    goes_back = ("addComputePerDof", "x", "$start")
    place = program.steps.index(goes_back)
    assert program.steps[place + 1] == ("addConstrainPositions",)
    del program.steps[place : place + 2]
    return program.make(0.001)


@pytest.mark.parametrize("platform, precision, bound", platform_parameters(double=0.1, mixed=0.1))
def test_constraints_are_repeated_from_the_stored_positions(platform: str, precision: str, bound: float) -> None:
    """The reference of a constraint is what was constrained last; without going back the energy drifts."""
    model = waters()
    monitors = [Monitor(MONITOR_KINDS.index("ConstraintForce"))]
    drifts = []
    for integrator in (Custom(0.001), without_going_back(monitors)):
        if platform == "OpenCL" and drifts:
            continue  # Another program to compile, to show the same.
        integrator.setConstraintTolerance(1e-10)
        context = open_on(platform, precision, model.system(), integrator, model)
        start = energy_of(context)
        integrator.step(60)
        drifts.append(abs(energy_of(context) - start))
        assert integrator.getGlobalVariableByName("vrattle_passes") > 110
    print("energy errors with and without going back", drifts)
    assert drifts[0] < bound
    assert drifts[1:] == [] or drifts[1] > 1


@pytest.mark.parametrize("platform, precision, bound", platform_parameters(double=1e-12, mixed=1e-12, single=1e-12))
def test_the_time_is_the_sum_of_the_steps(platform: str, precision: str, bound: float) -> None:
    """On Reference and CPU the Context's time would advance by the step size of the constructor."""
    test = rigid_waters()
    integrator = Custom(0.001)
    context = open_on(platform, precision, test.system, integrator, test)
    context.setTime(5.0)
    total = 5.0
    for _ in range(30):
        integrator.step(1)
        total += value(integrator.getStepSize())
    assert time_of(context) == pytest.approx(total, rel=bound)
    assert abs(total - 5.03) > 1e-4
    before = variable(integrator, "clock")
    integrator.step(25)
    assert time_of(context) == variable(integrator, "clock") > before
    assert context.getStepCount() == 55


@pytest.mark.parametrize("platform, precision, bound", platform_parameters(single=0.01, mixed=1e-5, double=1e-6))
def test_the_search_for_the_density_ends(platform: str, precision: str, bound: float) -> None:
    """In single precision, where a constraint force is known to three digits, as well as in double."""
    test = rigid_waters()
    integrator = Custom(0.001, constraintTolerance=None if precision == "single" else 1e-9)
    context = open_on(platform, precision, test.system, integrator, test)
    integrator.step(1)
    counts, residuals = [], []
    for _ in range(50):
        integrator.step(1)
        counts.append(variable(integrator, "count"))
        residuals.append(abs(variable(integrator, "residual")) / integrator.getStepDensity())
    print(platform, precision, "passes", np.mean(counts), "largest", max(counts), "residual", max(residuals))
    assert integrator.getConstraintTolerance() == (1e-5 if precision == "single" else 1e-9)
    assert max(counts) < 10 and np.mean(counts) < 5
    assert max(residuals) < bound
    assert integrator.getNumRescues() == 0
    assert context.getStepCount() == 51


def four_site_water() -> tuple[openmm.System, np.ndarray]:
    field = app.ForceField("tip4pew.xml")
    modeller = app.Modeller(app.Topology(), [] * unit.nanometer)
    modeller.addSolvent(field, model="tip4pew", numAdded=8)
    system = field.createSystem(modeller.topology, nonbondedMethod=app.NoCutoff, removeCMMotion=False)
    return system, np.array(modeller.positions.value_in_unit(unit.nanometer))


def test_virtual_sites_are_refused_where_they_lag_behind(platform: str) -> None:
    """On Reference and CPU a CustomIntegrator moves them at the end of a step, after it has computed the forces."""
    system, positions = four_site_water()
    integrator = Custom(0.001)
    context = open_on(platform, "double", system, integrator)
    context.setPositions(positions)
    with pytest.raises(openmm.OpenMMException, match=f"platform {platform} .*virtual sites that lag behind"):
        integrator.step(1)


def test_virtual_sites_on_other_platforms() -> None:
    """The energy is as good as that of the plugin on Reference."""
    system, positions = four_site_water()
    start, errors = None, []
    for integrator, platform in (
        (VariableStepRattleIntegrator(0.0005, monitors=[3]), "Reference"),
        (Custom(0.0005, monitors=[3]), "OpenCL"),
    ):
        context = open_on(platform, "double", system, integrator)
        if start is None:
            context.setPositions(positions)
            openmm.LocalEnergyMinimizer.minimize(context, 10, 50)
            context.setVelocitiesToTemperature(150, 3)
            start = context.getState(positions=True, velocities=True)
        context.setState(start)
        energies = []
        for _ in range(60):
            integrator.step(1)
            energies.append(energy_of(context))
        errors.append(np.ptp(energies))
    assert errors[1] == pytest.approx(errors[0], rel=0.1)


def test_drude_particles_are_refused() -> None:
    system = openmm.System()
    for mass in (15.6, 0.4):
        system.addParticle(mass)
    drude = openmm.DrudeForce()
    drude.addParticle(1, 0, -1, -1, -1, -1.0, 0.001, 1, 1)
    system.addForce(drude)
    integrator = Custom(0.001, monitors=[])
    context = open_context(system, integrator, "Reference")
    context.setPositions(np.zeros((2, 3)))
    with pytest.raises(openmm.OpenMMException, match="DrudeSCFIntegrator"):
        integrator.step(1)


# The limits: OpenMM's constraint solver on strongly coupled bonds


def run_whip(integrator: openmm.Integrator, steps: int) -> tuple[float, float, list[str]]:
    """The largest energy error and constraint error, and what was warned of."""
    test = light_heavy_chain()
    integrator.setMinimumStepSize(1.25e-5)
    integrator.setMaximumStepSize(1.25e-2)
    context = open_context(test.system, integrator, "Reference", test)
    start, energy, constraint, messages = energy_of(context), 0.0, 0.0, []
    for _ in range(steps // 10):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                integrator.step(10)
            except openmm.OpenMMException as error:
                messages.append(str(error))
                break
            finally:
                messages += [str(warning.message) for warning in caught if warning.category is ConstraintWarning]
        energy = max(energy, abs(energy_of(context) - start))
        constraint = max(constraint, constraint_error(test.system, positions_of(context)))
    return energy, constraint, messages


@pytest.mark.parametrize("tolerance", [pytest.param(1e-5, marks=pytest.mark.claims), 1e-8])
def test_constraints_that_openmm_does_not_meet_are_noticed(tolerance: float) -> None:
    """The chain I-H-I, of 2.5 kJ/mol, where the plugin has an energy error of 3e-6 and OpenMM's solver stops early."""
    plugin = run_whip(
        VariableStepRattleIntegrator(0.00125, monitors=[VariableStepRattleIntegrator.ConstraintForce]), 4000
    )
    energy, constraint, messages = run_whip(Custom(0.00125, constraintTolerance=tolerance), 4000)
    print(f"plugin: energy error {plugin[0]:.1e}, constraints {plugin[1]:.1e}")
    print(f"custom, tolerance {tolerance:.0e}: energy error {energy:.1e}, constraints {constraint:.1e}", messages)
    assert plugin[0] < 1e-4 and plugin[1] < 1e-8 and plugin[2] == []
    assert energy > 1000 * plugin[0]
    assert messages
    assert all("VariableStepRattleIntegrator, which runs on every platform" in m for m in messages)
    if tolerance == 1e-8:
        assert constraint > 1e-7
        assert re.search(r"left a relative error of \S+ \(tolerance 1e-08\) in the distance of particles", messages[0])
        assert "has lost the distance" in messages[-1]  # an exception, and the run ends
    else:
        assert re.search(r"\d+ of \d+ steps had to be rescued", messages[0])
    # Each trouble once, and again when it has become ten times as large.
    assert len(messages) < 15


def test_where_constraints_are_met_nothing_is_said() -> None:
    test = rigid_waters()
    integrator = Custom(0.001, constraintTolerance=1e-12)  # OpenMM's SETTLE has its lengths in single precision.
    context = open_context(test.system, integrator, "Reference", test)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        integrator.step(200)
    assert 1e-12 < constraint_error(test.system, positions_of(context)) < 1e-6


def test_large_numbers_of_steps_are_checked_on_the_way() -> None:
    """One call of step() is enough to be told."""
    test = light_heavy_chain()
    integrator = Custom(0.00125, minimumStepSize=1.25e-5, maximumStepSize=1.25e-2)
    context = open_context(test.system, integrator, "Reference", test)
    with pytest.warns(ConstraintWarning), pytest.raises(openmm.OpenMMException, match="has lost the distance"):
        integrator.step(100_000)
    assert context.getStepCount() < 10_000
    assert largest(positions_of(context) - test.positions) > 0


def test_the_solver_of_opencl_is_less_exact() -> None:
    """A chain of masses from 1 to 150, which Reference solves to 1e-10."""
    model = chain()
    for platform in ("Reference", "OpenCL"):
        integrator = Custom(0.0005, monitors=[Custom.AppliedForce], constraintTolerance=1e-10)
        context = open_on(platform, "double", model.system(), integrator, model)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            integrator.step(20)
        messages = [str(warning.message) for warning in caught if warning.category is ConstraintWarning]
        error = constraint_error(context.getSystem(), positions_of(context))
        print(platform, "error left", error, messages)
        assert bool(messages) == (platform == "OpenCL")
        assert (error > 1e-7) == (platform == "OpenCL")
