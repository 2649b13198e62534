"""What a constructor of ours says of its arguments, by its docstring, its signature and the ranges that it checks."""

import ast
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

from docstring_parser import Docstring, DocstringStyle, parse

from nerf_lightning.manual.kinds import Kind, kind_of
from nerf_lightning.manual.sources import Definition, Found, assigned, definition, file_of

NO_SETTING = ("self", "args", "kwargs")
NO_BOUND = 1 << 30
"""So large that nobody meets it."""


@dataclass(frozen=True)
class Argument:
    """One argument of a constructor."""

    kind: Kind
    """What its annotation allows."""
    meaning: str
    """Its line of the docstring; empty where it has none."""
    bounds: str
    """The numbers that are taken, in words; empty where no range is declared."""


@dataclass(frozen=True)
class Constructor:
    """A class or function that a yaml names as its `_target_`."""

    summary: str
    """The first line of its docstring."""
    description: str
    """What follows that, up to the arguments."""
    arguments: dict[str, Argument]


@cache
def constructor(target: str) -> Constructor | None:
    """Return what is said of a class by its dotted name; None for one that is not ours."""
    module, _, name = target.rpartition(".")
    file = file_of(module)
    found = None if file is None else definition(file, name)
    if found is None:
        return None
    lineage = list(_lineage(found))
    meanings, bounds = _meanings(lineage), _bounds(lineage)
    arguments = {
        name: Argument(kind_of(annotation), meanings.get(name, ""), bounds.get(name, ""))
        for name, annotation in _signature(lineage).items()
    }
    docstring = _parsed(found.node)
    return Constructor(_line(docstring.short_description), docstring.long_description or "", arguments)


def _lineage(found: Found[Definition]) -> Iterator[Found[Definition]]:
    """Yield a class and those of ours that it has from, the nearest first."""
    yield found
    for base in found.node.bases if isinstance(found.node, ast.ClassDef) else ():
        origin = definition(found.file, base.id) if isinstance(base, ast.Name) else None
        if origin is not None:
            yield from _lineage(origin)


def _signature(lineage: list[Found[Definition]]) -> dict[str, Found[ast.expr]]:
    """Return the annotations of the arguments: of a function, of the nearest `__init__`, or of a dataclass's fields."""
    fields: dict[str, Found[ast.expr]] = {}
    for found in lineage:
        makers = [found.node] if isinstance(found.node, ast.FunctionDef) else _functions(found.node, "__init__")
        for maker in makers:
            arguments = [*maker.args.posonlyargs, *maker.args.args, *maker.args.kwonlyargs]
            taken = {each.arg: each.annotation for each in arguments if each.arg not in NO_SETTING}
            return {name: Found(found.file, node) for name, node in taken.items() if node is not None} | fields
        fields = _fields(found) | fields
    return fields


def _functions(node: Definition, *names: str) -> list[ast.FunctionDef]:
    return [each for each in node.body if isinstance(each, ast.FunctionDef) and each.name in names]


def _fields(found: Found[Definition]) -> dict[str, Found[ast.expr]]:
    is_dataclass = any("dataclass" in ast.unparse(each) for each in found.node.decorator_list)
    declared = [
        each for each in found.node.body if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name)
    ]
    named = {ast.unparse(each.target): Found(found.file, each.annotation) for each in declared if is_dataclass}
    return {name: annotation for name, annotation in named.items() if name != "_"}  # the mark of KW_ONLY


def _meanings(lineage: list[Found[Definition]]) -> dict[str, str]:
    meanings: dict[str, str] = {}
    for found in lineage:
        said = {each.arg_name: _line(each.description) for each in _parsed(found.node).params}
        meanings = said | meanings
    return meanings


def _parsed(node: Definition) -> Docstring:
    return parse(ast.get_docstring(node) or "", style=DocstringStyle.GOOGLE)


def _line(text: str | None) -> str:
    return " ".join((text or "").split())


def _bounds(lineage: list[Found[Definition]]) -> dict[str, str]:
    """Return what `require_ranges` and `require_positive` are told where a constructor checks its arguments."""
    bounds: dict[str, str] = {}
    for found in reversed(lineage):
        for maker in _functions(found.node, "__init__", "__post_init__"):
            for call in (each for each in ast.walk(maker) if isinstance(each, ast.Call)):
                bounds |= _declared(Found(found.file, call))
    return bounds


def _declared(call: Found[ast.Call]) -> dict[str, str]:
    name = ast.unparse(call.node.func)
    if name == "require_positive":
        return {each.arg: "1 or more" for each in call.node.keywords if each.arg is not None}
    if name != "require_ranges":
        return {}
    ranges = Found[ast.expr](call.file, call.node.args[1])
    if isinstance(ranges.node, ast.Name):
        ranges = assigned(ranges.file, ranges.node.id) or ranges
    if not isinstance(ranges.node, ast.Dict):
        return {}
    pairs = zip(ranges.node.keys, ranges.node.values, strict=True)
    known = {ast.literal_eval(key): _ends(Found(ranges.file, value)) for key, value in pairs if key is not None}
    return {name: _between(*ends) for name, ends in known.items() if ends is not None}


def _ends(ends: Found[ast.expr]) -> tuple[int | float, int | float] | None:
    if not isinstance(ends.node, ast.Tuple):
        return None
    least, greatest = (_number(Found(ends.file, each)) for each in ends.node.elts)
    return None if least is None or greatest is None else (least, greatest)


def _number(found: Found[ast.expr]) -> int | float | None:
    node = found.node
    if isinstance(node, ast.Name):
        value = assigned(found.file, node.id)
        return None if value is None else _number(value)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.LShift | ast.Pow):
        left, right = _number(Found(found.file, node.left)), _number(Found(found.file, node.right))
        if left is None or right is None:
            return None
        return left * 2**right if isinstance(node.op, ast.LShift) else left**right
    if isinstance(node, ast.Call):
        return math.inf if ast.unparse(node) == "float('inf')" else None
    try:
        value = ast.literal_eval(node)
    except ValueError:
        return None
    return value if isinstance(value, int | float) else None


def _between(least: int | float, greatest: int | float) -> str:
    return f"{least} or more" if greatest >= NO_BOUND else f"{least} to {greatest:,}"
