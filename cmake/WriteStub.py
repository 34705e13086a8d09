# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Write the type stub of the module that SWIG has made: python WriteStub.py vrattle.py vrattle.pyi.

Signatures and documentation are written once, in openmmvrattle.i, and SWIG carries them into its module, among much
that is of no concern to a reader. Editors and type checkers get the stub: classes, their constants and methods, and the
documentation, without SWIG's own classes and without any code.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

_HEADER = """\
# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
#
# Made by cmake/WriteStub.py from the module of the same name.

"""


def stub(source: str) -> str:
    """The stub of a SWIG module, given its text."""
    module = ast.parse(source)
    classes = [_class(node) for node in module.body if isinstance(node, ast.ClassDef) and _is_ours(node)]
    if not classes:
        raise SystemExit("WriteStub.py: there is no class of ours in the module.")
    used = {node.id for outline in classes for node in ast.walk(outline) if isinstance(node, ast.Name)}
    imports = {
        ast.unparse(node)
        for node in module.body
        if isinstance(node, (ast.Import, ast.ImportFrom)) and _binds(node) & used
    }
    lines = sorted({*imports, "from typing import ClassVar"})
    outline = ast.unparse(ast.fix_missing_locations(ast.Module(classes, [])))
    return _HEADER + "\n".join(lines) + "\n\n" + outline + "\n"


def _is_ours(node: ast.ClassDef) -> bool:
    """Whether a class wraps one of our own and is not a part of SWIG."""
    return not node.name.startswith(("_", "Swig"))


def _binds(node: ast.Import | ast.ImportFrom) -> set[str]:
    """The names that an import defines."""
    return {(alias.asname or alias.name).split(".")[0] for alias in node.names}


def _class(node: ast.ClassDef) -> ast.ClassDef:
    """A class with its documentation and the outlines of its members."""
    documentation = [node.body[0]] if ast.get_docstring(node, clean=False) else []
    members = [outline for member in node.body for outline in _members(member)]
    # SWIG's base class openmm.openmm.Integrator is the one that users know as openmm.Integrator.
    bases = [ast.parse(ast.unparse(base).replace("openmm.openmm.", "openmm."), mode="eval").body for base in node.bases]
    return ast.ClassDef(node.name, bases, [], [*documentation, *members], [])


def _members(node: ast.stmt) -> Iterator[ast.stmt]:
    """What a stub says of one statement in a class: a constant, a method, or nothing."""
    if isinstance(node, ast.FunctionDef) and (node.name == "__init__" or node.returns is not None):
        if not node.name.startswith("_") or node.name.endswith("__"):
            documentation = [node.body[0]] if ast.get_docstring(node, clean=False) else []
            yield ast.FunctionDef(
                node.name,
                node.args,
                [*documentation, ast.Expr(ast.Constant(...))],
                node.decorator_list,
                node.returns,
            )
    elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
        name = node.targets[0]
        # SWIG's constants are attributes of its extension module: _vrattle.VariableStepRattleIntegrator_Explicit.
        if not name.id.startswith("_") and isinstance(node.value, ast.Attribute):
            yield ast.AnnAssign(name, ast.parse("ClassVar[int]", mode="eval").body, None, 1)


if __name__ == "__main__":
    Path(sys.argv[2]).write_text(stub(Path(sys.argv[1]).read_text()))
