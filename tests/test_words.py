"""Names of functions, classes, attributes and parameters are the field's, not a private dialect's."""

import ast
from pathlib import Path

import nerf_lightning

PACKAGE = Path(nerf_lightning.__file__).parent
DIALECT = {
    *("found", "kept", "known", "place", "seen", "shown", "behind", "asked", "former", "told", "beside", "settled"),
    *("together", "apart", "between", "at", "look", "given", "evidence", "of_all"),
}
# Settings, keys of checkpoints and methods of the public types keep their names.
USERS = {
    ("nerf/losses/depth.py", "beside"),
    ("nerf/types/rays.py", "between"),
    ("nerf/types/rays.py", "at"),
    ("nerf/types/rays.py", "kept"),
    ("nerf/models/ray_generator.py", "given"),
    ("extensions/view_transformer/model.py", "look"),
}


def defined_names(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr


def test_names_are_not_words_of_a_dialect():
    found = {
        (file.relative_to(PACKAGE).as_posix(), name)
        for file in PACKAGE.rglob("*.py")
        if "tests" not in file.parts
        for name in defined_names(ast.parse(file.read_text(encoding="utf-8")))
        if name.strip("_").lower() in DIALECT
    }
    assert found == USERS
