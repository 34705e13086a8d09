# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""A peptide in water as it comes from Modeller, not minimised, straight into dynamics at 300 K with steps of 4 fs.

OpenMM's LangevinMiddleIntegrator ends with "Particle coordinate is NaN", or far too hot; here the first steps are made
of a few substeps each, until the worst contacts have come apart, and from then on a step costs one evaluation of the
forces. This is no minimisation: the heat of the bad start is real, and leaves through the friction.

    python examples/no_minimisation.py [--platform NAME] [--precision NAME]
"""

from __future__ import annotations

import math

import openmm
from openmm import app, unit
from openmmvrattle import VariableStepRattleLangevinIntegrator
from openmmvrattle.platforms import command_line_platform
from openmmvrattle.testsystems import alanine_dipeptide

STEP = 0.004  # ps
STEPS, EVERY = 400, 50


def solvated_peptide() -> tuple[app.Topology, openmm.System, unit.Quantity]:
    """Alanine dipeptide in a box of water with rigid waters and bonds to hydrogen."""
    peptide = alanine_dipeptide()
    force_field = app.ForceField("amber14-all.xml", "amber14/tip3p.xml")
    modeller = app.Modeller(peptide.topology, peptide.positions * unit.nanometer)
    modeller.addSolvent(force_field, padding=0.8 * unit.nanometer)
    system = force_field.createSystem(
        modeller.topology,
        nonbondedMethod=app.PME,
        nonbondedCutoff=0.8 * unit.nanometer,
        constraints=app.HBonds,
        hydrogenMass=1.5 * unit.amu,
    )
    return modeller.topology, system, modeller.positions


def run(integrator: openmm.Integrator) -> None:
    """Print the energy and the temperature along a run."""
    topology, system, positions = solvated_peptide()
    degrees = 3 * system.getNumParticles() - system.getNumConstraints() - 3
    simulation = app.Simulation(topology, system, integrator, *command_line_platform("CPU"))
    simulation.context.setPositions(positions)
    print(f"\n{type(integrator).__name__}, {1000 * STEP:g} fs\n steps  potential energy (kJ/mol)  temperature (K)")
    try:
        for _ in range(STEPS // EVERY):
            simulation.step(EVERY)
            state = simulation.context.getState(energy=True)
            potential = state.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
            temperature = 2 * state.getKineticEnergy() / (degrees * unit.MOLAR_GAS_CONSTANT_R)
            print(f"{simulation.currentStep:6d}  {potential:25.0f}  {temperature.value_in_unit(unit.kelvin):15.0f}")
            if not math.isfinite(potential):
                print("   it has failed: the energy is no number")
                return
    except openmm.OpenMMException as error:
        print(f"   it has failed: {str(error).splitlines()[0]}")
        return
    if isinstance(integrator, VariableStepRattleLangevinIntegrator):
        substepped, largest = integrator.getNumSubstepped(), integrator.getLargestSubsteps()
        evaluations = integrator.getNumForceEvaluations() / STEPS
        print(f"   {substepped} steps were made of substeps, {largest} at most; {evaluations:.2f} evaluations a step")


def main() -> None:
    """The same start with OpenMM's integrator and with ours."""
    run(openmm.LangevinMiddleIntegrator(300 * unit.kelvin, 10 / unit.picosecond, STEP * unit.picoseconds))
    run(
        VariableStepRattleLangevinIntegrator(
            300 * unit.kelvin, 10 / unit.picosecond, STEP * unit.picoseconds, randomNumberSeed=1
        )
    )


if __name__ == "__main__":
    main()
