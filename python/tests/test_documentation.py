# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The documentation: its Python snippets run, its links lead somewhere, and no public name is without a docstring.

The blocks marked as Python of one page run one after the other, as a reader would type them. `system`, `topology`,
`positions` and `integrator` are there before the first: the pages speak of those of the reader's own script.
"""

from __future__ import annotations

import doctest
import importlib
import inspect
import pkgutil
import re
import runpy
import typing
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import openmm
import openmmvrattle
import pytest
from markdown_it import MarkdownIt
from openmm import app, unit
from openmmvrattle import VariableStepRattleIntegrator
from openmmvrattle.compare.comparison import compare
from openmmvrattle.testsystems import SYSTEMS, alanine_dipeptide

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    path
    for path in [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("examples/*.md")]
    if "_build" not in path.parts
)
OLD_NAMES = ("advice", "comparison", "inputs", "measurement", "plots", "results", "sweep")
MODULES = [
    importlib.import_module(module.name)
    for module in pkgutil.walk_packages(openmmvrattle.__path__, "openmmvrattle.")
    if not re.search(r"\._", module.name) and module.name.split(".", 1)[1] not in ("vrattle", *OLD_NAMES)
]


def name_of(value: object) -> str:
    """How a page or a module is called in the list of tests."""
    return str(value.relative_to(ROOT)) if isinstance(value, Path) else getattr(value, "__name__", "")


def fences(page: Path, language: str) -> list[tuple[int, str]]:
    """The code blocks of a page in one language, each with the line where it begins (from 0)."""
    tokens = MarkdownIt().parse(page.read_text(encoding="utf-8"))
    return [
        (token.map[0] + 1, token.content)
        for token in tokens
        if token.type == "fence" and token.map is not None and token.info.split() == [language]
    ]


def test_there_are_pages_and_snippets() -> None:
    assert {"README.md", "CHANGELOG.md"} < {page.name for page in PAGES}
    assert sum(len(fences(page, "python")) for page in PAGES) > 10


@pytest.mark.parametrize("page", [page for page in PAGES if fences(page, "python")], ids=name_of)
def test_the_snippets_of_a_page_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    registered = {openmm.Platform.getPlatform(i).getName() for i in range(openmm.Platform.getNumPlatforms())}
    for _, code in fences(page, "python"):
        for platform in re.findall(r'getPlatform\("(\w+)"\)', code):
            if platform not in registered:
                pytest.skip(f"needs the platform {platform}")
    monkeypatch.chdir(tmp_path)  # for files that snippets write
    example = alanine_dipeptide()
    namespace = {
        "openmm": openmm,
        "app": app,
        "unit": unit,
        "VariableStepRattleIntegrator": VariableStepRattleIntegrator,
        "system": example.system,
        "topology": example.topology,
        "positions": example.positions,
        "integrator": VariableStepRattleIntegrator(0.001),
    }
    for line, code in fences(page, "python"):
        exec(compile("\n" * line + code, str(page), "exec"), namespace)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_the_links_of_a_page_lead_to_files(page: Path) -> None:
    for token in MarkdownIt().parse(page.read_text(encoding="utf-8")):
        for inline in token.children or []:
            target = inline.attrGet("href") or inline.attrGet("src")
            if target and not re.match(r"[a-z]+:|#", str(target)):
                file = page.parent / unquote(str(target).split("#")[0])
                assert file.exists(), f"{page.relative_to(ROOT)} links to {target}, which is not there"


@pytest.mark.parametrize("module", [openmmvrattle, *MODULES], ids=name_of)
def test_the_examples_in_docstrings_are_true(module: object) -> None:
    assert doctest.testmod(module, optionflags=doctest.ELLIPSIS).failed == 0


def public_members(cls: type) -> dict[str, object]:
    """The methods and properties of a class that are its own and that users may call."""
    return {
        name: member.__func__ if isinstance(member, (staticmethod, classmethod)) else member
        for name, member in vars(cls).items()
        if not name.startswith("_")
        and isinstance(member, (staticmethod, classmethod, property)) | inspect.isfunction(member)
    }


@pytest.mark.parametrize("module", [openmmvrattle, *MODULES], ids=name_of)
def test_every_public_name_has_a_docstring(module: object) -> None:
    assert inspect.getdoc(module)
    for name in getattr(module, "__all__", []):
        value = getattr(module, name)
        is_class = inspect.isclass(value) and typing.get_origin(value) is None  # and no type such as Callable[[], int]
        if inspect.isfunction(value) or is_class:
            assert value.__doc__, f"{name} has no docstring"
        if is_class:
            for member_name, member in public_members(value).items():
                assert member.__doc__, f"{name}.{member_name} has no docstring"


@pytest.mark.parametrize("module", [module for module in MODULES if hasattr(module, "__all__")], ids=name_of)
def test_a_module_is_in_the_reference(module: object) -> None:
    """Itself, or the package or the class that shows what is in it."""
    reference = (ROOT / "docs" / "reference" / "python.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"auto(?:module|class):: ([\w.]+)", reference))
    package = module.__name__.rpartition(".")[0]
    classes = {f"openmmvrattle.{name}" for name in module.__all__}
    assert shown & {module.__name__, *classes} or package in shown - {"openmmvrattle"}


@pytest.mark.parametrize("name", sorted(set(public_members(VariableStepRattleIntegrator)) - {"thisown"}))
def test_the_docstring_of_a_method_says_what_it_takes_returns_and_raises(name: str) -> None:
    method = public_members(VariableStepRattleIntegrator)[name]
    documentation = inspect.getdoc(method)
    signature = inspect.signature(method, eval_str=True)
    parameters = {parameter: p.annotation for parameter, p in signature.parameters.items() if parameter != "self"}
    for parameter, annotation in parameters.items():
        explanation = re.search(rf"^{parameter} : .+\n((    .*\n?)+)", documentation, re.MULTILINE)
        assert explanation, f"nothing is said of {parameter}"
        if "Quantity" in str(annotation):
            assert re.search(r"\(in (K|ps|nm, ps)\b", explanation[1]), f"{parameter} has no unit"
    if name.startswith(("set", "add")) and parameters:
        assert "Raises\n------" in documentation
    returns = re.search(r"Returns\n-------\n.+\n((    .*\n?)+)", documentation)
    if signature.return_annotation is not None:
        assert returns, "nothing is said of what is returned"
        if "Quantity" in str(signature.return_annotation):
            assert re.search(r"picoseconds|kJ/mol", returns[1]), "the result has no unit"
    else:
        assert not returns


def test_every_example_is_listed() -> None:
    page = (ROOT / "docs" / "examples.md").read_text(encoding="utf-8")
    examples = [path for path in ROOT.glob("examples/**/*.*") if path.suffix in {".py", ".cpp"}]
    assert len(examples) > 5
    assert "`quick_tour.ipynb`" in page
    assert not [path.name for path in examples if f"](../{path.relative_to(ROOT).as_posix()})" not in page]


def test_every_benchmark_is_listed() -> None:
    page = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    scripts = [path for path in ROOT.glob("benchmarks/*.*") if path.suffix in {".py", ".sh", ".cpp"}]
    assert len(scripts) > 10
    assert not [path.name for path in scripts if f"](../benchmarks/{path.name})" not in page]


@pytest.mark.filterwarnings("ignore:.*1000 steps in a row:UserWarning")
@pytest.mark.parametrize(("row", "name"), [("a clash", "water-clash"), ("a whip", "light-heavy-chain")])
def test_the_first_table_says_what_is_measured(row: str, name: str) -> None:
    """The gains in the README, which are on the platform Reference; the row of the protein is from docs/proof.md."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    what, verlet, automatic = re.search(rf"^\| ({row}: .*) \| (.*) \| (.*) \|$", readme, re.MULTILINE).groups()
    comparison = compare(SYSTEMS[name](), integrators=["VerletIntegrator", "Automatic"])
    assert f"; {comparison.force_evaluations:,} " in what
    for run, words in zip(comparison.runs, (verlet, automatic), strict=True):
        said = float(re.search(r"[\d.]+", words)[0])
        assert said == pytest.approx(run.largest_energy_error, rel=0.1)


def test_the_row_of_the_protein_is_that_of_its_page() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    page = (ROOT / "docs" / "proof.md").read_text(encoding="utf-8")
    what, verlet, automatic = re.search(
        r"^\| (a protein in water: .*) \| (.*) \| (.*) \|$", readme, re.MULTILINE
    ).groups()

    def measured(name: str) -> list[str]:
        return re.search(rf"^\| {name} \| (.*) \|$", page, re.MULTILINE)[1].split(" | ")

    assert f"{re.search(r'([0-9,]+) atoms', page)[1]} atoms" in what
    assert f"{float(measured('simulated time')[0].split()[0]):.0f} ps" in what
    for words, number in zip((verlet, automatic), measured("fluctuation of the total energy"), strict=True):
        assert number in words
    assert f"{float(measured('time of a turn beside .*, median')[1]):.2f} times" in automatic


def test_the_pendulum_has_the_same_errors_on_both_pages() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    page = (ROOT / "docs" / "where_it_pays.md").read_text(encoding="utf-8")
    cells = re.search(r"^\| `double-pendulum`: .*$", page, re.MULTILINE)[0].replace("*", "").split(" | ")
    evaluations, verlet, automatic, _, _, rattle, vrattle, _ = (cell.split()[0] for cell in cells[1:])
    said = re.search(r"computed the forces as often, ([\d,]+) times;(.*?)`automatic=True`", readme, re.DOTALL)
    assert said[1] == evaluations
    assert re.findall(r"([\d.]+) kJ/mol", said[2]) == [verlet, rattle, vrattle, automatic]


RECIPE_PAGES = ("openmm", "automatic", "restart", "reporters", "gpu", "migration")


@pytest.mark.parametrize("name", ["README", *(f"docs/{page}" for page in RECIPE_PAGES)])
def test_the_recipe_is_the_same_everywhere(name: str) -> None:
    recipe = [
        "# was: integrator = openmm.VerletIntegrator(0.001)",
        "integrator = VariableStepRattleIntegrator(0.001, automatic=True)  # the step in ps",
    ]
    (_, first), *_ = fences(ROOT / f"{name}.md", "python")
    assert "\n".join(recipe) in first


@pytest.mark.parametrize("name", ["quick_start", "swap_verlet", "nve_water"])
def test_the_first_examples_have_the_recipe(name: str) -> None:
    text = (ROOT / "examples" / f"{name}.py").read_text(encoding="utf-8")
    was = r"# was: integrator = openmm\.VerletIntegrator\((.+)\)\n"
    assert re.search(was + r"integrator = VariableStepRattleIntegrator\(\1, automatic=True\)  # the step in ps", text)


@pytest.mark.parametrize("name", ["quick_start.py", "swap_verlet.py", "nve_water.py", "quick_tour.ipynb"])
def test_an_example_to_begin_with_has_the_recipe(name: str) -> None:
    text = (ROOT / "examples" / name).read_text(encoding="utf-8")
    first = re.search(r"integrator = VariableStepRattleIntegrator\(.*", text)[0]
    assert re.match(r"integrator = VariableStepRattleIntegrator\(0\.\d+, automatic=True\)  #", first)


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", "docs/development.md"])
def test_files_that_the_recipes_name_are_there(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    names = re.findall(
        r"(?<![\w/])((?:[\w.]+/)+[\w.]*|\w+\.(?:h|cpp|py))(?![\w/])", " ".join(re.findall(r"`([^`\n]+)`", text))
    )
    assert len(set(names)) > 10
    for name in set(names):
        found = [ROOT, ROOT / "python", ROOT / "python" / "openmmvrattle", ROOT / "method"]
        made = name.startswith((".venv", "build", "dist", "docs/_build", "out"))
        here = any((folder / name).exists() for folder in found)
        assert made or here or "/" not in name and any(ROOT.glob(f"[!.b]*/**/{name}")), name


@pytest.mark.parametrize("page", sorted(ROOT.glob("docs/**/*.md")), ids=name_of)
def test_a_page_begins_with_whom_it_is_for(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    if "{include}" not in text[:250] and "_build" not in page.parts:  # README and changelog
        assert re.search(r"^# .*\n\nFor (all|every|those|machines) ?", text, re.MULTILINE)


def test_the_path_of_a_new_user_is_eight_short_pages() -> None:
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    pages = re.search(r":caption: Use\n.*?\n\n(.*?)\n```", index, re.DOTALL)[1].split()
    assert len(pages) <= 8
    for page in pages:
        assert len((ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8").splitlines()) <= 130


@pytest.mark.parametrize("page", sorted(ROOT.glob("docs/*.md")), ids=name_of)
def test_a_measured_table_says_where_it_is_from(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"<!-- measured: (\S+) -->\n(.*?)<!-- end: (\S+) -->", text, re.DOTALL)
    assert len(re.findall(r"^<!-- measured: ", text, re.MULTILINE)) == len(blocks)
    for name, block, end in blocks:
        assert name == end
        if block.strip():  # nobody has measured it yet
            origin = r"\n\*Written by `python (benchmarks/\w+\.py)[^`]*` o"
            script = re.match(origin, block)
            assert script, f"the table {name} does not say where it is from"
            assert (ROOT / script[1]).exists()


@pytest.mark.parametrize("picture", sorted(ROOT.glob("docs/images/*.png")), ids=name_of)
def test_a_picture_is_small_and_shown(picture: Path) -> None:
    assert picture.stat().st_size < 200_000
    assert any(f"images/{picture.name})" in page.read_text(encoding="utf-8") for page in PAGES)


def test_the_first_picture_says_what_the_table_says(tmp_path: Path) -> None:
    """It is drawn anew; the motion is chaotic after the first whip, so last digits may differ."""
    script = runpy.run_path(str(ROOT / "docs" / "draw_pictures.py"))
    figure = script["draw"](script["run_comparison"]())
    figure.savefig(tmp_path / "picture.png")
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")
    page = (ROOT / "docs" / "where_it_pays.md").read_text(encoding="utf-8")
    row = re.search(r"^\| `double-pendulum`: .*", page, re.MULTILINE)[0]
    numbers = [float(re.search(r"[\d.,]+", cell)[0].replace(",", "")) for cell in row.split("|")[2:-1]]
    evaluations, verlet, _, _, variable, fixed, own, gain = numbers  # those left out are of automatic step control
    errors = [verlet, variable, fixed, own]
    shown = [re.search(r"up to ([\d.e-]+) kJ/mol", text.get_text())[1] for text in figure.legends[0].get_texts()]
    np.testing.assert_allclose([float(number) for number in shown], errors, rtol=0.2)
    assert f"{evaluations:,.0f} force evaluations" in figure.get_suptitle()
    times_smaller = re.search(r"([\d,]+) times smaller", figure.get_suptitle())[1]
    np.testing.assert_allclose(float(times_smaller.replace(",", "")), gain, rtol=0.3)
