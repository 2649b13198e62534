"""numba keeps a compiled kernel for as long as the kernel's own file stays the same, and looks into no other.

What a kernel takes from another file, a function or a number, is compiled into it. So its file names the state of that
one: whoever changes that is told here what to write.
"""

import ast
import hashlib
import importlib.util
from pathlib import Path

import pytest

import nerf_lightning.nerf.kernels as room

KERNELS = Path(room.__file__).parent
PREFIX = "nerf_lightning.nerf.kernels."


def is_compiled(node):
    decorators = [each.func if isinstance(each, ast.Call) else each for each in getattr(node, "decorator_list", ())]
    return any(isinstance(each, ast.Name) and each.id == "njit" for each in decorators)


def compiled_in(tree):
    """The other files of which something is compiled in."""
    parts = [node for node in tree.body if is_compiled(node) or isinstance(node, ast.Assign)]  # numbers, too
    used = {name.id for part in parts for name in ast.walk(part) if isinstance(name, ast.Name)}
    taken = [node for node in tree.body if isinstance(node, ast.ImportFrom) and str(node.module).startswith(PREFIX)]
    modules = {node.module for node in taken if used & {alias.asname or alias.name for alias in node.names}}
    return [Path(importlib.util.find_spec(module).origin) for module in sorted(modules)]


def state_of(files):
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:8]


def told(tree):
    for node in tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "COMPILED_WITH":
            return node.value.value
    return None


FILES = [file for file in sorted(KERNELS.rglob("*.py")) if "njit" in file.read_text(encoding="utf-8")]


@pytest.mark.parametrize("file", FILES, ids=[str(file.relative_to(KERNELS)) for file in FILES])
def test_a_kernel_names_the_state_of_what_is_compiled_into_it(file):
    tree = ast.parse(file.read_text(encoding="utf-8"))
    others = compiled_in(tree)
    assert told(tree) == (state_of(others) if others else None)


def test_those_that_are_known_to_take_something_are_found():
    found = {str(file.relative_to(KERNELS)) for file in FILES if compiled_in(ast.parse(file.read_text()))}
    assert {"mlp/cpu.py", "bricks/contracted.py", "hash_grid/cpu.py", "march/cpu.py"} <= found
