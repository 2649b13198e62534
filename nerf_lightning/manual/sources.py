"""Where classes and names are defined in our files: read as syntax trees, since importing them would take seconds."""

import ast
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Generic, TypeVar

from nerf_lightning.files.folders import PACKAGE

OURS = "nerf_lightning."
Definition = ast.ClassDef | ast.FunctionDef
Syntax = TypeVar("Syntax", bound=ast.AST)


@dataclass(frozen=True)
class Found(Generic[Syntax]):
    """A piece of a file: the names in it mean what they mean there."""

    file: Path
    node: Syntax


def file_of(module: str) -> Path | None:
    """Return the file of a module of ours; None for others, and where there is none."""
    path = PACKAGE.joinpath(*module.split(".")[1:])
    files = (path.with_suffix(".py"), path / "__init__.py")
    return next((file for file in files if file.is_file()), None) if module.startswith(OURS) else None


def definition(file: Path, name: str) -> Found[Definition] | None:
    """Return the class or function of this name that a file has, be it from another one of ours."""
    for node in _tree(file).body:
        if isinstance(node, Definition) and node.name == name:
            return Found(file, node)
    origin = _origin(file, name)
    return None if origin is None else definition(*origin)


def assigned(file: Path, name: str) -> Found[ast.expr] | None:
    """Return what a name is assigned at the top of a file, or of the one of ours that it is imported from."""
    for node in _tree(file).body:
        targets = (
            node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        )
        value = getattr(node, "value", None)
        if value is not None and any(isinstance(target, ast.Name) and target.id == name for target in targets):
            return Found(file, value)
    origin = _origin(file, name)
    return None if origin is None else assigned(*origin)


def _origin(file: Path, name: str) -> tuple[Path, str] | None:
    """Return the file of ours from which another one imports a name, and what it is called there."""
    for node in ast.walk(_tree(file)):
        for alias in node.names if isinstance(node, ast.ImportFrom) else ():
            if (alias.asname or alias.name) == name:
                origin = file_of(node.module or "")  # type: ignore[attr-defined]
                return None if origin is None else (origin, alias.name)
    return None


@cache
def _tree(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))
