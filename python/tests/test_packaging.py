# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""What is written in more than one place agrees: version, and the dependencies of pip's package and of conda's."""

from __future__ import annotations

import importlib.metadata
import re
import shutil
import subprocess
from pathlib import Path

import openmmvrattle
import pytest
import yaml

ROOT = Path(__file__).parents[2]
# What a package of the index is called in conda-forge, if there it is called otherwise.
CONDA_NAMES = {"matplotlib": "matplotlib-base", "cmeel-eigen": "eigen"}


def section(name: str) -> str:
    """The text of one table of pyproject.toml; tomllib came with Python 3.11 only."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    return re.search(rf"^\[{name}\]\n(.*?)(?=^\[|\Z)", text, re.MULTILINE | re.DOTALL)[1]


def requirements(table: str, key: str) -> dict[str, str]:
    """The names and versions in one list of pyproject.toml, as conda names and writes them."""
    text = re.search(rf"^{key} = \[\n(.*?)^\]", section(table), re.MULTILINE | re.DOTALL)[1]
    found = re.findall(r'^ *"([\w-]+)([^"]*)"', text, re.MULTILINE)
    return {CONDA_NAMES.get(name, name): version.replace("==", "") for name, version in found}


@pytest.fixture(scope="module")
def recipe() -> dict:
    return yaml.safe_load((ROOT / "conda" / "recipe.yaml").read_text(encoding="utf-8"))


def conda_requirements(recipe: dict, *kinds: str) -> dict[str, str]:
    lines = [line for kind in kinds for line in recipe["requirements"][kind]]
    return {line.split(" ")[0]: "".join(line.split(" ")[1:]) for line in lines if not line.startswith("$")}


def test_the_version_is_the_same_everywhere(recipe: dict) -> None:
    version = re.search(r'^version = "([^"]+)"', section("project"), re.MULTILINE)[1]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert openmmvrattle.__version__ == importlib.metadata.version("openmm-vrattle") == version
    assert citation["version"] == version
    assert recipe["context"]["version"] == version
    assert f"## [{version}]" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_conda_builds_with_what_pip_builds_with(recipe: dict) -> None:
    wanted = requirements("build-system", "requires")
    assert {"openmm", "swig", "eigen", "scikit-build-core"} <= set(wanted)
    assert wanted.items() <= conda_requirements(recipe, "build", "host").items()


def test_conda_installs_what_pip_installs(recipe: dict) -> None:
    """With what draws and prints comparisons, since conda has no extras; Dask is left to those who have a cluster."""
    wanted = requirements("project", "dependencies")
    assert set(wanted) == {"openmm", "numpy"}
    extra = requirements(r"project\.optional-dependencies", "compare")
    del extra["distributed"]
    assert conda_requirements(recipe, "run") == wanted | extra | {"python": ""}


def test_the_tools_are_those_of_the_build() -> None:
    """The group for development repeats what a build needs, and the extra `test`."""
    tools = requirements("dependency-groups", "dev")
    assert {"openmm", "swig", "eigen"} <= set(tools)
    build = requirements("build-system", "requires")
    assert {name: version for name, version in build.items() if name in tools} == {
        name: version for name, version in tools.items() if name in build
    }
    assert requirements(r"project\.optional-dependencies", "test").items() <= tools.items()


def test_tests_have_what_comparisons_need() -> None:
    extra = requirements(r"project\.optional-dependencies", "compare")
    assert set(extra) == {"matplotlib-base", "rich", "distributed"}
    assert extra.items() <= requirements(r"project\.optional-dependencies", "test").items()


@pytest.fixture(scope="module")
def workflow() -> dict:
    path = ROOT / ".github" / "workflows" / "test.yml"
    if not path.exists():
        pytest.skip("needs the hosted workflow")
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def test_the_hosted_workflow_runs_what_is_run_here(workflow: dict) -> None:
    """Nothing but `.ci/run` and targets of make that there are, each job at least one of them."""
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.search(r"^\.PHONY: (.*)$", makefile, re.MULTILINE)[1].split())
    for name, job in workflow["jobs"].items():
        commands = [step["run"] for step in job["steps"] if "run" in step]
        known = 0
        for command in commands:
            target = re.match(r"make (\S+|\$\{\{ matrix\.target \}\})", command)
            if target and target[1].startswith("$"):
                assert set(job["strategy"]["matrix"]["target"]) <= targets
            elif target:
                assert target[1] in targets
            known += bool(target) or command == "bash .ci/run"
        assert known > 0, f"the job {name} runs nothing of ours"


def test_the_hosted_workflow_has_all_pythons(workflow: dict) -> None:
    oldest = re.search(r'requires-python = ">=3\.(\d+)"', section("project"))[1]
    for job in ("test", "wheels"):
        versions = workflow["jobs"][job]["strategy"]["matrix"]["python"]
        assert versions == [f"3.{minor}" for minor in range(int(oldest), 14)]


def test_the_hosted_workflow_is_well_formed(workflow: dict) -> None:
    """As `make check-workflow` has it, which fetches actionlint where it is not."""
    actionlint = shutil.which("actionlint") or shutil.which("actionlint", path=Path.home() / "go" / "bin")
    if actionlint is None:
        pytest.skip("needs actionlint")
    files = (ROOT / ".github" / "workflows").glob("*.yml")
    result = subprocess.run([actionlint, *files], capture_output=True, text=True)
    assert result.returncode == 0, result.stdout
