# OpenMM-VRATTLE: XML, copies, checkpoints, States and reinitialization from Python.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import copy
import gc
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import openmm
import openmmvrattle
import pytest
from dense_reference import open_context, positions_of, time_of, value, velocities_of
from openmm import app
from openmmvrattle import VariableStepRattleIntegrator
from openmmvrattle.testsystems import TestSystem, alanine_dipeptide, rigid_waters
from run_support import GPU, needs_gpu

pytestmark = pytest.mark.filterwarnings("ignore:.etNormOrder:DeprecationWarning")

UPDATES = {name: getattr(VariableStepRattleIntegrator, name) for name in ("SemiExplicit", "Explicit", "Bounded")}
STEP = 0.001


@pytest.fixture(scope="module")
def molecule() -> TestSystem:
    return alanine_dipeptide()


@pytest.fixture(scope="module")
def water() -> TestSystem:
    return rigid_waters()


def make_integrator(update: int = 0, **settings: Any) -> VariableStepRattleIntegrator:
    return VariableStepRattleIntegrator(STEP, updateMethod=update, **settings)


def open_test_context(
    test: TestSystem, integrator: openmm.Integrator, platform: str = "Reference", with_state: bool = True
) -> openmm.Context:
    return open_context(test.system, integrator, platform, test if with_state else None)


def open_simulation(
    test: TestSystem, integrator: openmm.Integrator, platform: str, with_state: bool = True
) -> app.Simulation:
    simulation = app.Simulation(test.topology, test.system, integrator, openmm.Platform.getPlatform(platform))
    if with_state:
        simulation.context.setPositions(test.positions)
        simulation.context.setVelocities(test.velocities)
    return simulation


def trace(context: openmm.Context, integrator: VariableStepRattleIntegrator, steps: int) -> np.ndarray:
    """Everything that can be seen of a run in the course of some more steps, as one array of numbers."""
    numbers: list[float] = []
    for _ in range(steps):
        integrator.step(1)
        numbers += [integrator.getStepDensity(), integrator.getStepSize()._value]
    for index in range(integrator.getNumMonitors()):
        numbers += [integrator.getReferenceMonitorValue(index), integrator.getMonitorValue(index)]
    arrays = [np.array([*numbers, time_of(context), context.getStepCount()])]
    return np.concatenate([*arrays, positions_of(context).ravel(), velocities_of(context).ravel()])


def settings_of(integrator: VariableStepRattleIntegrator) -> dict[str, Any]:
    """Every setting of an unbound integrator."""
    kinds = range(integrator.getNumMonitors())
    result = {
        name: getattr(integrator, name)()
        for name in (
            "getNominalStepSize",
            "getStepSize",
            "getMinimumStepSize",
            "getMaximumStepSize",
            "getUpdateMethod",
            "getConstraintTolerance",
            "getIntegrationForceGroups",
            "getNormOrder",
            "getMonitorForceGroup",
            "getNumMonitors",
        )
    }
    return result | {
        "monitors": [integrator.getMonitor(i) for i in kinds],
        "references": [integrator.getReferenceMonitorValue(i) for i in kinds],
    }


def integrators_with_settings() -> dict[str, VariableStepRattleIntegrator]:
    """One integrator for each setting that is not its default, and one with all of them."""
    arguments: dict[str, dict[str, Any]] = {
        "defaults": {},
        "update": {"updateMethod": VariableStepRattleIntegrator.Bounded},
        "minimum": {"minimumStepSize": STEP / 3},
        "maximum": {"maximumStepSize": STEP * 1.7},
        "no bounds": {"minimumStepSize": 0, "maximumStepSize": 0},
        "tolerance": {"constraintTolerance": 1e-10 / 3},
        "no monitors": {"monitors": []},
        "monitors": {
            "monitors": [
                (VariableStepRattleIntegrator.ForcePNorm, 0.1, 1 / 3),
                VariableStepRattleIntegrator.VectorField,
            ],
            "referenceMonitorValue": 1234.5678901234567,
        },
        "norm order": {"normOrder": 5.5},
        "force group": {"monitorForceGroup": 3, "monitors": [VariableStepRattleIntegrator.ForceGroupEnergy]},
    }
    result = {name: VariableStepRattleIntegrator(STEP, **chosen) for name, chosen in arguments.items()}
    merged = {key: setting for chosen in arguments.values() for key, setting in chosen.items()}
    merged |= {"minimumStepSize": STEP / 7, "maximumStepSize": STEP * 1.1}
    result["everything"] = VariableStepRattleIntegrator(STEP / 3, **merged)
    result["everything"].setIntegrationForceGroups({0, 2, 31})
    result["force groups"] = VariableStepRattleIntegrator(STEP)
    result["force groups"].setIntegrationForceGroups(0)
    return result


COPIES = {
    "XML and cast": lambda i: VariableStepRattleIntegrator.cast(
        openmm.XmlSerializer.deserialize(openmm.XmlSerializer.serialize(i))
    ),
    "XML": lambda i: openmmvrattle.XmlSerializer.deserialize(openmmvrattle.XmlSerializer.serialize(i)),
    "clone and cast": lambda i: VariableStepRattleIntegrator.cast(openmm.XmlSerializer.clone(i)),
    "clone": openmmvrattle.XmlSerializer.clone,
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda i: pickle.loads(pickle.dumps(i)),
}


# XML and copies


# All ways go through the same XML.
@pytest.mark.parametrize(
    ("way", "name"),
    [*(("XML", name) for name in integrators_with_settings()), *((way, "everything") for way in COPIES)],
)
def test_copies_have_every_setting(way: str, name: str) -> None:
    integrator = integrators_with_settings()[name]
    duplicate = COPIES[way](integrator)
    assert type(duplicate) is VariableStepRattleIntegrator
    assert duplicate is not integrator
    assert settings_of(duplicate) == settings_of(integrator)
    # The copy is on its own.
    duplicate.setNominalStepSize(STEP / 2.9)
    duplicate.setMonitorForceGroup(4)
    assert settings_of(integrator) == settings_of(integrators_with_settings()[name])


@pytest.mark.parametrize("way", COPIES)
def test_bounds_that_were_not_set_follow_the_nominal_step(way: str) -> None:
    duplicate = COPIES[way](VariableStepRattleIntegrator(STEP, maximumStepSize=1.5 * STEP))
    duplicate.setNominalStepSize(STEP / 2)
    assert duplicate.getMinimumStepSize()._value == pytest.approx(STEP / 100, rel=1e-14)
    assert duplicate.getMaximumStepSize()._value == 1.5 * STEP


@pytest.mark.parametrize("way", COPIES)
def test_copies_of_an_integrator_in_use_are_not_bound(way: str, molecule: TestSystem) -> None:
    integrator = make_integrator()
    context = open_test_context(molecule, integrator)
    integrator.step(3)
    duplicate = COPIES[way](integrator)
    assert duplicate.getReferenceMonitorValue() == 0  # found by the run, not set
    assert duplicate.getStepSize()._value == STEP
    with pytest.raises(openmm.OpenMMException, match="not bound to a context"):
        duplicate.step(1)
    other = open_test_context(molecule, duplicate)
    duplicate.step(3)
    assert np.array_equal(positions_of(context), positions_of(other))


def test_a_copy_keeps_subclass_and_attributes() -> None:
    class Named(VariableStepRattleIntegrator):
        def __init__(self, name: str) -> None:
            super().__init__(STEP)
            self.names = [name]

    integrator = Named("first")
    for duplicate in (copy.copy(integrator), copy.deepcopy(integrator)):
        assert type(duplicate) is Named
        assert duplicate.names == ["first"]
        assert duplicate.names is not integrator.names
    plain = VariableStepRattleIntegrator(STEP)
    plain.label = "with a label"
    assert pickle.loads(pickle.dumps(plain)).label == "with a label"


def test_xml_names_its_version_and_a_newer_one_is_refused() -> None:
    xml = openmm.XmlSerializer.serialize(VariableStepRattleIntegrator(STEP))
    newer = xml.replace('version="3"', 'version="12"')
    assert newer != xml
    for serializer in (openmm.XmlSerializer, openmmvrattle.XmlSerializer):
        with pytest.raises(openmm.OpenMMException, match="version 12 of their format and this plugin reads version 3"):
            serializer.deserialize(newer)


def test_xml_is_read_with_the_package_alone(tmp_path: Path) -> None:
    """Importing the package is enough for OpenMM to know our XML."""
    file = tmp_path / "integrator.xml"
    file.write_text(openmm.XmlSerializer.serialize(VariableStepRattleIntegrator(0.00325)))
    script = (
        "import sys, openmm, openmmvrattle\n"
        "integrator = openmm.XmlSerializer.deserialize(open(sys.argv[1]).read())\n"
        "print(openmmvrattle.VariableStepRattleIntegrator.cast(integrator).getNominalStepSize()._value)\n"
    )
    result = subprocess.run([sys.executable, "-c", script, str(file)], capture_output=True, text=True, check=True)
    assert float(result.stdout) == 0.00325


def test_our_serializer_leaves_other_objects_to_openmm(molecule: TestSystem) -> None:
    serializer = openmmvrattle.XmlSerializer
    system = serializer.deserialize(serializer.serialize(molecule.system))
    assert system.getNumConstraints() == molecule.system.getNumConstraints()
    verlet = serializer.clone(openmm.VerletIntegrator(0.00275))
    assert type(verlet) is openmm.VerletIntegrator
    assert verlet.getStepSize()._value == 0.00275
    assert type(serializer.clone(openmm.HarmonicBondForce())) is openmm.HarmonicBondForce
    with pytest.raises(ValueError):
        serializer.serialize(3)


def test_cast_and_isinstance() -> None:
    xml = openmm.XmlSerializer.serialize(VariableStepRattleIntegrator(STEP))
    bare = openmm.XmlSerializer.deserialize(xml)
    assert VariableStepRattleIntegrator.isinstance(bare)
    assert VariableStepRattleIntegrator.cast(bare) is bare
    assert isinstance(bare, VariableStepRattleIntegrator)
    assert VariableStepRattleIntegrator.cast(bare) is bare  # twice does no harm
    assert bare.thisown
    verlet = openmm.VerletIntegrator(STEP)
    assert not VariableStepRattleIntegrator.isinstance(verlet)
    with pytest.raises(TypeError, match="VerletIntegrator"):
        VariableStepRattleIntegrator.cast(verlet)
    with pytest.raises(TypeError, match="a str is not a VariableStepRattleIntegrator"):
        VariableStepRattleIntegrator.cast("an integrator")
    assert not VariableStepRattleIntegrator.isinstance("an integrator")
    assert verlet.getStepSize()._value == STEP


def test_integrators_of_a_compound_integrator(molecule: TestSystem) -> None:
    compound = openmm.CompoundIntegrator()
    compound.addIntegrator(VariableStepRattleIntegrator.cast(openmm.XmlSerializer.clone(make_integrator())))
    compound.addIntegrator(openmm.VerletIntegrator(STEP))
    for _ in range(3):
        ours = VariableStepRattleIntegrator.cast(compound.getIntegrator(0))
        assert not ours.thisown
        ours.setNominalStepSize(STEP / 2)
        del ours
        gc.collect()
    duplicate = copy.deepcopy(compound)
    assert VariableStepRattleIntegrator.cast(duplicate.getIntegrator(0)).getNominalStepSize()._value == STEP / 2
    context = open_test_context(molecule, duplicate)
    duplicate.step(2)
    assert context.getStepCount() == 2


def test_casts_and_copies_free_their_memory_once() -> None:
    integrator = make_integrator()
    for _ in range(200):
        for way in COPIES.values():
            way(integrator).getStepSize()
    gc.collect()
    assert integrator.getStepSize()._value == STEP


# Checkpoints


@pytest.mark.parametrize("update", UPDATES.values(), ids=UPDATES)
def test_a_checkpoint_goes_on_to_the_last_bit(update: int, molecule: TestSystem) -> None:
    integrator, other = make_integrator(update), VariableStepRattleIntegrator(0.1 * STEP)
    context = open_test_context(molecule, integrator)
    integrator.step(50)
    checkpoint = context.createCheckpoint()
    size, density = integrator.getStepSize(), integrator.getStepDensity()
    expected = trace(context, integrator, 500)
    assert np.ptp(expected[:1000:2]) > 1e-3  # the steps vary
    context.loadCheckpoint(checkpoint)
    assert (integrator.getStepSize(), integrator.getStepDensity()) == (size, density)
    assert np.array_equal(trace(context, integrator, 500), expected)
    new = open_test_context(molecule, other, with_state=False)
    new.loadCheckpoint(checkpoint)
    assert (other.getStepSize(), other.getStepDensity()) == (size, density)
    assert other.getUpdateMethod() == update and other.getNominalStepSize()._value == STEP
    assert other.getReferenceMonitorValue() == integrator.getReferenceMonitorValue()
    assert np.array_equal(trace(new, other, 500), expected)


def test_a_checkpoint_goes_on_in_another_process(water: TestSystem, tmp_path: Path) -> None:
    integrator = make_integrator()
    simulation = open_simulation(water, integrator, "Reference")
    simulation.step(30)
    simulation.saveCheckpoint(str(tmp_path / "run.chk"))
    (tmp_path / "system.xml").write_text(openmm.XmlSerializer.serialize(water.system))
    script = (
        "import sys, openmm\n"
        "from openmmvrattle import VariableStepRattleIntegrator\n"
        "system = openmm.XmlSerializer.deserialize(open(sys.argv[1] + '/system.xml').read())\n"
        "integrator = VariableStepRattleIntegrator(0.0001)\n"
        "context = openmm.Context(system, integrator, openmm.Platform.getPlatform('Reference'))\n"
        "context.loadCheckpoint(open(sys.argv[1] + '/run.chk', 'rb').read())\n"
        "integrator.step(500)\n"
        "state = context.getState(positions=True, velocities=True)\n"
        "print(*state.getPositions(asNumpy=True)._value.ravel().tolist(), state.getTime()._value)\n"
    )
    result = subprocess.run([sys.executable, "-c", script, str(tmp_path)], capture_output=True, text=True, check=True)
    simulation.step(500)
    expected = [*positions_of(simulation.context).ravel(), time_of(simulation.context)]
    assert [float(number) for number in result.stdout.split()] == expected


def test_a_checkpoint_on_every_platform(water: TestSystem, platform: str) -> None:
    """On CPU, forces that are summed in a fixed order leave nothing that could differ."""
    integrator, other = make_integrator(), make_integrator()
    context = open_test_context(water, integrator, platform)
    integrator.step(30)
    checkpoint = context.createCheckpoint()
    expected = trace(context, integrator, 50)
    new = open_test_context(water, other, platform, with_state=False)
    new.loadCheckpoint(checkpoint)
    assert trace(new, other, 50) == pytest.approx(expected, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("is_set", [False, True])
@pytest.mark.parametrize("platform", ["Reference", pytest.param(GPU, marks=needs_gpu)])
def test_a_checkpoint_where_forces_are_no_numbers(platform: str, is_set: bool) -> None:
    """It can be written; what was loaded from it runs as soon as the forces are numbers again."""
    system = openmm.System()
    field = openmm.CustomExternalForce("k*(x^2+y^2+z^2)")
    field.addGlobalParameter("k", 100)
    for particle in range(3):
        system.addParticle(12.0)
        field.addParticle(particle)
    system.addForce(field)

    def open_here() -> tuple[openmm.Context, VariableStepRattleIntegrator]:
        integrator = VariableStepRattleIntegrator(0.001, monitors=[VariableStepRattleIntegrator.AppliedForce])
        properties = {"Precision": "double"} if platform == GPU else {}
        context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform), properties)
        context.setPositions([[0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.3]])
        return context, integrator

    context, integrator = open_here()
    integrator.step(10)
    context.setParameter("k", float("nan"))
    context.getState(energy=True)
    if is_set:
        integrator.setConstraintTolerance(1e-7)
    other, successor = open_here()
    other.loadCheckpoint(context.createCheckpoint())
    for each, run in ((context, integrator), (other, successor)):
        with pytest.raises(openmm.OpenMMException, match="infinite or not a number"):
            run.step(1)
        each.setParameter("k", 100)
        run.step(5)
        assert each.getStepCount() == 15
        assert np.isfinite(positions_of(each)).all()


@pytest.mark.parametrize("is_set", [False, True])
@pytest.mark.parametrize("platform", ["Reference", pytest.param(GPU, marks=needs_gpu)])
def test_a_checkpoint_after_a_parameter_has_changed(platform: str, is_set: bool) -> None:
    """The density is scaled with u, also where somebody has computed the new forces before, or changes a setting."""
    system = openmm.System()
    field = openmm.CustomExternalForce("k*((x-1)^2 + 2*(y-1)^2 + (z-1)^2)")
    field.addGlobalParameter("k", 100)
    for particle in range(3):
        system.addParticle(12.0)
        field.addParticle(particle)
    system.addConstraint(0, 1, 0.1)
    system.addForce(field)

    def open_here() -> tuple[openmm.Context, VariableStepRattleIntegrator]:
        monitors = [VariableStepRattleIntegrator.AppliedForce]
        integrator = VariableStepRattleIntegrator(0.002, VariableStepRattleIntegrator.Explicit, 0, 0, monitors=monitors)
        properties = {"Precision": "double"} if platform == GPU else {}
        context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform), properties)
        context.setPositions([[1.0, 1, 1.1], [1.1, 1, 1.1], [1.3, 0.8, 1]])
        return context, integrator

    context, integrator = open_here()
    integrator.step(10)
    before = value(integrator.getStepSize())
    context.setParameter("k", 150)
    context.getState(energy=True)
    if is_set:
        integrator.setConstraintTolerance(1e-7)
    other, successor = open_here()
    other.loadCheckpoint(context.createCheckpoint())
    for each in (integrator, successor):
        sizes = []
        for _ in range(5):
            each.step(1)
            sizes.append(value(each.getStepSize()))
        assert np.array(sizes) / before == pytest.approx(1 / 1.5, rel=0.05)


def test_a_checkpoint_with_a_thermostat(molecule: TestSystem) -> None:
    """OpenMM's checkpoint holds the random numbers, ours what they did to the density."""
    system = copy.deepcopy(molecule.system)
    thermostat = openmm.AndersenThermostat(300, 50)
    thermostat.setRandomNumberSeed(3)
    system.addForce(thermostat)
    integrator = make_integrator(monitors=[VariableStepRattleIntegrator.AppliedForce])
    context = open_context(system, integrator, "Reference", molecule)
    integrator.step(50)
    checkpoint = context.createCheckpoint()
    expected = trace(context, integrator, 500)
    context.loadCheckpoint(checkpoint)
    assert np.array_equal(trace(context, integrator, 500), expected)


def test_simulation_and_reporter(water: TestSystem, tmp_path: Path, platform: str) -> None:
    integrator = make_integrator()
    simulation = open_simulation(water, integrator, platform)
    simulation.reporters.append(app.CheckpointReporter(str(tmp_path / "reported.chk"), 20))
    simulation.reporters.append(app.CheckpointReporter(str(tmp_path / "reported.xml"), 20, writeState=True))
    simulation.step(20)
    simulation.saveCheckpoint(str(tmp_path / "saved.chk"))
    simulation.saveState(str(tmp_path / "saved.xml"))
    simulation.reporters.clear()
    simulation.step(50)
    expected = positions_of(simulation.context)
    for name in ("reported.chk", "reported.xml", "saved.chk", "saved.xml"):
        restored = open_simulation(water, VariableStepRattleIntegrator(0.5 * STEP), platform, with_state=False)
        load = restored.loadState if name.endswith("xml") else restored.loadCheckpoint
        load(str(tmp_path / name))
        assert restored.currentStep == 20
        assert restored.integrator.getStepSize()._value != restored.integrator.getNominalStepSize()._value == STEP
        restored.step(50)
        exact = platform == "Reference" and name.endswith("chk")
        difference = np.max(np.abs(positions_of(restored.context) - expected))
        assert difference <= (0 if exact else 1e-12 if platform == "Reference" else 1e-6)


def test_a_checkpoint_of_something_else_is_refused(water: TestSystem, molecule: TestSystem) -> None:
    integrator = make_integrator()
    context = open_test_context(water, integrator)
    integrator.step(5)
    checkpoint = context.createCheckpoint()
    system = copy.deepcopy(water.system)
    p1, p2, length = system.getConstraintParameters(0)
    system.setConstraintParameters(0, p1, p2, 1.01 * length)
    stretched = open_context(system, make_integrator(), "Reference")
    with pytest.raises(openmm.OpenMMException, match="another System"):
        stretched.loadCheckpoint(checkpoint)
    with pytest.raises(openmm.OpenMMException, match="number of particles"):
        open_test_context(molecule, make_integrator()).loadCheckpoint(checkpoint)
    # A number after the mark says which version of the format it is.
    mark = checkpoint.index(b"VRATTLE\n") + 8
    newer = checkpoint[:mark] + (7).to_bytes(4, sys.byteorder) + checkpoint[mark + 4 :]
    with pytest.raises(openmm.OpenMMException, match="version 7 of its format and this plugin reads version 6"):
        context.loadCheckpoint(newer)
    for end in (mark - 3, mark + 2, mark + 10, mark + 30, len(checkpoint) - 1):
        with pytest.raises(openmm.OpenMMException, match="OpenMM-VRATTLE: this checkpoint"):
            context.loadCheckpoint(checkpoint[:end])
    context.loadCheckpoint(checkpoint)
    integrator.step(1)


# States


@pytest.mark.parametrize("update", UPDATES.values(), ids=UPDATES)
def test_a_state_goes_on_to_rounding(update: int, molecule: TestSystem) -> None:
    integrator, other = make_integrator(update), VariableStepRattleIntegrator(0.1 * STEP)
    context = open_test_context(molecule, integrator)
    integrator.step(50)
    state = context.getState(positions=True, velocities=True, parameters=True, integratorParameters=True)
    xml = openmm.XmlSerializer.serialize(state)
    size, density = integrator.getStepSize(), integrator.getStepDensity()
    expected = trace(context, integrator, 50)
    for source in (state, openmm.XmlSerializer.deserialize(xml), pickle.loads(pickle.dumps(state))):
        new = open_test_context(molecule, other, with_state=False)
        new.setState(source)
        assert (other.getStepSize(), other.getStepDensity()) == (size, density)
        assert other.getUpdateMethod() == update and other.getNominalStepSize()._value == STEP
        assert other.getReferenceMonitorValue() == integrator.getReferenceMonitorValue()
        assert trace(new, other, 50) == pytest.approx(expected, rel=1e-12, abs=1e-12)
        other = VariableStepRattleIntegrator(0.1 * STEP)


def test_a_state_without_parameters_starts_afresh(molecule: TestSystem) -> None:
    integrator = make_integrator()
    context = open_test_context(molecule, integrator)
    integrator.step(20)
    state = context.getState(positions=True, velocities=True)
    fresh = make_integrator()
    new = open_test_context(molecule, fresh, with_state=False)
    new.setState(state)
    fresh.step(1)
    assert fresh.getStepDensity() == 1


def test_a_state_of_another_system_starts_afresh(molecule: TestSystem) -> None:
    """Restraints that served in equilibration are gone: nothing of their forces may act."""
    restrained = copy.deepcopy(molecule.system)
    restraint = openmm.CustomExternalForce("500*((x-x0)^2+(y-y0)^2+(z-z0)^2)")
    for name in ("x0", "y0", "z0"):
        restraint.addPerParticleParameter(name)
    for i in range(5):
        restraint.addParticle(i, molecule.positions[i].tolist())
    restrained.addForce(restraint)
    integrator = make_integrator()
    context = open_context(restrained, integrator, "Reference", molecule)
    integrator.step(50)
    state = context.getState(positions=True, velocities=True, integratorParameters=True)
    restored, fresh = make_integrator(), make_integrator()
    fresh.setReferenceMonitorValue(integrator.getReferenceMonitorValue())
    new, reference = (open_test_context(molecule, i, with_state=False) for i in (restored, fresh))
    new.setState(state)
    reference.setPositions(state.getPositions())
    reference.setVelocities(state.getVelocities())
    for i in (restored, fresh):
        i.step(20)
    assert np.max(np.abs(positions_of(new) - positions_of(reference))) < 1e-12


def test_a_state_of_another_kind_is_refused(water: TestSystem) -> None:
    integrator = make_integrator()
    context = open_test_context(water, integrator)
    state = context.getState(positions=True, velocities=True, integratorParameters=True)
    xml = openmm.XmlSerializer.serialize(state)
    newer = xml.replace(
        'integrator="VariableStepRattleIntegrator" version="3"', 'integrator="VariableStepRattleIntegrator" version="4"'
    )
    assert newer != xml
    with pytest.raises(openmm.OpenMMException, match="version 4 of their format and this plugin reads version 3"):
        context.setState(openmm.XmlSerializer.deserialize(newer))
    verlet = open_test_context(water, openmm.VerletIntegrator(STEP))
    verlet.setState(context.getState(positions=True, velocities=True, integratorParameters=True))


def compound_of(*integrators: openmm.Integrator) -> openmm.CompoundIntegrator:
    compound = openmm.CompoundIntegrator()
    for integrator in integrators:
        compound.addIntegrator(integrator)
    return compound


def custom_integrator() -> openmm.CustomIntegrator:
    integrator = openmm.CustomIntegrator(STEP)
    integrator.addGlobalVariable("a", 1.5)
    integrator.addPerDofVariable("old", 0)
    integrator.addComputePerDof("v", "v+dt*f/m")
    integrator.addComputePerDof("old", "x")
    integrator.addComputePerDof("x", "x+dt*v")
    integrator.addConstrainPositions()
    integrator.addComputePerDof("v", "(x-old)/dt")
    return integrator


def qtb_integrator() -> openmm.QTBIntegrator:
    integrator = openmm.QTBIntegrator(300, 1, STEP)
    integrator.setSegmentLength(0.05)  # of the noise, which takes seconds to make for the default of 1 ps
    return integrator


OTHERS = {
    "Verlet": lambda: openmm.VerletIntegrator(STEP),
    "LangevinMiddle": lambda: openmm.LangevinMiddleIntegrator(300, 1, STEP),
    "NoseHoover": lambda: openmm.NoseHooverIntegrator(300, 1, STEP),
    "Custom": custom_integrator,
    "MTSLangevin": lambda: openmm.MTSLangevinIntegrator(300, 1, STEP, [(0, 1)]),
    "QTB": qtb_integrator,
    "Compound": lambda: compound_of(openmm.LangevinMiddleIntegrator(300, 1, STEP), custom_integrator()),
    "Compound with ours": lambda: compound_of(custom_integrator(), make_integrator()),
}


@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.parametrize("form", ["State", "checkpoint"])
def test_what_other_integrators_have_written_loads(water: TestSystem, name: str, form: str) -> None:
    """Positions, velocities and time are taken, the settings stay, and the run starts afresh."""
    # QTB and NoseHoover want every force in it, MTS wants group 0: so do rigid waters.
    context = open_test_context(water, OTHERS[name]())
    context.setVelocitiesToTemperature(300, 1)
    context.getIntegrator().step(5)
    integrator = make_integrator()
    integrator.setMaximumStepSize(0.0031)
    loaded = open_test_context(water, integrator)
    integrator.step(3)
    reference = integrator.getReferenceMonitorValue()
    if form == "State":
        state = context.getState(positions=True, velocities=True, parameters=True, integratorParameters=True)
        loaded.setState(openmm.XmlSerializer.deserialize(openmm.XmlSerializer.serialize(state)))
    else:
        loaded.loadCheckpoint(context.createCheckpoint())
    assert np.array_equal(positions_of(loaded), positions_of(context))
    assert np.array_equal(velocities_of(loaded), velocities_of(context))
    assert loaded.getTime() == context.getTime() and loaded.getStepCount() == context.getStepCount()
    assert integrator.getMaximumStepSize()._value == 0.0031
    fresh = make_integrator()
    fresh.setMaximumStepSize(0.0031)
    fresh.setReferenceMonitorValue(reference)
    alone = open_test_context(water, fresh)
    alone.setPositions(positions_of(context))
    alone.setVelocities(velocities_of(context))
    fresh.step(10)
    integrator.step(10)
    assert np.max(np.abs(positions_of(loaded) - positions_of(alone))) < 1e-12


# Reinitialization


@pytest.mark.parametrize("update", UPDATES.values(), ids=UPDATES)
def test_reinitialize_that_keeps_the_state(update: int, molecule: TestSystem) -> None:
    integrator, undisturbed = make_integrator(update), make_integrator(update)
    context, reference = (open_test_context(molecule, i) for i in (integrator, undisturbed))
    for i in (integrator, undisturbed):
        i.step(50)
    context.reinitialize(preserveState=True)
    assert integrator.getStepSize() == undisturbed.getStepSize()
    assert integrator.getReferenceMonitorValue() == undisturbed.getReferenceMonitorValue()
    assert np.array_equal(trace(context, integrator, 500), trace(reference, undisturbed, 500))


def test_reinitialize_with_changed_forces(molecule: TestSystem) -> None:
    """What reinitialize() is for: the forces of before must not act any more."""
    test = copy.deepcopy(molecule)
    integrator = make_integrator()
    context = open_test_context(test, integrator)
    integrator.step(50)
    force = openmm.CustomExternalForce("300*x^2")
    for i in range(test.system.getNumParticles()):
        force.addParticle(i)
    test.system.addForce(force)
    positions, velocities = positions_of(context), velocities_of(context)
    context.reinitialize(preserveState=True)
    assert context.getStepCount() == 50
    assert np.array_equal(positions_of(context), positions)
    fresh = make_integrator(referenceMonitorValue=integrator.getReferenceMonitorValue())
    reference = open_test_context(test, fresh, with_state=False)
    reference.setPositions(positions)
    reference.setVelocities(velocities)
    for i in (integrator, fresh):
        i.step(20)
    assert np.max(np.abs(positions_of(context) - positions_of(reference))) < 1e-12


def test_reinitialize_that_forgets_the_state(molecule: TestSystem) -> None:
    integrator, fresh = make_integrator(), make_integrator()
    context, reference = (open_test_context(molecule, i) for i in (integrator, fresh))
    integrator.step(20)
    context.reinitialize()
    assert time_of(context) == 0 and context.getStepCount() == 0
    assert integrator.getStepSize()._value == STEP
    assert integrator.getStepDensity() == 1
    assert integrator.getReferenceMonitorValue() == 0
    assert integrator.getNumForceEvaluations() == 0
    with pytest.raises(openmm.OpenMMException, match="positions"):
        integrator.step(1)
    context.setPositions(molecule.positions)
    context.setVelocities(molecule.velocities)
    for i in (integrator, fresh):
        i.step(20)
    assert np.array_equal(positions_of(context), positions_of(reference))


# What cannot be integrated


def test_drude_particles_are_refused(platform: str) -> None:
    system = openmm.System()
    for mass in (15.6, 0.4):
        system.addParticle(mass)
    drude = openmm.DrudeForce()
    drude.addParticle(1, 0, -1, -1, -1, -1.0, 0.001, 1, 1)
    system.addForce(drude)
    with pytest.raises(openmm.OpenMMException, match="DrudeForce.*DrudeSCFIntegrator") as refusal:
        openmm.Context(system, make_integrator(monitors=[]), openmm.Platform.getPlatform(platform))
    assert "\n" not in str(refusal.value)
    system.removeForce(0)
    openmm.Context(system, make_integrator(monitors=[]), openmm.Platform.getPlatform(platform))
