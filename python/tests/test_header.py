# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The classes that Python users see have the methods, arguments, defaults and units that the C++ headers say."""

from __future__ import annotations

import inspect
import re
from dataclasses import dataclass
from pathlib import Path

import pytest
from openmmvrattle import VariableStepRattleIntegrator, VariableStepRattleLangevinIntegrator
from openmmvrattle.integrators import ConstrainedIntegrator

HEADERS = Path(__file__).parents[2] / "openmmapi" / "include" / "openmmvrattle"
CLASSES = [ConstrainedIntegrator, VariableStepRattleIntegrator, VariableStepRattleLangevinIntegrator]
INHERITED = {"getIntegrationForceGroups", "setIntegrationForceGroups"}
"""What Python has from openmm.Integrator, whose methods take sets of groups too and call ours."""
PYTHON_ONLY = {"cast", "isinstance"}
PYTHON_REPEATS = {"step"}
"""What Python's classes add something to, though C++ has it from the base."""


@dataclass
class Function:
    """A function of the header: its comment, and its arguments with their defaults."""

    name: str
    comment: str
    arguments: dict[str, str | None]
    results: list[str]
    """The arguments in which it returns something."""

    @property
    def is_deprecated(self) -> bool:
        return "@deprecated" in self.comment

    def explanation(self, argument: str) -> str:
        found = re.search(rf"@param {argument}\s+(.*?)(?=@param|@return|$)", self.comment, re.DOTALL)
        return "" if found is None else " ".join(found[1].split())

    @property
    def returned(self) -> str:
        found = re.search(r"@return\s+(.*)", self.comment, re.DOTALL)
        return "" if found is None else " ".join(found[1].split())


def functions(name: str) -> dict[str, Function]:
    """The public functions of a class, constructor and destructor left out."""
    text = (HEADERS / f"{name}.h").read_text(encoding="utf-8")
    public = re.split("protected:|private:", text[text.index("public:") :])[0]
    comment = r"/\*\*(?P<comment>(?:(?!\*/).)*)\*/\s*"
    declaration = r"^ *[\w:<> ]+[ &](?P<name>[a-z]\w*)\((?P<arguments>[^;]*?)\)[\w ]*;"
    result = {}
    for match in re.finditer(f"(?:{comment})?{declaration}", public, re.DOTALL | re.MULTILINE):
        words = re.sub(r"^\s*\* ?", "", match["comment"] or "", flags=re.MULTILINE)
        arguments: dict[str, str | None] = {}
        results = []
        for argument in filter(None, re.split(r",(?![^<]*>)", match["arguments"])):
            declaration, _, default = argument.partition("=")
            name = declaration.split()[-1].lstrip("&")
            if "&" in declaration and "const" not in declaration:
                results.append(name)
            else:
                arguments[name] = default.strip() or None
        result[match["name"]] = Function(match["name"], words, arguments, results)
    return result


FUNCTIONS_OF = {each: functions(each.__name__) for each in CLASSES} if HEADERS.exists() else {}
FUNCTIONS = {name: f for each in CLASSES[:2] for name, f in FUNCTIONS_OF.get(each, {}).items()}
CASES = [
    (each, name) for each, functions_of_it in FUNCTIONS_OF.items() for name in sorted(set(functions_of_it) - INHERITED)
]
pytestmark = pytest.mark.skipif(not FUNCTIONS, reason="needs the folder openmmapi")


def test_the_header_is_read() -> None:
    assert len(FUNCTIONS) > 40
    assert FUNCTIONS["addMonitor"].arguments == {"kind": None, "weight": "1.0", "power": "1.0", "order": "0.0"}
    assert FUNCTIONS["getMonitor"].results == ["kind", "weight", "power"]
    assert FUNCTIONS["addConstraint"].arguments["parameters"] == "{}"
    assert FUNCTIONS["stepTo"].explanation("time").endswith(", in ps")


@pytest.mark.parametrize("integrator", CLASSES)
def test_python_has_the_methods_of_the_header(integrator: type) -> None:
    own = {
        name
        for name, member in vars(integrator).items()
        if not name.startswith("_") and (inspect.isfunction(member) or isinstance(member, staticmethod))
    }
    assert own - PYTHON_ONLY - PYTHON_REPEATS == set(FUNCTIONS_OF[integrator]) - INHERITED - PYTHON_REPEATS


@pytest.mark.parametrize(("integrator", "name"), CASES)
def test_arguments_defaults_and_units_are_those_of_the_header(integrator: type, name: str) -> None:
    function, method = FUNCTIONS_OF[integrator][name], getattr(integrator, name)
    signature = inspect.signature(method)
    parameters = {key: value for key, value in signature.parameters.items() if key != "self"}
    assert list(parameters) == list(function.arguments)
    for key, default in function.arguments.items():
        if default is None:
            # The values of a constraint can be changed without any, like those of a new one.
            assert parameters[key].default in (inspect.Parameter.empty, {})
        else:
            # None stands for what only C++ can say.
            assert parameters[key].default == (None if default.endswith("()") else eval(default, {}))
    documentation = inspect.getdoc(method)
    assert function.is_deprecated == ("Deprecated:" in documentation)
    for key in parameters:
        own = re.search(rf"^{key} : .+\n((?:    .*\n?)+)", documentation, re.MULTILINE)[1]
        for name_of_unit in ("ps", "nm", "K", "kJ/mol"):
            if re.search(rf"\bin [^.;:]*\b{name_of_unit}\b", function.explanation(key)):
                assert re.search(rf"\(in [^)]*\b{name_of_unit}\b", own), f"{key} has no unit {name_of_unit}"
    if "picoseconds" in function.returned or re.search(r"\bps\b", function.returned):
        assert "Quantity" in str(signature.return_annotation)


@pytest.mark.parametrize("name", sorted(name for name, f in FUNCTIONS.items() if f.is_deprecated))
def test_deprecated_names_warn(name: str) -> None:
    integrator = VariableStepRattleIntegrator(0.001)
    integrator.addConstraint("x1 - a", [0], {"a": 0.1})
    arguments = {"index": 0, "name": "a", "value": 0.2, "order": 6.0}
    with pytest.warns(DeprecationWarning, match=rf"^{name}\(\) is deprecated: use \w+") as warned:
        getattr(integrator, name)(*(arguments[key] for key in FUNCTIONS[name].arguments))
    assert warned[0].filename == __file__
