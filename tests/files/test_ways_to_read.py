"""Every way to open a file for reading, or to print, goes through the functions that guard it, or is listed here."""

import ast
from pathlib import Path

import nerf_lightning

PACKAGE = Path(nerf_lightning.__file__).parent
READS = {"read_text", "read_bytes", "open", "imread", "imiter", "fromfile", "memmap", "FileHandler"}
PARSES = {"loads", "fromstring", "iterparse", "XMLParser", "loadtxt", "genfromtxt", "read_array", "safe_load"}
LOADERS = {"np", "torch", "OmegaConf", "json", "yaml", "pickle", "ElementTree"}
# The program's own text, its own process's, the system's, or what it has written a moment ago.
OURS = {
    "config/instantiate.py": ["load"],
    "extensions/viewer/live_view.py": ["print"],  # the address, which is ours
    "cli/main.py": ["read_text", "print", "print", "print", "print", "print", "print"],
    "cli/process.py": ["print", "print", "print", "open"],
    "__init__.py": ["read_text"],
    "cli/help.py": ["read_text"],
    "config/help/docstrings.py": ["read_text"],
    "config/help/search.py": ["read_text"],
    "config/help/yaml_comments.py": ["read_text"],
    "extensions/splats/page_file.py": ["read_text"],
    "messages/console.py": ["print"],
    "training/loggers.py": ["open"],
    "runs/sweep.py": ["print"],
    "compute/environment.py": ["read_text"],
    "training/launch/processes.py": ["open"],
    "config/scene_overrides.py": ["read_text", "safe_load"],
    "config/exporters.py": ["read_text", "safe_load"],
    "data/readers/auto.py": ["read_text", "safe_load"],
    "export/images.py": ["load"],
    "evaluation/kept_views.py": ["load"],  # files without a name, which it wrote itself
    "files/html.py": ["read_text"],
    "extensions/viewer/controls.py": ["read_text"],
    "extensions/table/published.py": ["read_text", "safe_load"],
    "compute/machine.py": ["read_text", "read_text", "read_text"],
    "nerf/kernels/backends.py": ["read_bytes", "read_bytes", "read_text"],
    "cli/worker.py": ["load", "load"],
    "nerf/kernels/ahead.py": ["print", "print"],  # names of our modules, between our processes
    "data/bricks/reader.py": ["open"],
}
# For writing, in a folder of its own, or of what was opened by us.
OTHERWISE = {
    "checkpoints/writing.py": ["open", "open"],
    "video/film.py": ["open"],
    "evaluation/metrics_files.py": ["open"],
    "runs/table_files.py": ["open"],
    "data/bricks/cache.py": ["load"],
    "data/bricks/parts.py": ["read_text"],
    "data/pixels/picture_files.py": ["open"],
    "files/json_files.py": ["loads", "print"],
    "files/numpy_files.py": ["load", "read_array"],
    "data/readers/ply_points.py": ["loadtxt"],
    "files/xml_files.py": ["fromstring"],
    "files/yaml_files.py": ["load"],
    "data/pixels/decoded_photographs.py": ["open"],
    "data/pixels/plain_background.py": ["open"],
    "data/sfm/reconstruction.py": ["open"],
    "data/sfm/video_frames.py": ["imiter"],
    "files/atomic.py": ["open", "open"],
    "extensions/geometry_exports/points.py": ["open"],
    "files/regular.py": ["open"],
}


def calls(file):
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            if isinstance(node.func, ast.Attribute) and (node.func.attr in READS | PARSES or _loads(node.func)):
                yield node.func.attr
            elif isinstance(node.func, ast.Name) and node.func.id in {"open", "print"} | PARSES:
                yield node.func.id


def _loads(function):
    return function.attr == "load" and isinstance(function.value, ast.Name) and function.value.id in LOADERS


def test_they_are_all_known():
    known = OURS | OTHERWISE
    assert len(known) == len(OURS) + len(OTHERWISE)
    files = {file.relative_to(PACKAGE): file for file in PACKAGE.rglob("*.py")}
    found = {name.as_posix(): sorted(calls(file)) for name, file in files.items() if "tests" not in name.parts}
    there = {name: sorted(those) for name, those in known.items() if those and (PACKAGE / name).is_file()}
    assert {name: those for name, those in found.items() if those} == there
