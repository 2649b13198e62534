"""What an annotation allows, in the words of a person who types settings."""

import ast
from collections.abc import Iterable
from dataclasses import dataclass

from nerf_lightning.manual.sources import Found, assigned

WORDS = {"bool": "true or false", "int": "a whole number", "float": "a number", "str": "text", "None": "null"}
LISTS = ("list", "Sequence", "tuple")
TABLES = ("dict", "Mapping")


@dataclass(frozen=True)
class Kind:
    """What may be given for a setting."""

    words: str
    """For a person to read."""
    choices: tuple[str, ...] = ()
    """All or some of the values that may be typed, where they can be listed."""


def kind_of(annotation: Found[ast.expr]) -> Kind:
    """Return what an annotation allows.

    >>> from pathlib import Path
    >>> kind_of(Found(Path(__file__), ast.parse("int | Literal['auto', 'most'] | None", mode="eval").body))
    Kind(words='a whole number, auto, most or null', choices=('auto', 'most', 'null'))
    """
    options = _options(annotation)
    words = _once(word for option in options for word in _words(option))
    choices = [choice for option in options for choice in _choices(option)]
    return Kind(" or ".join(filter(None, (", ".join(words[:-1]), *words[-1:]))), tuple(dict.fromkeys(choices)))


def _once(words: Iterable[str]) -> list[str]:
    once = list(dict.fromkeys(words))
    return [word for word in once if word != WORDS["int"] or WORDS["float"] not in once]


def _options(annotation: Found[ast.expr]) -> list[Found[ast.expr]]:
    """Return what a union joins, through the names that stand for unions."""
    file, node = annotation.file, annotation.node
    if isinstance(node, ast.BinOp):
        return [*_options(Found(file, node.left)), *_options(Found(file, node.right))]
    if isinstance(node, ast.Name) and node.id not in WORDS:
        alias = assigned(file, node.id)
        return [annotation] if alias is None else _options(alias)
    return [annotation]


def _words(option: Found[ast.expr]) -> list[str]:
    node = option.node
    if _subscripted(node) == "Literal":
        return [_typed(each) for each in _elements(node)]
    if _subscripted(node) in LISTS:
        inner = _once(word for each in _elements(node)[:1] for word in _words_of(option, each))
        return [f"a list, each {' or '.join(inner)}"]
    if _subscripted(node) in TABLES:
        return ["settings by name"]
    if isinstance(node, ast.Constant) and node.value is None:
        return [WORDS["None"]]
    name = ast.unparse(node)
    return [WORDS.get(name, f"{name}, a part that is chosen by its group")]


def _words_of(option: Found[ast.expr], node: ast.expr) -> list[str]:
    return [word for each in _options(Found(option.file, node)) for word in _words(each)]


def _choices(option: Found[ast.expr]) -> list[str]:
    node = option.node
    if _subscripted(node) == "Literal":
        return [_typed(each) for each in _elements(node)]
    if _subscripted(node) in LISTS:
        return [choice for each in _elements(node)[:1] for choice in _choices(Found(option.file, each))]
    return {"bool": ["true", "false"], "None": ["null"]}.get(ast.unparse(node), [])


def _subscripted(node: ast.expr) -> str | None:
    return node.value.id if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name) else None


def _elements(node: ast.expr) -> list[ast.expr]:
    assert isinstance(node, ast.Subscript)
    return node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]


def _typed(node: ast.expr) -> str:
    value = ast.literal_eval(node)
    return {True: "true", False: "false", None: "null"}[value] if value in (True, False, None) else str(value)
