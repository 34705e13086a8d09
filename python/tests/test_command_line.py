# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Systems from files, and the commands advise and info; compare is in test_comparison.py and test_sweep.py."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import openmm
import openmmvrattle
import pytest
from openmm import app, unit
from openmmvrattle import VariableStepRattleIntegrator, info
from openmmvrattle import __main__ as command_line
from openmmvrattle.compare.commands.systems import MONITORS, UPDATES, UsageError, chosen, monitors_from
from openmmvrattle.compare.comparison import compare
from openmmvrattle.compare.inputs import InputError, from_pdb, from_system, from_xml
from openmmvrattle.testsystems import (
    MonitorSettings,
    TestSystem,
    alanine_dipeptide,
    constraint_error,
    light_heavy_chain,
    rigid_waters,
)
from project_scripts import run_command
from run_support import GPU, needs_gpu, solvated


def save(start: TestSystem, folder: Path, velocities: bool = True, positions: bool = True) -> tuple[Path, Path]:
    """Write System and State as a user does."""
    context = openmm.Context(start.system, openmm.VerletIntegrator(0.001))
    context.setPositions(start.positions)
    context.setVelocities(start.velocities)
    state = context.getState(positions=positions, velocities=velocities, parameters=True)
    paths = folder / "system.xml", folder / "state.xml"
    for path, content in zip(paths, (start.system, state), strict=True):
        path.write_text(openmm.XmlSerializer.serialize(content))
    return paths


def write_pdb(topology: app.Topology, positions: np.ndarray, path: Path) -> Path:
    with path.open("w") as file:
        app.PDBFile.writeFile(topology, positions * unit.nanometer, file)
    return path


@pytest.fixture(scope="module")
def dipeptide() -> TestSystem:
    return alanine_dipeptide()


@pytest.fixture
def pdb(dipeptide: TestSystem, tmp_path: Path) -> Path:
    return write_pdb(dipeptide.topology, dipeptide.positions, tmp_path / "dipeptide.pdb")


def energy_of(start: TestSystem) -> float:
    context = openmm.Context(
        start.system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatformByName("Reference")
    )
    context.setPositions(start.positions)
    return context.getState(energy=True).getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)


# ------------------------------------------------------------------------------------------------------- from files


def test_a_system_from_xml_is_the_same_system(tmp_path: Path) -> None:
    waters = rigid_waters(3)
    start = from_xml(*save(waters, tmp_path))
    assert start.name == "system"
    np.testing.assert_allclose(start.positions, waters.positions, rtol=0, atol=1e-9)
    np.testing.assert_allclose(start.velocities, waters.velocities, rtol=0, atol=1e-9)
    assert energy_of(start) == pytest.approx(energy_of(waters), abs=1e-6)
    assert start.notes == ()
    result = compare(start, integrators=["RATTLE", "VRATTLE"])
    assert [run.failure for run in result.runs] == [None, None]


def test_a_system_from_xml_without_velocities(tmp_path: Path) -> None:
    """They are drawn: others for other seeds, of the right size, and along the constraints."""
    paths = save(rigid_waters(8), tmp_path, velocities=False)
    starts = [from_xml(*paths, temperature=500.0, seed=seed) for seed in (1, 1, 2)]
    assert np.array_equal(starts[0].velocities, starts[1].velocities)
    assert not np.allclose(starts[0].velocities, starts[2].velocities)
    masses = np.array([starts[0].system.getParticleMass(i)._value for i in range(24)])
    for start in starts:
        temperature = np.sum(masses[:, None] * start.velocities**2) / (48 * 0.00831446)
        assert 250 < temperature < 800
        for i in range(start.system.getNumConstraints()):
            a, b, _ = start.system.getConstraintParameters(i)
            r, v = start.positions[a] - start.positions[b], start.velocities[a] - start.velocities[b]
            assert abs(r @ v) < 1e-10


def test_what_changes_the_energy_is_left_out(tmp_path: Path) -> None:
    waters = rigid_waters(2)
    waters.system.addForce(openmm.CMMotionRemover())
    waters.system.addForce(openmm.AndersenThermostat(300.0, 1.0))
    start = from_xml(*save(waters, tmp_path))
    assert len(start.notes) == 2
    assert "AndersenThermostat is left out of the System" in " ".join(start.notes)
    names = [type(start.system.getForce(i)).__name__ for i in range(start.system.getNumForces())]
    assert not {"CMMotionRemover", "AndersenThermostat"} & set(names)
    result = run_command(
        *("compare", "--xml", "system.xml", "--state", "state.xml", "--evaluations", "100", "--time", "0.1"),
        cwd=tmp_path,
    )
    assert result.returncode == 0, result.stderr
    assert "CMMotionRemover is left out" in result.stdout
    assert (tmp_path / "out" / "system.json").exists()


def test_box_and_parameters_of_a_state_are_used(tmp_path: Path) -> None:
    system = openmm.System()
    force = openmm.CustomNonbondedForce("strength/r")
    force.addGlobalParameter("strength", 1.0)
    force.setNonbondedMethod(openmm.CustomNonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(0.9)
    for _ in range(2):
        system.addParticle(10.0)
        force.addParticle()
    system.addForce(force)
    context = openmm.Context(system, openmm.VerletIntegrator(0.001))
    context.setPositions([[0, 0, 0], [1.5, 0, 0]])
    context.setVelocities(np.zeros((2, 3)))
    context.setPeriodicBoxVectors([2, 0, 0], [0, 2, 0], [0, 0, 2])
    context.setParameter("strength", 5.0)
    state = context.getState(positions=True, velocities=True, parameters=True)
    for name, content in (("system.xml", system), ("state.xml", state)):
        (tmp_path / name).write_text(openmm.XmlSerializer.serialize(content))
    start = from_xml(tmp_path / "system.xml", tmp_path / "state.xml")
    result = compare(start, integrators=["VerletIntegrator"])
    assert result.initial_energy == pytest.approx(5.0 / 0.5)  # the nearest image is 0.5 nm away


def test_a_system_from_a_pdb_file(pdb: Path, dipeptide: TestSystem) -> None:
    start = from_pdb(pdb, ["amber14-all.xml"], equilibration=0.1, seed=3)
    assert start.name == "dipeptide"
    assert start.system.getNumConstraints() == 12
    assert constraint_error(start.system, start.positions) < 1e-12
    none = from_pdb(pdb, ["amber14-all.xml"], constraints="none", equilibration=0.0)
    assert none.system.getNumConstraints() == 0


def test_hydrogens_are_added_if_asked_for(dipeptide: TestSystem, tmp_path: Path) -> None:
    model = app.Modeller(dipeptide.topology, dipeptide.positions * unit.nanometer)
    model.delete([atom for atom in model.topology.atoms() if atom.element is app.element.hydrogen])
    bare = write_pdb(model.topology, model.positions.value_in_unit(unit.nanometer), tmp_path / "bare.pdb")
    with pytest.raises(InputError, match="--add-hydrogens"):
        from_pdb(bare)
    start = from_pdb(bare, add_hydrogens=True, equilibration=0.0)
    assert start.system.getNumParticles() == 22


def test_a_periodic_pdb_file(tmp_path: Path) -> None:
    modeller, _ = solvated(count=60)
    box = tmp_path / "box.pdb"
    with box.open("w") as file:
        app.PDBFile.writeFile(modeller.topology, modeller.positions, file)
    start = from_pdb(box, cutoff=0.5, platform="CPU", equilibration=0.0)
    force = next(f for f in start.system.getForces() if isinstance(f, openmm.NonbondedForce))
    assert force.getNonbondedMethod() == openmm.NonbondedForce.PME
    assert force.getUseSwitchingFunction()
    assert start.system.getNumConstraints() >= 3 * 60
    assert constraint_error(start.system, start.positions) < 1e-6


def test_positions_of_xml_from_a_pdb_file(pdb: Path, dipeptide: TestSystem, tmp_path: Path) -> None:
    paths = save(dipeptide, tmp_path)
    start = from_xml(paths[0], positions_path=pdb)
    np.testing.assert_allclose(start.positions, dipeptide.positions, rtol=0, atol=1e-3)


def test_lists_and_quantities_as_positions() -> None:
    chain = light_heavy_chain()
    as_lists = from_system("chain", chain.system, chain.positions.tolist(), chain.velocities.tolist())
    with_units = from_system(
        "chain",
        chain.system,
        [openmm.Vec3(*row) for row in 10 * chain.positions] * unit.angstrom,
        chain.velocities * unit.nanometer / unit.picosecond,
    )
    np.testing.assert_allclose(as_lists.positions, chain.positions, rtol=0, atol=1e-12)
    np.testing.assert_allclose(with_units.positions, chain.positions, rtol=0, atol=1e-12)
    np.testing.assert_allclose(with_units.velocities, chain.velocities, rtol=0, atol=1e-12)


def test_files_that_cannot_be_used(pdb: Path, dipeptide: TestSystem, tmp_path: Path) -> None:
    system, state = save(dipeptide, tmp_path)
    (tmp_path / "nonsense").write_text("nonsense")
    (tmp_path / "empty.pdb").write_text("END\n")
    other = tmp_path / "other"
    other.mkdir()
    _, other_state = save(rigid_waters(1), other)
    bare = tmp_path / "bare"
    bare.mkdir()
    _, bare_state = save(dipeptide, bare, positions=False)
    for make, words in (
        (lambda: from_xml(tmp_path / "no.xml", state), "there is no file"),
        (lambda: from_xml(tmp_path / "nonsense", state), "cannot be read as an OpenMM XML file"),
        (lambda: from_xml(state, state), "has a State, not a System"),
        (lambda: from_xml(system, system), "has a System, not a State"),
        (lambda: from_xml(system), "needs a start"),
        (lambda: from_xml(system, other_state), "has 3 particles, but the System"),
        (lambda: from_xml(system, bare_state), "has no positions"),
        (lambda: from_pdb(tmp_path), "is a folder; give a file"),
        (lambda: from_pdb(tmp_path / "nonsense"), "PDB file"),
        (lambda: from_pdb(tmp_path / "empty.pdb"), "empty.pdb has no atoms"),
        (lambda: from_xml(system, positions_path=tmp_path / "empty.pdb"), "empty.pdb has no atoms"),
        (lambda: from_pdb(pdb, ["no-such-field.xml"]), "the force field no-such-field.xml cannot be read"),
        (lambda: from_pdb(pdb, ["tip3p.xml"]), "does not fit"),
        (lambda: from_system("two", dipeptide.system, np.zeros((22, 3))), "two"),
    ):
        with pytest.raises(InputError, match=words) as error:
            make()
        assert len(str(error.value).splitlines()) == 1


# ------------------------------------------------------------------------------------------- names and wrong usage


def test_the_names_are_those_of_the_integrator() -> None:
    for name in (*MONITORS, *UPDATES):
        assert isinstance(getattr(VariableStepRattleIntegrator, name), int)


def test_monitors_in_words() -> None:
    assert monitors_from("constraintforce") == (MonitorSettings("ConstraintForce"),)
    assert monitors_from("ForcePNorm^0.5") == (MonitorSettings("ForcePNorm", power=0.5),)
    assert monitors_from("2*ConstraintForce + ForcePNorm^0.5") == (
        MonitorSettings("ConstraintForce", weight=2.0),
        MonitorSettings("ForcePNorm", power=0.5),
    )
    for text, words in (
        ("ForcePNorm^x", "cannot be read"),
        ("ForcePNorm^-1", "must be positive"),
        ("ForcePNrom", "did you mean ForcePNorm"),
    ):
        with pytest.raises(UsageError, match=words):
            monitors_from(text)


def test_suggestions() -> None:
    with pytest.raises(UsageError, match="did you mean rigid-waters"):
        chosen("rigid-water", ["rigid-waters", "double-pendulum"], "system")
    with pytest.raises(UsageError, match="choose among one, two"):
        chosen("xyzzy", ["one", "two"], "system")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["compare", "--system", "rigid-water"], "did you mean rigid-waters"),
        (["compare", "--integrators", "Verlet"], "did you mean VerletIntegrator or VariableVerletIntegrator"),
        (["compare", "--monitors", "Forces"], "there is no monitor 'Forces'"),
        (["compare", "--updates", "Implicit"], "did you mean"),
        (["compare", "--bounds", "2", "3"], "below 1 and above 1"),
        (["compare", "--jobs", "0"], "number of jobs"),
        (["compare", "--jobs", "2", "--scheduler", "tcp://127.0.0.1:1"], "either --jobs or --scheduler"),
        (["compare", "--accuracy", "0"], "energy error must be positive"),
        (["compare", "--step", "-1"], "step must be positive"),
        (["compare", "--calibrate", "0"], "trial steps"),
        (["compare", "--state", "state.xml"], "--xml SYSTEM.xml as well"),
        (["compare", "--pdb", "no.pdb"], "there is no file no.pdb"),
        (["compare", "--xml", "no.xml"], "there is no file no.xml"),
        (["compare", "--pdb", "no.pdb", "--quick"], "--quick is for the systems that come with"),
        (["compare", "--pdb", "no.pdb", "--temperature", "-1"], "temperature"),
        (["advise"], "give one system"),
        (["advise", "--system", "rigid-waters", "--pdb", "no.pdb"], "give one system"),
        (["advise", "--system", "rigid-water"], "did you mean rigid-waters"),
        (["advise", "--system", "rigid-waters", "--step", "0"], "step must be positive"),
        (["advise", "--system", "rigid-waters", "--steps", "3"], "at least 10 steps"),
        (["advise", "--system", "rigid-waters", "--bounds", "2", "3"], "below 1 and above 1"),
        (["advise", "--system", "rigid-waters", "--monitors", "MaxForce+ForcePNorm"], "one monitor at a time"),
        (["advise", "--system", "rigid-waters", "--monitors", "ForceGroupEnergy"], "ForceGroupEnergy"),
        (["advise", "--system", "rigid-waters", "--platform", "Referenz"], "did you mean Reference"),
    ],
)
def test_wrong_usage(arguments, words, capsys, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert command_line.main(arguments) == 2
    message = capsys.readouterr().err
    assert message.startswith("error: ")
    assert words in message
    assert len(message.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_every_command_has_help_with_examples() -> None:
    for command in ("compare", "advise"):
        text = run_command(command, "--help").stdout
        assert "examples:" in text and f"python -m openmmvrattle {command}" in text
    assert "exit status" in run_command("info", "--help").stdout.lower()


# ------------------------------------------------------------------------------------------------------------- advise


def test_advise_on_a_molecule_of_the_user(pdb: Path, tmp_path: Path) -> None:
    """Nothing pays on a thermal molecule, and it says so."""
    result = run_command(
        *("advise", "--pdb", str(pdb), "--forcefield", "amber14-all.xml", "--steps", "1000", "--check"),
        *("--output", "advice"),
        cwd=tmp_path,
    )
    assert result.returncode == 0, result.stderr
    assert "Use fixed steps: nothing promises a gain." in result.stdout
    assert "1,000 fixed steps of 0.001 ps" in result.stdout
    assert "- the best settings: a gain of" in result.stdout
    assert "- automatic step control: a gain of" in result.stdout
    content = json.loads((tmp_path / "advice" / "advice.json").read_text())
    assert content["verdict"] == "fixed steps"
    assert set(content["measured_gains"]) == {"the best settings", "automatic step control"}
    assert all(0.1 < gain < 1.25 for gain in content["measured_gains"].values())
    assert max(candidate["predictor"] for candidate in content["candidates"]) < 2.2
    lines = (tmp_path / "advice" / "trial.csv").read_text().splitlines()
    assert len(lines) == 1002
    assert lines[0].startswith("time_ps,energy_error_kj_per_mol,ConstraintAndAppliedForce")
    assert (tmp_path / "advice" / "trial.png").read_bytes().startswith(b"\x89PNG")


def test_advise_on_a_system_and_state(tmp_path: Path) -> None:
    """On the whip variable steps pay; the lines that are shown run, and gain what is said."""
    system, state = save(light_heavy_chain(), tmp_path)
    result = run_command(
        *("advise", "--xml", str(system), "--state", str(state), "--step", "0.00125", "--steps", "16000", "--check")
    )
    assert result.returncode == 0, result.stderr
    assert "Use variable steps: Constraint" in result.stdout
    code = result.stdout[result.stdout.index("integrator = ") : result.stdout.index("Measured")]
    namespace = {"VariableStepRattleIntegrator": VariableStepRattleIntegrator}
    exec(code, namespace)
    integrator = namespace["integrator"]
    start = light_heavy_chain()
    context = openmm.Context(start.system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(start.positions)
    context.setVelocities(start.velocities)
    energies = []
    while context.getTime()._value < 20.0:
        integrator.step(1)
        state_now = context.getState(energy=True)
        energies.append((state_now.getKineticEnergy() + state_now.getPotentialEnergy())._value)
    assert integrator.getNumForceEvaluations() == pytest.approx(16000, rel=0.2)
    # Fixed steps have 1.6e-2 here.
    assert max(abs(energy - energies[0]) for energy in energies) < 1e-3


@needs_gpu
def test_advise_and_compare_run_on_a_platform_by_name(tmp_path: Path) -> None:
    """In any case of its letters, and with a precision."""
    common = ("--system", "water-clash", "--platform", GPU.lower(), "--precision", "double")
    result = run_command("advise", *common)
    assert result.returncode == 0, result.stderr
    assert f"platform {GPU}:double" in result.stdout
    assert "Use variable steps: ForcePNorm^0.5" in result.stdout
    result = run_command("compare", *common, "--integrators", "RATTLE", "Automatic", "--output", str(tmp_path))
    assert result.returncode == 0, result.stderr
    with (tmp_path / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["platform"] for row in rows] == [f"{GPU}:double"] * 2
    fixed, automatic = (float(row["largest_energy_error"]) for row in rows)
    assert fixed > 20 * automatic  # 100 times on Reference


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--precision", "double"], "give --platform NAME as well"),
        (["--platform", "Reference", "--precision", "double"], "has no choice of precision"),
    ],
)
def test_a_precision_that_there_is_not(options: list[str], words: str) -> None:
    result = run_command("advise", "--system", "rigid-waters", *options)
    assert result.returncode == 2
    assert words in result.stderr


def test_advise_keeps_the_time_of_our_systems() -> None:
    result = run_command("advise", "--system", "nitrogen-collision-5", "--steps", "800")
    assert result.returncode == 0, result.stderr
    assert "800 fixed steps of 0.0005 ps" in result.stdout
    assert "ForcePNorm^0.5" in result.stdout


# --------------------------------------------------------------------------------------------------------------- info


def test_info() -> None:
    result = run_command("info")
    assert result.returncode == 0, result.stderr
    assert "All is well." in result.stdout
    content = json.loads(run_command("info", "--json").stdout)
    assert content["healthy"] is True
    assert content["platforms"]["Reference"]["VariableStepRattleIntegrator"] is None
    assert content["platforms"]["Reference"]["VariableStepRattleLangevinIntegrator"] is None
    names = {openmm.Platform.getPlatform(i).getName() for i in range(openmm.Platform.getNumPlatforms())}
    assert set(content["steps"]) == names
    assert set(content["platforms_not_here"]) == {"CUDA", "HIP", "OpenCL", "CPU", "Reference"} - names
    for name in content["platforms_not_here"]:
        assert f"- {name}: pip install" in result.stdout
    for name, uses in content["steps"].items():
        ours = {"monitors", "automatic", "expressions", "moving expressions", "constant temperature"}
        assert set(uses) == ours | {"Python alone"}
        if name in ("Reference", "CPU"):
            assert all(uses[use] == "host" for use in list(uses)[:5])
            assert re.search(rf"^  {name} +yes +yes +yes +yes +yes +yes$", result.stdout, re.MULTILINE)
        elif content["platforms"][name]["VariableStepRattleIntegrator"] is None:  # there is a device
            assert uses["monitors"] == uses["moving expressions"] == "device"
            assert re.search(rf"^  {name} +GPU ", result.stdout, re.MULTILINE)
    assert content["versions"]["openmm-vrattle"] == openmmvrattle.__version__
    assert content["versions"]["OpenMM"].startswith(openmm.version.short_version.rsplit(".", 1)[0])
    assert content["versions"]["SWIG runtime"].isdigit()


def test_what_a_platform_prints_is_not_in_the_output_of_info() -> None:
    """OpenCL warns of drivers that OpenMM was not tried with, on standard output."""
    script = (
        "import os, sys\n"
        "from openmmvrattle import info\n"
        "use = info._uses()['Python alone']\n"
        "def loud():\n"
        "    os.write(1, b'a warning')\n"
        "    return use.make()\n"
        "info._uses = lambda: {'monitors': info._Use('VariableStepRattleIntegrator', loud)}\n"
        "from openmmvrattle.__main__ import main\n"
        "main(['info', '--json'])\n"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert json.loads(result.stdout)["healthy"] is True
    assert "a warning" in result.stderr


def test_info_says_what_is_wrong(monkeypatch, capsys) -> None:
    monkeypatch.setattr(openmmvrattle, "pluginLoadFailures", ["libOpenMMVRattleReference.so: no such file [at all]"])
    assert command_line.main(["info"]) == 1
    output = capsys.readouterr().out
    assert "no such file [at all]" in output
    assert "Something is wrong" in output


def test_info_where_the_compiled_part_cannot_be_loaded() -> None:
    """The command works, says why, and what can be used all the same."""
    script = (
        "import sys; sys.modules['openmmvrattle._vrattle'] = None; "
        "from openmmvrattle.__main__ import main; main(['info'])"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert "Something is wrong" in result.stdout
    assert "the compiled part of openmmvrattle cannot be used" in result.stdout
    assert "yes" in result.stdout  # the integrator in Python alone


def test_info_tries_the_integrators(monkeypatch, capsys) -> None:
    """A platform on which a step fails is named, with the reason."""

    def broken() -> openmm.Integrator:
        raise openmm.OpenMMException("it is broken [badly]")

    monkeypatch.setattr(info, "_uses", lambda: {"monitors": info._Use("VariableStepRattleIntegrator", broken)})
    assert command_line.main(["info"]) == 1
    assert "it is broken [badly]" in capsys.readouterr().out
