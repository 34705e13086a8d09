# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""How Sphinx builds this documentation: `make docs`, with the package installed in the same environment."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import openmmvrattle
from sphinx.errors import ExtensionError

DOCS = Path(__file__).parent
ROOT = DOCS.parent

project = "OpenMM-VRATTLE"
author = "OpenMM-VRATTLE contributors"
project_copyright = "OpenMM-VRATTLE contributors, MIT licence"
version = release = openmmvrattle.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "breathe",
]
exclude_patterns = ["_build"]
smartquotes = False  # rho' is not a quotation

html_theme = "furo"
html_title = f"OpenMM-VRATTLE {version}"
html_static_path = ["_static"]
html_css_files = ["pictures.css"]  # how they look in the dark theme

# The pages are read on code hosts as well: formulas between dollars, links to headings by their text.
myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 3
nb_execution_mode = "force"  # the notebook is kept without output
nb_execution_raise_on_error = True
os.environ.setdefault("OPENMM_DEFAULT_PLATFORM", "CPU")  # and not OpenCL on a processor, where there is that

# Warnings are errors, and names that lead nowhere are warnings. Exempt is what others document elsewhere: Python,
# NumPy, matplotlib, OpenMM and the C++ standard library.
nitpicky = True
nitpick_ignore_regex = [
    ("py:.*", r"(openmm|unit|app|numpy|np|matplotlib|collections|os|pathlib|typing|rich|pandas)(\..*)?"),
    ("py:.*", r"(Any|Path|Callable|Sequence|Iterator|Figure|Context|Quantity|OpenMMException)"),
    ("py:.*", r"(Custom|Compound|Verlet|VariableVerlet)?Integrator"),
    ("py:.*", r"(bool|dict|float|int|list|None|object|str|tuple|type|TypeError|ValueError|optional)"),
    ("cpp:.*", r"(OpenMM|std)(::.*)?|OpenMMVRattle|string|vector|size_t|osrngseed"),
]

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
napoleon_google_docstring = True
napoleon_numpy_docstring = True

breathe_default_project = "openmmvrattle"
breathe_projects = {"openmmvrattle": str(DOCS / "_build" / "doxygen" / "xml")}
breathe_default_members = ("members",)


def run_doxygen() -> None:
    """Let Doxygen read the C++ headers; it stands beside this Python if the dependency group `docs` is installed."""
    places = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    doxygen = shutil.which("doxygen", path=places)
    if doxygen is None:
        raise ExtensionError("There is no doxygen. Install it: pip install --group docs.")
    output = DOCS / "_build" / "doxygen"
    output.mkdir(parents=True, exist_ok=True)
    settings = (DOCS / "Doxyfile").read_text() + f'\nOUTPUT_DIRECTORY = "{output}"\n'
    try:
        subprocess.run([doxygen, "-"], input=settings, text=True, cwd=ROOT, check=True)
    except subprocess.CalledProcessError as error:
        raise ExtensionError("Doxygen has found faults in the C++ headers, see above.") from error


def copy_notebook() -> None:
    """Sphinx reads nothing outside of its folder, and the notebook belongs to the examples."""
    text = (ROOT / "examples" / "quick_tour.ipynb").read_text(encoding="utf-8")
    copy = DOCS / "quick_tour.ipynb"
    if not copy.exists() or copy.read_text(encoding="utf-8") != text:
        copy.write_text(text, encoding="utf-8")


def escape_plain_text(app, what, name, obj, options, lines) -> None:
    """Docstrings are text for `help()`: keep |F| from being read as markup, and in the integrator's also x* and U_."""
    swig = name.startswith("openmmvrattle.VariableStepRattleIntegrator")
    markup = re.compile(r"\||\*(?!\*)|_(?=\W|$)" if swig else r"\|")
    for i, line in enumerate(lines):
        parts = re.split(r"(``.*?``)", line)
        lines[i] = "".join(part if part.startswith("``") else markup.sub(r"\\\g<0>", part) for part in parts)


def setup(app) -> None:
    run_doxygen()
    copy_notebook()
    app.connect("autodoc-process-docstring", escape_plain_text, priority=100)
