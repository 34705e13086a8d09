# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The page for those who come from another integrator (docs/migration.md): does it name what there is?"""

from __future__ import annotations

import re

import openmm
import openmmvrattle
import pytest
from openmm import app, unit
from openmmvrattle import (
    VariableStepRattleIntegrator,
    VariableStepRattleLangevinIntegrator,
    constraints,
    reporters,
)
from openmmvrattle.testsystems import rigid_waters
from project_scripts import ROOT

PAGE = ROOT / "docs" / "migration.md"
pytestmark = pytest.mark.skipif(not PAGE.exists(), reason="needs the folder docs")
OURS = (VariableStepRattleIntegrator, VariableStepRattleLangevinIntegrator)


def rows(heading: str) -> list[tuple[str, str]]:
    """The rows of the table under a heading."""
    text = PAGE.read_text(encoding="utf-8")
    section = re.search(rf"^## {heading}\b[^\n]*$(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL)
    found = re.findall(r"^\| (.*?) \| (.*) \|$", section[1], re.MULTILINE)
    return [row for row in found if row[0] != "before"]


HEADINGS = ("VerletIntegrator", "VariableVerletIntegrator", "LangevinMiddleIntegrator", "LAMMPS", "GROMACS")


@pytest.mark.parametrize("heading", HEADINGS)
def test_what_the_page_names_is_there(heading: str) -> None:
    table = rows(heading)
    assert len(table) >= 4
    places = (openmmvrattle, *OURS, reporters, constraints, openmm, app, openmm.System, app.ForceField)
    for before, now in table:
        for name in re.findall(r"`(?:\w+\.)?(\w+)\(", now):
            assert any(hasattr(place, name) for place in places), name
        if heading in ("VerletIntegrator", "VariableVerletIntegrator", "LangevinMiddleIntegrator"):
            for name in re.findall(r"`(\w+)\(", before):
                assert hasattr(openmm, name) or hasattr(getattr(openmm, heading), name), name


def test_tolerances_are_as_the_page_has_them() -> None:
    assert openmm.VerletIntegrator(0.001).getConstraintTolerance() == 1e-5
    assert VariableStepRattleIntegrator(0.001).getConstraintTolerance() == 1e-8
    assert any("1e-5 by default" in before and "1e-8 by default" in now for before, now in rows("VerletIntegrator"))


def test_where_the_page_says_the_same_it_is_the_same() -> None:
    """Methods that take and return the same, the size of the step, and the state of the integrator that was before."""
    water = rigid_waters(4)
    platform = openmm.Platform.getPlatform("Reference")
    before = openmm.Context(water.system, openmm.LangevinMiddleIntegrator(300, 1, 0.001), platform)
    before.setPositions(water.positions)
    before.setVelocities(water.velocities)
    before.getIntegrator().step(5)
    state = before.getState(positions=True, velocities=True, parameters=True)
    checkpoint = before.createCheckpoint()

    integrator = VariableStepRattleIntegrator(0.001, automatic=True)
    now = openmm.Context(water.system, integrator, platform)
    now.setState(state)
    now.loadCheckpoint(checkpoint)
    assert now.getTime() == before.getTime()
    there = now.getState(positions=True).getPositions(asNumpy=True)
    assert (there == state.getPositions(asNumpy=True)).all()
    integrator.stepTo(0.02)
    assert now.getTime() == 0.02 * unit.picoseconds
    assert integrator.getNominalStepSize() == 0.001 * unit.picoseconds
    assert integrator.getStepSize() <= 4 / 3 * integrator.getNominalStepSize()

    theirs = openmm.LangevinMiddleIntegrator(300, 1, 0.004)
    ours = VariableStepRattleLangevinIntegrator(300, 1, 0.004)
    for integrator in (theirs, ours):
        integrator.setTemperature(310)
        integrator.setFriction(2)
        integrator.setRandomNumberSeed(5)
        integrator.setStepSize(0.002)
    for name in ("getTemperature", "getFriction", "getRandomNumberSeed", "getStepSize"):
        assert getattr(theirs, name)() == getattr(ours, name)()
    context = openmm.Context(water.system, ours, platform)
    context.setPositions(water.positions)
    ours.step(3)
    assert context.getTime().value_in_unit(unit.picosecond) == pytest.approx(3 * 0.002, rel=1e-12)
