"""Documentation of a class's arguments from its docstring and signature: parsed, since an import would take seconds."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from typing import NamedTuple

from docstring_parser import DocstringStyle, parse

from nerf_lightning.files.folders import PACKAGE

Maker = ast.ClassDef | ast.FunctionDef


class Argument(NamedTuple):
    """One argument of a constructor."""

    takes: str
    """Its annotation, with `null` for `None` and `'a' | 'b'` for literals."""
    meaning: str
    """Its line of the docstring; may be empty."""


class Constructor(NamedTuple):
    """A class or function that a YAML names as its `_target_`."""

    summary: str
    arguments: dict[str, Argument]


@cache
def constructor(target: str) -> Constructor | None:
    """Return the documentation of a class by its dotted name; None if it is not in this package."""
    lineage = list(_lineage(*target.rsplit(".", 1)))
    documented = [parse(ast.get_docstring(node) or "", DocstringStyle.GOOGLE) for _, node in lineage]
    meanings = {each.arg_name: each.description for one in reversed(documented) for each in one.params}
    arguments = {
        name: Argument(_takes(module, ast.unparse(annotation)), " ".join((meanings.get(name) or "").split()))
        for name, (module, annotation) in _signature(lineage).items()
    }
    return Constructor(documented[0].short_description or "", arguments) if lineage else None


def _lineage(module: str, name: str) -> Iterator[tuple[str, Maker]]:
    """Yield a class or function and the bases defined in this package, the nearest first."""
    origin, node = _find(module, name)
    if isinstance(node, Maker):
        yield origin, node
        for base in node.bases if isinstance(node, ast.ClassDef) else ():
            yield from _lineage(origin, ast.unparse(base))


@cache
def _find(module: str, name: str) -> tuple[str, ast.AST | None]:
    """Return the module that defines a name, followed through imports, and its class, function or assigned value."""
    for node in ast.walk(_tree(module)):
        match node:
            case ast.ClassDef() | ast.FunctionDef() if node.name == name:
                return module, node
            case ast.Assign(targets=[ast.Name(id=target)], value=value) if target == name:
                return module, value
            case ast.ImportFrom(module=str(origin), names=aliases) if name in [each.name for each in aliases]:
                return _find(origin, name)
    return module, None


@cache
def _tree(module: str) -> ast.Module:
    file = PACKAGE.joinpath(*module.split(".")[1:]).with_suffix(".py")
    is_ours = module.startswith(f"{PACKAGE.name}.") and file.is_file()
    return ast.parse(file.read_text(encoding="utf-8") if is_ours else "")


def _signature(lineage: list[tuple[str, Maker]]) -> dict[str, tuple[str, ast.expr]]:
    """Return the annotations of the nearest `__init__`, and of the fields of dataclasses before it."""
    found: dict[str, tuple[str, ast.expr]] = {}
    for module, node in lineage:
        inits = [each for each in node.body if isinstance(each, ast.FunctionDef) and each.name == "__init__"]
        for maker in [node] if isinstance(node, ast.FunctionDef) else inits:
            arguments = [*maker.args.args, *maker.args.kwonlyargs]
            return {each.arg: (module, each.annotation) for each in arguments if each.annotation} | found
        if "dataclass" in " ".join(map(ast.unparse, node.decorator_list)):
            fields = [each for each in node.body if isinstance(each, ast.AnnAssign)]
            fields = [each for each in fields if not ast.unparse(each.annotation).startswith("ClassVar")]
            found = {ast.unparse(each.target): (module, each.annotation) for each in fields} | found
            found.pop("_", None)  # KW_ONLY
    return found


def _takes(module: str, annotation: str) -> str:
    """Return an annotation with its names replaced by the unions that they stand for."""

    def resolved(name: re.Match[str]) -> str:
        origin, node = _find(module, name[0])
        return _takes(origin, ast.unparse(node)) if isinstance(node, ast.expr) else name[0]

    annotation = re.sub(r"(?<!')\b[A-Z]\w*", resolved, annotation).replace("None", "null")
    return re.sub(r"Literal\[(.*?)\]", lambda values: values[1].replace(",", " |"), annotation)
