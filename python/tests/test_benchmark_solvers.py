# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The comparison of solvers for the constraints: its equations, its methods, and what it puts into a page."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from openmmvrattle.testsystems import light_heavy_chain
from project_scripts import ROOT, load_script

pytestmark = pytest.mark.skipif(not (ROOT / "benchmarks").exists(), reason="needs the folder benchmarks")


@pytest.fixture(scope="module")
def solvers() -> ModuleType:
    return load_script("benchmarks/solvers.py")


def test_the_matrix_is_the_derivative(solvers: ModuleType) -> None:
    step, _ = solvers.steps_of(light_heavy_chain(), 0.00125, 1, 100)[0]
    nu = step.start + 1e-4
    matrix = step.matrix(step.positions(nu))
    for k in range(len(nu)):
        change = np.zeros(len(nu))
        change[k] = 1e-5 * (1 + abs(nu[k]))
        later, earlier = step.errors(step.positions(nu + change)), step.errors(step.positions(nu - change))
        np.testing.assert_allclose((earlier - later) / (2 * change[k]), matrix[:, k], rtol=1e-5, atol=1e-8)


def test_our_integrator_takes_the_same_step(solvers: ModuleType) -> None:
    """Solved to rounding, the equations give the positions of the step of RATTLE that follows."""
    steps = solvers.steps_of(light_heavy_chain(), 0.00125, 2, 1)
    (step, q), (_, after) = steps
    nu = step.start.copy()
    for _ in range(10):
        positions = step.positions(nu)
        nu += np.linalg.solve(step.matrix(positions), step.errors(positions))
    np.testing.assert_allclose(step.positions(nu), after, atol=1e-9)


def test_every_method_comes_to_the_end(solvers: ModuleType) -> None:
    for step, q in solvers.steps_of(light_heavy_chain(), 0.00125, 3, 400):
        numbers = [
            solvers.sor(step, 1e-9, 1.0),
            solvers.newton(step, 1e-9, True, q),
            solvers.newton(step, 1e-9, False, q),
        ]
        assert None not in numbers
        assert numbers[2] <= numbers[1] <= 3


def test_what_is_measured_is_put_into_a_page(tmp_path: Path) -> None:
    pages = load_script("benchmarks/pages.py")
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- measured: one -->\nold\n<!-- end: one -->\nafter\n")
    pages.write(page, "one", ["new \\1", "", "lines"])
    pages.write(page, "one", ["newer \\1", "", "lines"])
    text = page.read_text()
    assert text == "before\n<!-- measured: one -->\n\nnewer \\1\n\nlines\n\n<!-- end: one -->\nafter\n"
    with pytest.raises(ValueError, match="0 places for the measurement two"):
        pages.write(page, "two", [])
    assert page.read_text() == text
    assert "OpenMM 8" in pages.provenance("a device") and "a device" in pages.provenance("a device")
