# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""An OpenMM script whose VerletIntegrator was swapped for ours: what changes is marked with "was" and "new".

It prints how far 2,000 steps went, 2 ps, since nothing unusual happens; the energies in swap_verlet.csv stay within
1 kJ/mol, as those of VerletIntegrator do.

python examples/swap_verlet.py [--platform NAME] [--precision NAME]
"""

from openmm import app, unit
from openmmvrattle import VariableStepRattleIntegrator  # new
from openmmvrattle.platforms import command_line_platform
from openmmvrattle.testsystems import alanine_dipeptide

# In a script of your own these three come from app.PDBFile and ForceField.createSystem(..., constraints=app.HBonds).
molecule = alanine_dipeptide()
topology, system, positions = molecule.topology, molecule.system, molecule.positions

# was: integrator = openmm.VerletIntegrator(0.001)
integrator = VariableStepRattleIntegrator(0.001, automatic=True)  # the step in ps

simulation = app.Simulation(topology, system, integrator, *command_line_platform("CPU"))
simulation.context.setPositions(positions)
simulation.context.setVelocitiesToTemperature(300 * unit.kelvin, 1)
simulation.reporters.append(
    app.StateDataReporter("swap_verlet.csv", 100, step=True, time=True, totalEnergy=True, temperature=True)
)
simulation.step(2000)

print(f"{simulation.currentStep} steps, {simulation.context.getTime().value_in_unit(unit.picosecond):.4f} ps")  # new
print("The energies are in swap_verlet.csv.")
