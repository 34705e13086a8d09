# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Water at constant energy, with reports at equal times: how the energy keeps, and how the steps go.

The density of the steps stays 1, since nothing unusual happens, and the energy comes back to within 0.1 kJ/mol.

python examples/nve_water.py [--platform NAME] [--precision NAME]
"""

import csv

from openmm import app, unit
from openmmvrattle import VariableStepRattleIntegrator
from openmmvrattle.platforms import command_line_platform
from openmmvrattle.reporters import StepSizeReporter, run_for_time
from openmmvrattle.testsystems import rigid_waters

water = rigid_waters(32)  # a droplet of 32 rigid TIP3P molecules at 300 K
# was: integrator = openmm.VerletIntegrator(0.001)
integrator = VariableStepRattleIntegrator(0.001, automatic=True)  # the step in ps
simulation = app.Simulation(water.topology, water.system, integrator, *command_line_platform("CPU"))
simulation.context.setPositions(water.positions)
simulation.context.setVelocities(water.velocities)

# The 1 is a number of steps, of which run_for_time makes no use: it reports every 0.1 ps.
steps = StepSizeReporter("nve_water_steps.csv", 1)
simulation.reporters += [
    steps,
    app.StateDataReporter("nve_water.csv", 1, time=True, totalEnergy=True, temperature=True),
    app.XTCReporter("nve_water.xtc", 1),  # its frames get the times 0.1, 0.2, ... ps
]
run_for_time(simulation, 2 * unit.picosecond, every=0.1 * unit.picosecond)

print("time (ps)  step density  energy error (kJ/mol)  constraint error")
for row in csv.DictReader(open("nve_water_steps.csv", newline="")):
    time, density = float(row["Time (ps)"]), float(row["Step Density"])
    error, constraints = float(row["Energy Error (kJ/mole)"]), float(row["Constraint Error"])
    print(f"{time:9.2f}  {density:12.3f}  {error:21.4f}  {constraints:16.1e}")
