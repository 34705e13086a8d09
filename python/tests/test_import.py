# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Importing the package: the check of OpenMM's version, and the loading of the plugin libraries."""

import re
import subprocess
import sys

import openmm
import openmm.version
import openmmvrattle
import pytest


def test_version_is_a_version():
    assert re.fullmatch(r"\d+\.\d+\.\d+", openmmvrattle.__version__)


def test_exports():
    for name in openmmvrattle.__all__:
        assert hasattr(openmmvrattle, name)


def test_every_plugin_library_was_loaded():
    assert openmmvrattle.pluginLoadFailures == []


@pytest.mark.parametrize("built, running", [("8.6.1", "8.6.1"), ("8.6.0", "8.6.4"), ("8.6", "8.6.1.dev-b399af4")])
def test_same_minor_version_is_accepted(built, running):
    openmmvrattle._check_openmm_version(built, running)


@pytest.mark.parametrize("running", ["8.5.2", "8.7.0", "9.6.1", "8.60.0"])
def test_another_minor_version_is_refused_in_plain_words(running):
    with pytest.raises(openmm.OpenMMException) as refusal:
        openmmvrattle._check_openmm_version("8.6.1", running)
    message = str(refusal.value)
    assert "8.6.1" in message and running in message
    assert 'pip install "openmm==8.6.*"' in message


def test_import_checks_the_version_first():
    """With another OpenMM the package stops before it loads any compiled code."""
    script = (
        "import sys, openmm.version\n"
        "openmm.version.short_version = '8.7.0'\n"
        "try:\n"
        "    import openmmvrattle\n"
        "except Exception as error:\n"
        "    print(type(error).__name__, error)\n"
        "print('openmmvrattle._vrattle' in sys.modules)\n"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    error, loaded = result.stdout.splitlines()
    assert error.startswith("OpenMMException openmmvrattle was built for OpenMM ")
    assert "8.7.0" in error
    assert loaded == "False"


def test_a_missing_library_is_reported(tmp_path):
    (failure,) = openmmvrattle._load_plugins(tmp_path)
    assert "OpenMMVRattleReference" in failure


def test_a_broken_library_is_reported(tmp_path):
    broken = tmp_path / "libOpenMMVRattleReference.so"
    broken.write_text("no library at all")
    (failure,) = openmmvrattle._load_plugins(tmp_path)
    assert str(broken) in failure


def test_a_library_for_a_missing_platform_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(openmmvrattle, "_PLATFORMS_OF_LIBRARY", {"OpenMMVRattleNowhere": ("Nowhere",)})
    assert openmmvrattle._load_plugins(tmp_path) == []
