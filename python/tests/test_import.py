# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Importing the package: the check of OpenMM's version, and the loading of the plugin libraries."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

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


def run_script(script: str, **options: object) -> list[str]:
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, **options)
    return result.stdout.splitlines()


# Asks for both integrators, and runs the one that is written in Python.
WITHOUT_COMPILED_PART = """
import openmm, openmmvrattle
for name in ("CustomVariableStepRattleIntegrator", "VariableStepRattleIntegrator"):
    try:
        getattr(openmmvrattle, name)
        print("there is a", name)
    except Exception as error:
        print(type(error).__name__, error)
try:
    from openmmvrattle import VariableStepRattleIntegrator
except Exception as error:
    print(type(error).__name__, error)
print("openmmvrattle._vrattle" in sys.modules, openmmvrattle.__version__, openmmvrattle.pluginLoadFailures)
from openmmvrattle import *
from openmmvrattle.testsystems import rigid_waters
water = rigid_waters()
integrator = CustomVariableStepRattleIntegrator(0.001)
context = openmm.Context(water.system, integrator, openmm.Platform.getPlatform("Reference"))
context.setPositions(water.positions)
context.setVelocities(water.velocities)
integrator.step(5)
copy = XmlSerializer.deserialize(XmlSerializer.serialize(integrator))
print(type(copy).__name__, integrator.getStepDensity() != 1)
"""


def check_without_compiled_part(lines: list[str], reason: str) -> None:
    there, missing, imported, state, run = lines
    assert there == "there is a CustomVariableStepRattleIntegrator"
    for message in (missing, imported):
        assert message.startswith("OpenMMException There is no VariableStepRattleIntegrator")
        assert reason in message and "CustomVariableStepRattleIntegrator, which is written in Python" in message
    assert state.startswith("False ") and reason in state
    assert run == "CustomVariableStepRattleIntegrator True"


def test_import_checks_the_version_first():
    """With another OpenMM no compiled code is loaded, and what is written in Python alone can be used."""
    lines = run_script("import sys, openmm.version\nopenmm.version.short_version = '8.7.0'\n" + WITHOUT_COMPILED_PART)
    check_without_compiled_part(lines, "openmmvrattle was built for OpenMM ")
    assert "8.7.0" in lines[1]


def test_an_extension_that_cannot_be_loaded():
    lines = run_script("import sys\nsys.modules['openmmvrattle._vrattle'] = None\n" + WITHOUT_COMPILED_PART)
    lines[3] = lines[3].replace("True", "False", 1)  # It is None there.
    check_without_compiled_part(lines, "_vrattle")


def test_the_python_files_alone(tmp_path):
    """On a machine for which nothing of the package was ever built."""
    package = tmp_path / "openmmvrattle"
    shutil.copytree(
        Path(openmmvrattle.__file__).parent,
        package,
        ignore=lambda folder, names: [
            n for n in names if not n.endswith((".py", ".json")) and "." in n or n in ("vrattle.py", "_build.py", "lib")
        ],
    )
    assert not list(package.glob("*.so")) and not (package / "lib").exists()
    script = f"import sys\nsys.path.insert(0, {str(tmp_path)!r})\n" + WITHOUT_COMPILED_PART
    lines = run_script(script + "print(openmmvrattle.__file__)", cwd=tmp_path)
    assert lines.pop() == str(package / "__init__.py")
    check_without_compiled_part(lines, "_build")


# The libraries for the platforms that this OpenMM has.
PRESENT = {openmm.Platform.getPlatform(i).getName() for i in range(openmm.Platform.getNumPlatforms())}
NEEDED = [
    library for library, platforms in openmmvrattle._PLATFORMS_OF_LIBRARY.items() if not PRESENT.isdisjoint(platforms)
]


def test_each_gpu_platform_has_a_library():
    """In the package whether or not this OpenMM has the platform; it is loaded only where it has."""
    folder = Path(openmmvrattle._vrattle.__file__).parent / "lib" / "plugins"
    for name in ("OpenCL", "CUDA", "HIP"):
        assert list(folder.glob(f"libOpenMMVRattle{name}.so"))
        assert openmmvrattle._PLATFORMS_OF_LIBRARY[f"OpenMMVRattle{name}"] == (name,)


def test_a_missing_library_is_reported(tmp_path):
    failures = openmmvrattle._load_plugins(tmp_path)
    assert len(failures) == len(NEEDED)
    for library, failure in zip(NEEDED, failures, strict=True):
        assert library in failure


def test_a_broken_library_is_reported(tmp_path):
    broken = tmp_path / "libOpenMMVRattleReference.so"
    broken.write_text("no library at all")
    failure, *others = openmmvrattle._load_plugins(tmp_path)
    assert str(broken) in failure
    assert len(others) == len(NEEDED) - 1


def test_a_library_for_a_missing_platform_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(openmmvrattle, "_PLATFORMS_OF_LIBRARY", {"OpenMMVRattleNowhere": ("Nowhere",)})
    assert openmmvrattle._load_plugins(tmp_path) == []


WITHOUT = "import sys\nfor name in ('matplotlib', 'rich', 'distributed', 'pandas'): sys.modules[name] = None\n"


def test_openmm_and_numpy_are_enough(tmp_path):
    """The integrators, their reporters, the test systems, advice and info; what needs more says so in one sentence."""
    script = WITHOUT + (
        "import openmmvrattle, openmmvrattle.reporters\n"
        "from openmmvrattle.testsystems import double_pendulum\n"
        "p = double_pendulum()\n"
        "a = openmmvrattle.advise(p.system, p.positions, p.velocities, step_size=1e-4, steps=50)\n"
        "print(len(a.sentences()) > 0)\n"
        "from openmmvrattle.__main__ import main\n"
        "print(main(['info']))\n"
    )
    lines = run_script(script, cwd=tmp_path)
    assert lines[0] == "True" and lines[-2:] == ["All is well.", "0"]


@pytest.mark.parametrize(
    "command, packages",
    [
        (["compare", "--quick", "--system", "double-pendulum"], "matplotlib and rich, which are"),
        (["advise", "--system", "double-pendulum", "--steps", "50"], "rich, which is"),
    ],
)
def test_a_command_says_which_package_is_missing(tmp_path, command, packages):
    script = WITHOUT + f"from openmmvrattle.__main__ import main\nsys.exit(main({command!r}))\n"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=tmp_path)
    assert result.returncode == 2
    assert result.stderr == (
        f'error: this command needs {packages} not installed: pip install "openmm-vrattle[compare]" (or, in the folder '
        'of the source, ".[compare]").\n'
    )
    assert not list(tmp_path.iterdir())


def test_pictures_and_clusters_say_which_package_is_missing():
    script = WITHOUT + (
        "from openmmvrattle.compare import sweep\n"
        "try:\n    sweep.DaskRunner('tcp://127.0.0.1:1')\nexcept sweep.RunnerError as error:\n    print(error)\n"
        "try:\n    import openmmvrattle.compare.plots\nexcept ImportError as error:\n    print(error)\n"
    )
    cluster, picture = run_script(script)
    assert cluster.startswith("a Dask cluster needs distributed, which is not installed: pip install ")
    assert picture.startswith("a picture needs matplotlib, which is not installed: pip install ")


def test_old_names_of_modules_go_on_to_work():
    script = (
        "import warnings\n"
        "with warnings.catch_warnings(record=True) as caught:\n"
        "    warnings.simplefilter('always')\n"
        "    from openmmvrattle.comparison import compare\n"
        "    import openmmvrattle.measurement\n"
        "import openmmvrattle.compare.comparison as new\n"
        "print(compare is new.compare, openmmvrattle.measurement is openmmvrattle.compare.measurement)\n"
        "print(*(str(w.message) for w in caught if w.category is DeprecationWarning), sep='\\n')\n"
    )
    assert run_script(script) == [
        "True True",
        "openmmvrattle.comparison is called openmmvrattle.compare.comparison now",
        "openmmvrattle.measurement is called openmmvrattle.compare.measurement now",
    ]
