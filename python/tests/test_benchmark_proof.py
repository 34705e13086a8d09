# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The proof on a solvated molecule, in small: both integrators, a restart in the middle, and what is written."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from project_scripts import ROOT, load_script

pytestmark = pytest.mark.skipif(not (ROOT / "benchmarks").exists(), reason="needs the folder benchmarks")


@pytest.fixture(scope="module")
def proof() -> ModuleType:
    pytest.importorskip("matplotlib")
    return load_script("benchmarks/proof.py")


def test_a_short_run(proof: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(proof, "TURN", 4)
    monkeypatch.setattr(proof.pages, "DOCS", tmp_path)
    (tmp_path / "images").mkdir()
    page = tmp_path / "proof.md"
    page.write_text("<!-- measured: proof-alanine-dipeptide -->\n<!-- end: proof-alanine-dipeptide -->\n")
    arguments = ["--system", "alanine-dipeptide", "--time", "0.32", "--relaxation", "0.02", "--output", str(tmp_path)]
    monkeypatch.setattr(proof, "SAVE_EVERY", 0.0)
    save = proof.Unfinished.save

    def save_and_stop(self: object, turn: int, *rest: object) -> None:
        save(self, turn, *rest)
        if turn == 15:
            raise KeyboardInterrupt

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(proof.Unfinished, "save", save_and_stop)
        proof.main(arguments)
    begun = json.loads((tmp_path / "unfinished.json").read_text())
    with pytest.raises(SystemExit):
        proof.main([*arguments, "--step", "1", "--resume"])
    assert proof.main([*arguments, "--resume", "--page"]) == 0
    assert not (tmp_path / "unfinished.json").exists()
    verlet, automatic = json.loads((tmp_path / "proof.json").read_text())
    assert (verlet["integrator"], automatic["integrator"]) == ("VerletIntegrator", "automatic")
    assert verlet["steps"] == automatic["steps"] == 160
    assert verlet["cost"] == 1.0
    assert automatic["constraint_error"] <= 1e-8 < 1e-4
    assert verlet["constraint_error"] < 2e-6
    for run in (verlet, automatic):
        assert run["simulated_ps"] == pytest.approx(0.322, rel=0.02)
        # Positions and velocities are the same to the last bit; 20,000 kJ/mol in single precision are added up anew.
        assert abs(run["energy_change_at_restart"]) < 0.5
        assert 0 < run["fluctuation"] < 5
    rows = list(csv.DictReader((tmp_path / "proof.csv").open()))
    assert len(rows) == 2 * 41
    energies = [float(row["energy (kJ/mol)"]) for row in rows if row["integrator"] == "automatic"]
    assert energies[:16] == pytest.approx(begun["runs"][1]["energies"], abs=1e-6)
    assert np.ptp(energies[4:]) < 20  # went on where it had stopped: another start differs by hundreds
    text = page.read_text()
    assert (
        "drift of the total energy" in text
        and "![Total energy of both runs](images/proof-alanine-dipeptide.png)" in text
    )
    assert (tmp_path / "images" / "proof-alanine-dipeptide.png").read_bytes().startswith(b"\x89PNG")


def test_a_run_that_is_too_short_is_refused(proof: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        proof.main(["--time", "0.1"])
    assert "a drift needs at least 1000 steps" in capsys.readouterr().err
