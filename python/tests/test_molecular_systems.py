# OpenMM-VRATTLE: the kinds of systems that people simulate: boxes, virtual sites, fixed particles, all kinds of forces.
# SPDX-License-Identifier: MIT

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import openmm
import pytest
from dense_reference import UPDATES, Array, chain, energy_of, open_context, positions_of, value, velocities_of
from openmm import app, unit
from openmmvrattle import testsystems
from run_support import (
    FORCE_MONITOR,
    degrees_of_freedom,
    fastest_platform,
    largest_energy_error,
    make_integrator,
    relax,
    smooth_cutoff,
    solvated,
    with_update,
)

THERMAL = 0.00831446261815324 * 300  # kT at 300 K


def assert_conserves(
    system: openmm.System, positions: Any, velocities: Any, platform: str, steps: int, step: float = 0.001
) -> None:
    """Energy conserved as by plain RATTLE with steps of the same size, and well below its thermal fluctuations."""
    errors = []
    for variable in (True, False):
        integrator = make_integrator(step, FORCE_MONITOR)
        if not variable:
            integrator.clearMonitors()
        context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform))
        context.setPositions(positions)
        context.applyConstraints(1e-9)
        context.setVelocities(velocities)
        context.applyVelocityConstraints(1e-9)
        errors.append(largest_energy_error(context, integrator, steps))
        assert integrator.getNumForceEvaluations() == steps + 1
        assert np.max(np.abs(positions_of(context) - positions)) > 0.005
        del context
    kinetic = degrees_of_freedom(system) * THERMAL / 2
    print(f"{platform}: energy error {errors[0] / kinetic:.1e}, with fixed steps {errors[1] / kinetic:.1e}")
    # The kinetic energy of N freedoms fluctuates by sqrt(2/N), 0.05 to 0.2 here; a force that is missing, stale or
    # not a gradient shows as more than 0.01 within these runs.
    assert errors[0] < 0.005 * kinetic
    # Variable steps are not for thermal liquids, but do no harm.
    assert errors[0] < 2.5 * errors[1] + 1e-4 * kinetic


@pytest.mark.parametrize("shape", ["sheared", "octahedron", "dodecahedron"])
@pytest.mark.parametrize("method", [app.CutoffPeriodic, app.PME])
def test_triclinic_box(method: Any, shape: str, platform: str) -> None:
    if platform == "Reference" and shape != "sheared":
        # OpenMM 8.6.1's own energies of boxes of this shape that are so small differ between Reference and CPU.
        pytest.skip("platform Reference has other energies for small boxes of this shape")
    modeller, force_field = solvated(count=60, shape="cube" if shape == "sheared" else shape)
    if shape == "sheared":
        modeller.topology.setPeriodicBoxVectors([[1.5, 0, 0], [0.5, 1.5, 0], [-0.5, 0.5, 1.5]] * unit.nanometer)
    system = smooth_cutoff(
        force_field.createSystem(
            modeller.topology,
            nonbondedMethod=method,
            nonbondedCutoff=0.5,
            removeCMMotion=False,
            ewaldErrorTolerance=1e-4,
        ),
        0.4,
    )
    assert abs(system.getDefaultPeriodicBoxVectors()[2][1]._value) > 0.3
    positions, velocities = relax(system, modeller.positions, steps=100)
    assert_conserves(system, positions, velocities, platform, 25 if platform == "Reference" else 60)


def test_four_site_water(platform: str) -> None:
    """TIP4P-Ew with PME: the charge of oxygen on a virtual site."""
    modeller, force_field = solvated("tip4pew", 60)
    system = smooth_cutoff(
        force_field.createSystem(
            modeller.topology,
            nonbondedMethod=app.PME,
            nonbondedCutoff=0.5,
            removeCMMotion=False,
            ewaldErrorTolerance=1e-4,
        ),
        0.4,
    )
    assert sum(system.isVirtualSite(i) for i in range(system.getNumParticles())) == 60
    positions, velocities = relax(system, modeller.positions, steps=100)
    assert_conserves(system, positions, velocities, platform, 25 if platform == "Reference" else 60)


def two_particle_average(i: int) -> openmm.VirtualSite:
    return openmm.TwoParticleAverageSite(i, i + 1, 0.3, 0.7)


def three_particle_average(i: int) -> openmm.VirtualSite:
    return openmm.ThreeParticleAverageSite(i, i + 1, i + 2, 0.786, 0.107, 0.107)


def out_of_plane(i: int) -> openmm.VirtualSite:
    return openmm.OutOfPlaneSite(i, i + 1, i + 2, 0.2, 0.3, 5.0)


def local_coordinates(i: int) -> openmm.VirtualSite:
    return openmm.LocalCoordinatesSite(
        [i, i + 1, i + 2], [0.5, 0.25, 0.25], [-1.0, 0.5, 0.5], [0.0, -1.0, 1.0], openmm.Vec3(0.03, 0.01, -0.04)
    )


SITES: list[Callable[[int], openmm.VirtualSite]] = [
    two_particle_average,
    three_particle_average,
    out_of_plane,
    local_coordinates,
]


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("make_site", SITES)
def test_virtual_sites(make_site: Callable[[int], openmm.VirtualSite], update: str, platform: str) -> None:
    """Three rigid molecules whose charges are on virtual sites: sites are where they belong, and their forces act."""
    model_positions = np.array([[0, 0, 0], [0.09572, 0, 0], [-0.0239987, 0.0926627, 0]])
    lengths = [float(np.linalg.norm(model_positions[i] - model_positions[j])) for i, j in ((0, 1), (0, 2), (1, 2))]
    system = openmm.System()
    force = openmm.NonbondedForce()
    positions, sites = [], []
    for molecule in range(3):
        first = system.getNumParticles()
        for mass in (15.9994, 1.008, 1.008):
            system.addParticle(mass)
            force.addParticle(0.3, 0.25, 0.5)
        for (i, j), length in zip(((0, 1), (0, 2), (1, 2)), lengths, strict=True):
            system.addConstraint(first + i, first + j, length)
        site = system.addParticle(0.0)
        sites.append(site)
        force.addParticle(-0.9, 1.0, 0.0)
        system.setVirtualSite(site, make_site(first))
        for i in range(first, first + 4):
            for j in range(i + 1, first + 4):
                force.addException(i, j, 0, 1, 0)
        positions += [*(model_positions + 0.3 * np.eye(3)[molecule]), np.zeros(3)]
    system.addForce(force)
    field = openmm.CustomExternalForce("150*x-80*z")
    field.addParticle(sites[0], [])
    system.addForce(field)
    integrator = with_update(make_integrator(0.0005, FORCE_MONITOR), update)
    context = open_context(system, integrator, platform)
    context.setPositions(positions)
    context.computeVirtualSites()
    context.setVelocitiesToTemperature(300, 4)
    checker = open_context(system, openmm.VerletIntegrator(0.001), "Reference")
    start = energy_of(context)
    kinetic = value(context.getState(energy=True).getKineticEnergy())
    worst, other = 0.0, with_update(make_integrator(0.0005, FORCE_MONITOR), update)
    for _ in range(150):
        integrator.step(1)
        q = positions_of(context)
        checker.setPositions(q)
        checker.computeVirtualSites()
        # The same computation from the same numbers, at most in another order.
        np.testing.assert_allclose(positions_of(checker), q, rtol=0, atol=1e-13)
        worst = max(worst, abs(energy_of(context) - start))
    print(f"{make_site.__name__} {update}: energy error {worst:.1e} of a kinetic energy of {kinetic:.1f} kJ/mol")
    assert worst < 0.01 * kinetic
    assert testsystems.constraint_error(system, positions_of(context)) <= 1e-8
    assert np.max(np.abs(velocities_of(context)[sites])) == 0
    # The field acts on a site alone: without it the molecule is elsewhere.
    system.removeForce(1)
    free = open_context(system, other, platform)
    free.setPositions(positions)
    free.computeVirtualSites()
    free.setVelocitiesToTemperature(300, 4)
    other.stepTo(context.getTime())
    assert np.max(np.abs(positions_of(free)[:3] - positions_of(context)[:3])) > 1e-3


@pytest.mark.skipif(not hasattr(openmm, "SymmetrySite"), reason="this OpenMM has no SymmetrySite")
def test_symmetry_site(platform: str) -> None:
    """A molecule and its image by a screw axis of the periodic box."""
    system = openmm.System()
    box = 2.0
    system.setDefaultPeriodicBoxVectors((box, 0, 0), (0, box, 0), (0, 0, box))
    force = openmm.CustomNonbondedForce("20*exp(-(r/0.3)^2)")
    force.setNonbondedMethod(openmm.CustomNonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(0.99)
    positions = [[0.3, 0.35, 0.4], [0.45, 0.35, 0.4]]
    for mass in (12.0, 16.0):
        system.addParticle(mass)
        force.addParticle([])
    system.addConstraint(0, 1, 0.15)
    for i in range(2):
        site = system.addParticle(0.0)
        force.addParticle([])
        # x, -y + 1/2, z + 1/4 in fractions of the box.
        system.setVirtualSite(
            site,
            openmm.SymmetrySite(
                i, openmm.Vec3(1, 0, 0), openmm.Vec3(0, -1, 0), openmm.Vec3(0, 0, 1), openmm.Vec3(0, 0.5, 0.25), True
            ),
        )
        positions.append([0, 0, 0])
    force.addExclusion(0, 1)
    force.addExclusion(2, 3)
    system.addForce(force)
    integrator = make_integrator(0.0005, FORCE_MONITOR)
    context = open_context(system, integrator, platform)
    context.setPositions(positions)
    context.computeVirtualSites()
    context.setVelocitiesToTemperature(300, 4)
    start = energy_of(context)
    for _ in range(200):
        integrator.step(1)
        q = positions_of(context)
        for i in range(2):
            image = np.array([q[i, 0], 0.5 * box - q[i, 1], q[i, 2] + 0.25 * box])
            np.testing.assert_allclose(q[2 + i], image, rtol=0, atol=1e-12)
        # Of 5 freedoms' kinetic energy of 6 kJ/mol; CPU: forces of single precision.
        assert abs(energy_of(context) - start) < 2e-3
    assert np.max(np.abs(q[:2] - np.array(positions[:2]))) > 0.02


def test_fixed_particles_and_constraints(platform: str) -> None:
    """A massless particle is fixed; a constraint to one is refused as by OpenMM, one between two is no constraint."""

    def create_system(masses: list[float]) -> openmm.System:
        system = openmm.System()
        for mass in masses:
            system.addParticle(mass)
        system.addConstraint(0, 1, 0.2)
        system.addConstraint(2, 3, 0.2)
        bond = openmm.HarmonicBondForce()
        bond.addBond(1, 2, 0.3, 1000.0)
        system.addForce(bond)
        return system

    chosen = openmm.Platform.getPlatformByName(platform)
    messages = []
    for integrator in (make_integrator(), openmm.VerletIntegrator(0.001)):
        with pytest.raises(openmm.OpenMMException, match="massless") as caught:
            openmm.Context(create_system([0.0, 12.0, 12.0, 12.0]), integrator, chosen)
        messages.append(str(caught.value))
    assert messages[0] == messages[1]

    integrator = make_integrator(0.001, FORCE_MONITOR)
    context = open_context(create_system([0.0, 0.0, 12.0, 12.0]), integrator, platform)
    # The distance of the fixed ones is none of ours.
    context.setPositions([[0, 0, 0], [0.27, 0, 0], [0.6, 0.05, 0], [0.6, 0.25, 0]])
    context.setVelocitiesToTemperature(300, 4)
    start = energy_of(context)
    for _ in range(100):
        integrator.step(1)
        assert np.array_equal(positions_of(context)[:2], [[0, 0, 0], [0.27, 0, 0]])
        assert np.array_equal(velocities_of(context)[:2], np.zeros((2, 3)))
        multipliers = [value(x) for x in integrator.getMultipliers()]
        assert multipliers[0] == 0
        assert multipliers[1] != 0
        # Of a kinetic energy of 6 kJ/mol, with 1 fs for a vibration of 20 ps.
        assert abs(energy_of(context) - start) < 0.02
    assert abs(np.linalg.norm(np.subtract(*positions_of(context)[2:])) - 0.2) <= 0.2e-8


def test_nothing_moves(platform: str) -> None:
    """All particles fixed, with and without a constraint between them."""
    for constrained in (True, False):
        system = openmm.System()
        system.addParticle(0.0)
        system.addParticle(0.0)
        if constrained:
            system.addConstraint(0, 1, 1.5)
        integrator = make_integrator(0.01)
        integrator.clearMonitors()
        context = open_context(system, integrator, platform)
        context.setPositions([[-1, 0, 0], [1, 0, 0]])
        context.setVelocitiesToTemperature(300, 1)
        integrator.step(3)
        assert np.array_equal(positions_of(context), [[-1, 0, 0], [1, 0, 0]])
        assert np.array_equal(velocities_of(context), np.zeros((2, 3)))
        assert value(context.getTime()) == pytest.approx(0.03, rel=1e-14)
        del context


@pytest.fixture(scope="module")
def dipeptide() -> tuple[app.Topology, Array]:
    example = testsystems.alanine_dipeptide()
    return example.topology, example.positions


def test_generalised_born(dipeptide: tuple[app.Topology, Array], platform: str) -> None:
    topology, positions = dipeptide
    force_field = app.ForceField("amber14-all.xml", "implicit/obc2.xml")
    system = force_field.createSystem(
        topology, nonbondedMethod=app.NoCutoff, constraints=app.HBonds, removeCMMotion=False
    )
    assert any(isinstance(force, (openmm.GBSAOBCForce, openmm.CustomGBForce)) for force in system.getForces())
    assert_conserves(system, *relax(system, positions), platform, 200, 0.0005)


def test_correction_map(dipeptide: tuple[app.Topology, Array], platform: str) -> None:
    """ff19SB's CMAP, and one of our own that is strong enough to matter."""
    topology, positions = dipeptide
    system = app.ForceField("amber19/protein.ff19SB.xml").createSystem(
        topology, nonbondedMethod=app.NoCutoff, constraints=app.HBonds, removeCMMotion=False
    )
    maps = [force for force in system.getForces() if isinstance(force, openmm.CMAPTorsionForce)]
    assert len(maps) == 1 and maps[0].getNumTorsions() == 1
    angle = 2 * np.pi * np.arange(24) / 24
    surface = 20 * np.sin(angle[:, None] + 0.5) * np.cos(angle[None, :] - 1.1)
    mine = openmm.CMAPTorsionForce()
    mine.addMap(24, surface.T.ravel().tolist())
    mine.addTorsion(*[0 if k == 0 else x for k, x in enumerate(maps[0].getTorsionParameters(0))])
    system.addForce(mine)
    start, velocities = relax(system, positions)
    assert_conserves(system, start, velocities, platform, 200, 0.0005)
    mine.setForceGroup(9)
    integrator = make_integrator(0.001)
    context = open_context(system, integrator, platform)
    context.setPositions(start)
    forces = context.getState(forces=True, groups={9}).getForces(asNumpy=True)._value
    assert np.max(np.abs(forces)) > 10


def test_custom_nonbonded_force(platform: str) -> None:
    """Buckingham's repulsion and a screened charge, periodic, between constrained pairs."""
    rng = np.random.default_rng(3)
    system = openmm.System()
    box = 1.8
    system.setDefaultPeriodicBoxVectors((box, 0, 0), (0, box, 0), (0, 0, box))
    force = openmm.CustomNonbondedForce("60000*exp(-r/0.035)-0.002/r^6+40*q1*q2*exp(-r/0.3)/r")
    force.addPerParticleParameter("q")
    force.setNonbondedMethod(openmm.CustomNonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(0.85)
    force.setUseSwitchingFunction(True)
    force.setSwitchingDistance(0.7)
    positions = []
    for site in np.ndindex(4, 4, 4):
        direction = rng.normal(size=3)
        centre = (np.array(site) + 0.5) * box / 4
        for sign, mass in ((1, 14.0), (-1, 16.0)):
            index = system.addParticle(mass)
            force.addParticle([0.3 * sign])
            positions.append(centre + sign * 0.06 * direction / np.linalg.norm(direction))
        system.addConstraint(index - 1, index, 0.12)
        force.addExclusion(index - 1, index)
    system.addForce(force)
    assert_conserves(system, *relax(system, positions), platform, 100)


def test_custom_cv_force(dipeptide: tuple[app.Topology, Array], platform: str) -> None:
    """An umbrella on a function of two collective variables."""
    topology, positions = dipeptide
    system = app.ForceField("amber14-all.xml").createSystem(
        topology, nonbondedMethod=app.NoCutoff, constraints=app.HBonds, removeCMMotion=False
    )
    heavy = [atom.index for atom in topology.atoms() if atom.element != app.element.hydrogen]
    distance = openmm.CustomBondForce("r")
    distance.addBond(heavy[0], heavy[-1], [])
    radius = openmm.CustomExternalForce("0.01*(x*x+y*y+z*z)")
    for index in heavy:
        radius.addParticle(index, [])
    bias = openmm.CustomCVForce("800*(d-0.6)^2+200*w")
    bias.addCollectiveVariable("d", distance)
    bias.addCollectiveVariable("w", radius)
    system.addForce(bias)
    start, velocities = relax(system, positions)
    assert_conserves(system, start, velocities, platform, 200, 0.0005)


def test_custom_cv_force_as_monitor(platform: str) -> None:
    """The monitor ForceGroupEnergy written as a CustomCVForce: it controls the step and does not act."""
    model = chain()
    system = model.system()
    length = openmm.CustomBondForce("r")
    length.addBond(0, 7, [])
    monitor = openmm.CustomCVForce("1+5*d")
    monitor.addCollectiveVariable("d", length)
    monitor.setForceGroup(31)
    system.addForce(monitor)
    integrator = make_integrator(0.0005, "ForceGroupEnergy", setConstraintTolerance=1e-12)
    context = open_context(system, integrator, platform, model)
    start = value(context.getState(energy=True, groups=set(range(31))).getPotentialEnergy())
    kinetic = value(context.getState(energy=True).getKineticEnergy())
    densities = []
    for _ in range(100):
        integrator.step(1)
        state = context.getState(energy=True, groups=set(range(31)))
        # Of 20 kJ/mol; the gradient of the monitor would do 5 kJ/mol/nm times 0.05 nm.
        assert abs(value(state.getKineticEnergy()) + value(state.getPotentialEnergy()) - start - kinetic) < 0.05
        q = positions_of(context)
        densities.append(integrator.getStepDensity())
        assert value(integrator.getMonitorValue()) == pytest.approx(1 + 5 * np.linalg.norm(q[7] - q[0]), rel=1e-6)
    assert max(densities) - min(densities) > 1e-3


def test_particles_without_constraints_beside_constrained_ones() -> None:
    """Ions in water: some particles in clusters, some alone."""
    modeller, force_field = solvated(count=60)
    topology = modeller.topology
    system = smooth_cutoff(
        app.ForceField("amber14/tip3p.xml").createSystem(
            topology, nonbondedMethod=app.PME, nonbondedCutoff=0.5, removeCMMotion=False, ewaldErrorTolerance=1e-4
        ),
        0.4,
    )
    nonbonded = next(force for force in system.getForces() if isinstance(force, openmm.NonbondedForce))
    box = system.getDefaultPeriodicBoxVectors()[0][0]._value
    positions = list(modeller.positions.value_in_unit(unit.nanometer))
    for charge, place in ((1.0, 0.25), (-1.0, 0.75)):
        system.addParticle(23.0)
        nonbonded.addParticle(charge, 0.25, 0.5)
        positions.append(openmm.Vec3(place * box, place * box, place * box))
    start, velocities = relax(system, positions, steps=200)
    assert_conserves(system, start, velocities, fastest_platform(), 60)
