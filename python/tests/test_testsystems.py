# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The systems start where their descriptions say, and on their constraints."""

import dataclasses
import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import openmm
import pytest
from openmm import app
from openmmvrattle import VariableStepRattleIntegrator, testsystems
from openmmvrattle.compare.comparison import make_integrator
from openmmvrattle.testsystems import SYSTEMS

WITHOUT_CONSTRAINTS = {"argon-cluster", "flexible-waters", "ion-pair"}


@pytest.fixture(scope="module", params=sorted(SYSTEMS))
def built(request):
    return request.param, SYSTEMS[request.param]()


def masses_of(system):
    return np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])


def potential_energy(test_system):
    platform = openmm.Platform.getPlatformByName("Reference")
    context = openmm.Context(test_system.system, openmm.VerletIntegrator(0.001), platform)
    context.setPositions(test_system.positions)
    return context.getState(getEnergy=True, groups=test_system.force_groups).getPotentialEnergy()._value


def kinetic_energy(test_system):
    return 0.5 * np.sum(masses_of(test_system.system)[:, None] * test_system.velocities**2)


def test_start_meets_the_constraints(built):
    _, test_system = built
    system = test_system.system
    assert (system.getNumConstraints() > 0) != (test_system.name in WITHOUT_CONSTRAINTS)
    for index in range(system.getNumConstraints()):
        first, second, distance = system.getConstraintParameters(index)
        separation = test_system.positions[first] - test_system.positions[second]
        assert np.linalg.norm(separation) == pytest.approx(distance._value, rel=1e-12)
        relative_velocity = test_system.velocities[first] - test_system.velocities[second]
        assert abs(separation @ relative_velocity) < 1e-13


def test_a_system_is_whole(built):
    """Its name is that of the registry, all of it has the same particles, and its settings name things that exist."""
    name, test_system = built
    assert test_system.name == name
    particles = test_system.system.getNumParticles()
    assert test_system.topology.getNumAtoms() == particles
    for vectors in (test_system.positions, test_system.velocities):
        assert vectors.shape == (particles, 3)
        assert np.all(np.isfinite(vectors))
    settings = test_system.settings
    assert settings.total_time > 0
    assert settings.force_evaluations > 0
    for control in settings.controls:
        assert hasattr(VariableStepRattleIntegrator, control.update_method)
        assert 0 <= control.smallest_step_ratio < 1
        assert control.largest_step_ratio == 0 or control.largest_step_ratio > 1
        for monitor in control.monitors:
            assert hasattr(VariableStepRattleIntegrator, monitor.kind)


def test_systems_cannot_be_changed_by_accident():
    with pytest.raises(dataclasses.FrozenInstanceError):
        testsystems.double_pendulum().name = "other"


def test_pendulum_energy():
    pendulum = testsystems.double_pendulum()
    assert kinetic_energy(pendulum) == 0.0
    assert potential_energy(pendulum) == pytest.approx(-288.493, abs=1e-3)


def test_pendulum_pivot_feels_no_gravity():
    pendulum = testsystems.double_pendulum()
    context = openmm.Context(
        pendulum.system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatformByName("Reference")
    )
    context.setPositions(pendulum.positions)
    forces = context.getState(getForces=True).getForces(asNumpy=True)._value
    np.testing.assert_array_equal(forces, [[0, 0, 0], [0, -1, 0], [0, -1000, 0]])


def test_chain_energy_is_kinetic():
    chain = testsystems.light_heavy_chain()
    assert kinetic_energy(chain) == pytest.approx(2.4756, abs=1e-4)
    assert potential_energy(chain) == 0.0


def test_repulsion_acts_at_short_range_only():
    chain = testsystems.light_heavy_chain(repulsion=True)
    assert potential_energy(chain) == 0.0
    contact = 2 ** (1 / 6) * 0.16
    energies = []
    for distance in (0.16, 0.5 * (0.16 + contact), contact - 1e-6, contact + 1e-6):
        places = np.array([[0.0, 0.0, 0.0], [0.0, 0.1, 0.0], [distance, 0.0, 0.0]])
        energies.append(potential_energy(dataclasses.replace(chain, positions=places)))
    assert energies[0] == pytest.approx(1.0, rel=1e-9)
    assert energies[0] > energies[1] > energies[2] >= 0.0 == energies[3]
    assert energies[2] < 1e-6


def test_water_clash_has_one_overlap():
    clash = testsystems.water_clash()
    oxygens = clash.positions[::3]
    distances = sorted(np.linalg.norm(oxygens[i] - oxygens[j]) for i in range(len(oxygens)) for j in range(i))
    assert len(oxygens) == 8
    assert distances[0] == pytest.approx(0.5 * 0.315061, rel=1e-6)
    assert distances[1] > 0.22
    assert potential_energy(clash) > 5000.0


def test_water_clash_has_the_forces_of_the_water_model():
    """Apart from the overlap it is the model that rigid_waters takes from OpenMM's force field."""
    clash, waters = testsystems.water_clash(), testsystems.rigid_waters(8)
    assert masses_of(clash.system) == pytest.approx(masses_of(waters.system), rel=1e-4)
    spread = dataclasses.replace(clash, positions=waters.positions)
    assert potential_energy(spread) == pytest.approx(potential_energy(waters), rel=1e-3)


@pytest.mark.parametrize("speed", [5.0, 20.0])
def test_nitrogen_molecules_meet(speed):
    collision = testsystems.nitrogen_collision(speed)
    assert kinetic_energy(collision) == pytest.approx(0.5 * 4 * 14.007 * (0.5 * speed) ** 2)
    assert abs(potential_energy(collision)) < 0.1
    nearest, _ = nearest_approach(collision, lambda places: np.linalg.norm(places[:2].mean(0) - places[2:].mean(0)))
    assert nearest < 0.4


def test_molecule_comes_back_from_the_wall():
    flight = testsystems.diatomic_on_wall()
    nearest, places = nearest_approach(flight, lambda places: places[:, 0].min())
    assert 0.1 < nearest < 0.3
    assert places[:, 0].min() > 0.3


def nearest_approach(test_system, distance):
    """The smallest distance along a run with the recommended settings, and the positions at its end."""
    settings = test_system.settings
    integrator = make_integrator(settings.controls[0], 0.2 * settings.total_time / settings.force_evaluations)
    context = openmm.Context(test_system.system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(test_system.positions)
    context.setVelocities(test_system.velocities)
    nearest = math.inf
    while context.getTime()._value < settings.total_time:
        integrator.step(1)
        places = context.getState(getPositions=True).getPositions(asNumpy=True)._value
        nearest = min(nearest, distance(places))
    return nearest, places


def test_hot_alanine_dipeptide_is_hot():
    molecule = SYSTEMS["alanine-dipeptide-hbonds-1000-kelvin"]()
    assert 600 < 2 * kinetic_energy(molecule) / ((3 * 22 - 12) * 8.31446e-3) < 1400


@pytest.mark.parametrize(("constraints", "number"), [(app.HBonds, 12), (app.AllBonds, 21)])
def test_alanine_dipeptide_constraints(constraints, number):
    molecule = testsystems.alanine_dipeptide(constraints)
    assert molecule.topology.getNumAtoms() == 22
    assert molecule.topology.getNumBonds() == 21
    assert molecule.system.getNumConstraints() == number
    degrees = 3 * 22 - number
    temperature = 2 * kinetic_energy(molecule) / (degrees * 8.31446e-3)
    assert 150 < temperature < 450


def test_alanine_dipeptide_is_the_natural_form():
    """Seen along the bond from CA to HA, C, CB and N go round clockwise in the L form."""
    molecule = testsystems.alanine_dipeptide()
    places = {(atom.residue.name, atom.name): molecule.positions[atom.index] for atom in molecule.topology.atoms()}
    nitrogen, carbonyl, side = (places["ALA", name] - places["ALA", "CA"] for name in ("N", "C", "CB"))
    assert np.cross(nitrogen, carbonyl) @ side > 0


def test_same_seed_gives_the_same_start():
    first, second, other = (testsystems.alanine_dipeptide(seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.velocities, second.velocities)
    assert not np.allclose(first.velocities, other.velocities)


def test_alanine_dipeptide_wants_constraints():
    with pytest.raises(ValueError, match="HBonds or"):
        testsystems.alanine_dipeptide(constraints=None)


@pytest.mark.parametrize("number", [1, 3])
def test_number_of_waters(number):
    waters = testsystems.rigid_waters(number)
    assert waters.system.getNumParticles() == 3 * number
    assert waters.system.getNumConstraints() == 3 * number


@pytest.mark.parametrize("number", [0, 10**6])
def test_impossible_number_of_waters(number):
    with pytest.raises(ValueError, match="number of water molecules"):
        testsystems.rigid_waters(number)


def test_projection_meets_constraints_that_are_strongly_coupled():
    chain = testsystems.light_heavy_chain()
    bent = chain.positions + 1e-3 * np.array([[1.0, -2.0, 0.5], [0.3, 1.0, -1.0], [-1.0, 0.2, 2.0]])
    positions, velocities = testsystems.project_onto_constraints(chain.system, bent, chain.velocities)
    assert testsystems.constraint_error(chain.system, bent) > 1e-4
    assert testsystems.constraint_error(chain.system, positions) < 1e-12
    for first, second in ((0, 1), (1, 2)):
        assert abs((positions[first] - positions[second]) @ (velocities[first] - velocities[second])) < 1e-13


def test_projection_keeps_the_momentum():
    chain = testsystems.light_heavy_chain()
    masses = masses_of(chain.system)[:, None]
    wild = np.array([[1.0, 2.0, 3.0], [-4.0, 5.0, 6.0], [7.0, 8.0, -9.0]])
    _, velocities = testsystems.project_onto_constraints(chain.system, chain.positions, wild)
    np.testing.assert_allclose((masses * velocities).sum(axis=0), (masses * wild).sum(axis=0), rtol=1e-12)


def test_projection_from_far_away_is_refused():
    chain = testsystems.light_heavy_chain()
    with pytest.raises((ValueError, np.linalg.LinAlgError)):
        testsystems.project_onto_constraints(chain.system, np.zeros((3, 3)), chain.velocities)


def test_without_constraints_nothing_is_moved():
    system = openmm.System()
    system.addParticle(1.0)
    place, velocity = np.array([[1.0, 2.0, 3.0]]), np.array([[4.0, 5.0, 6.0]])
    positions, velocities = testsystems.project_onto_constraints(system, place, velocity)
    np.testing.assert_array_equal(positions, place)
    np.testing.assert_array_equal(velocities, velocity)
    assert testsystems.constraint_error(system, place) == 0.0


EXAMPLE = Path(__file__).parents[2] / "examples" / "quick_start.py"
README = Path(__file__).parents[2] / "README.md"


@pytest.mark.skipif(not EXAMPLE.exists(), reason="needs the folder examples")
def test_quick_start_keeps_the_energy():
    result = subprocess.run([sys.executable, str(EXAMPLE)], capture_output=True, text=True, timeout=600)
    assert result.returncode == 0, result.stderr
    energies = [float(line.split("energy")[1].split()[0]) for line in result.stdout.splitlines()]
    assert len(energies) == 20
    np.testing.assert_allclose(energies, -288.493, atol=0.01)


@pytest.mark.skipif(not README.exists(), reason="needs the file README.md")
def test_readme_shows_what_runs():
    """The block to begin with does what it says; that all of them run is tested with the documentation."""
    block = re.search(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)[1]
    names: dict = {}
    exec(block, names)
    assert names["integrator"].isAutomatic()
    assert names["integrator"].getNominalStepSize()._value == 0.001
