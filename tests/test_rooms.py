"""The rooms of the package, and the arrows between them.

A room is a folder directly below nerf_lightning/, or a file beside those folders; an `__init__.py` that defines nothing
is none. An arrow leads from a room to another that one of its files imports, wherever in the file.
`python tests/test_rooms.py` prints both. That no arrow leads up is checked by import-linter (`make layers`).
"""

import ast
from collections import defaultdict
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "nerf_lightning"
MOST_ROOMS, MOST_ARROWS = 26, 140


def room_of(file: Path) -> str:
    return file.relative_to(PACKAGE).parts[0].replace(".pyi", ".py")


def files() -> list[Path]:
    """The files of the package; tests of extensions are no part of it."""
    return [file for end in ("py", "pyi") for file in sorted(PACKAGE.rglob(f"*.{end}")) if "tests" not in file.parts]


def module_of(file: Path) -> str:
    return ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")


def defines(file: Path) -> bool:
    kinds = (ast.FunctionDef, ast.ClassDef, ast.Assign, ast.AnnAssign)
    return any(isinstance(node, kinds) for node in ast.parse(file.read_text(encoding="utf-8")).body)


def imported(file: Path, known: dict[str, Path]) -> set[Path]:
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names] + [node.module]
        else:
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        found |= {known[name] for name in names if name in known and known[name].stem != "__init__"}
    return found


def drawn() -> tuple[set[str], dict[tuple[str, str], set[str]]]:
    """The rooms, and for each arrow what makes it."""
    known, rooms, arrows = {module_of(file): file for file in files()}, set(), defaultdict(set)
    for file in files():
        if file.name == "__init__.py" and not defines(file):
            continue
        rooms.add(room_of(file))
        for other in imported(file, known):
            if room_of(other) != room_of(file):
                where = file.relative_to(PACKAGE), other.relative_to(PACKAGE)
                arrows[room_of(file), room_of(other)].add(f"{where[0]} -> {where[1]}")
    return rooms, arrows


def circle(arrows) -> list[str]:
    """The rooms that are left when those that lead nowhere are taken away again and again."""
    left = {room for arrow in arrows for room in arrow}
    while ends := {room for room in left if not any(a == room and b in left for a, b in arrows)}:
        left -= ends
    return sorted(left)


def test_there_are_few_rooms_few_arrows_and_no_circle():
    rooms, arrows = drawn()
    assert circle(arrows) == []
    assert len(rooms) <= MOST_ROOMS, sorted(rooms)
    assert len(arrows) <= MOST_ARROWS, sorted(arrows)


def imported_by_name(file: Path) -> list[str]:
    """Modules of ours that a file imports by a string, of which import-linter knows nothing."""
    calls = [node for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))) if isinstance(node, ast.Call)]
    by_name = [call for call in calls if ast.unparse(call.func).endswith(("import_module", "__import__"))]
    texts = [each.value for call in by_name for each in ast.walk(call) if isinstance(each, ast.Constant)]
    return [text for text in texts if str(text).startswith("nerf_lightning")]


def test_no_module_of_ours_is_imported_by_a_string(tmp_path):
    assert {str(file): found for file in files() if (found := imported_by_name(file))} == {}
    (tmp_path / "a.py").write_text("import importlib\nimportlib.import_module('nerf_lightning.data.rays')\n")
    assert imported_by_name(tmp_path / "a.py") == ["nerf_lightning.data.rays"]


def test_a_circle_is_found():
    assert circle({("a", "b"): set(), ("b", "c"): set(), ("c", "b"): set(), ("c", "d"): set()}) == ["a", "b", "c"]


if __name__ == "__main__":
    all_rooms, all_arrows = drawn()
    for (a, b), why in sorted(all_arrows.items()):
        print(f"{a} -> {b}: {len(why)}")
    print(f"{len(all_rooms)} rooms, {len(all_arrows)} arrows, circle: {circle(all_arrows) or 'none'}")
