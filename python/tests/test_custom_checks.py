# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""What CustomVariableStepRattleIntegrator refuses before it goes wrong without a word."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from openmmvrattle import CustomVariableStepRattleIntegrator as Custom

NAN = float("nan")
ZIGZAG = np.array([[2.6, 1.5, 1.5], [2.85, 1.66583, 1.5], [3.1, 1.5, 1.5], [3.35, 1.66583, 1.5]])
BOXES = {
    "rectangular": np.diag([3.0, 3.0, 3.0]),
    "skewed": np.array([[3.0, 0, 0], [1.4, 2.9, 0], [-1.45, 1.4, 2.8]]),
}


def chain(count: int = 4, box: np.ndarray | None = None) -> openmm.System:
    system = openmm.System()
    for _ in range(count):
        system.addParticle(20.0)
    for i in range(count - 1):
        system.addConstraint(i, i + 1, 0.3)
    force = openmm.CustomExternalForce("x+y")
    for i in range(count):
        force.addParticle(i)
    system.addForce(force)
    if box is not None:
        system.setDefaultPeriodicBoxVectors(*box)
    return system


def attempt(system: openmm.System, positions: np.ndarray, velocities: np.ndarray | None = None) -> openmm.Context:
    integrator = Custom(0.001, monitors=[])
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(positions)
    if velocities is not None:
        context.setVelocities(velocities)
    integrator.step(1)
    return context


@pytest.mark.parametrize("mass", [-1.00795, NAN])
def test_a_mass_that_is_none(mass: float) -> None:
    system = chain()
    system.setParticleMass(3, mass)
    system.removeConstraint(2)
    with pytest.raises(openmm.OpenMMException, match=f"the mass of particle 3 is {mass:g} amu"):
        attempt(system, ZIGZAG)


@pytest.mark.parametrize("mass", [20.0, 0.0])
def test_a_position_that_is_none(mass: float) -> None:
    system = chain(5)
    system.removeConstraint(3)
    system.setParticleMass(4, mass)
    with pytest.raises(openmm.OpenMMException, match="the position of particle 4 is not a finite number"):
        attempt(system, np.vstack([ZIGZAG, [0, NAN, 0]]))


@pytest.mark.parametrize(("speed", "said"), [(2e7, r"2e\+07 nm/ps, faster than light"), (NAN, "not a finite number")])
def test_velocities_that_no_motion_has(speed: float, said: str) -> None:
    velocities = np.zeros((4, 3))
    velocities[2, 1] = speed
    with pytest.raises(openmm.OpenMMException, match=f"the velocity of particle 2 is {said}"):
        attempt(chain(), ZIGZAG, velocities)
    velocities[2, 1] = 5.0
    attempt(chain(), ZIGZAG, velocities)


@pytest.mark.parametrize("box", BOXES.values(), ids=BOXES)
@pytest.mark.parametrize("shift", [(1, 0, 0), (0, -1, 0), (1, -1, 1), (0, 7, -5)])
def test_a_chain_in_two_boxes(box: np.ndarray, shift: tuple[int, int, int]) -> None:
    system = chain(box=box)
    attempt(system, ZIGZAG + shift @ box)  # whole
    torn = ZIGZAG.copy()
    torn[2:] += shift @ box
    with pytest.raises(
        openmm.OpenMMException, match="particles 1 and 2 is .* nearest periodic image 0.299999 nm.* be whole"
    ):
        attempt(system, torn)


def test_a_long_bond_in_a_skewed_box() -> None:
    """Its nearest image is not within half a box in each direction."""
    system, box = chain(2, BOXES["skewed"]), BOXES["skewed"]
    system.setConstraintParameters(0, 0, 1, 1.45)
    bond = np.array([[0, 0, 0], [0, 0, 1.45]])
    attempt(system, bond)
    bond[1] += box[2] - box[0]
    with pytest.raises(openmm.OpenMMException, match="molecules must be whole"):
        attempt(system, bond)


def test_a_start_far_off_that_no_image_meets() -> None:
    system = chain(2, BOXES["rectangular"])
    context = attempt(system, np.array([[0, 0, 0], [1.75, 0, 0]]))
    x = context.getState(positions=True).getPositions(asNumpy=True)._value
    assert np.linalg.norm(x[0] - x[1]) == pytest.approx(0.3, rel=1e-6)
