"""Every way to open a file for reading, or to print, goes through the functions that guard it, or is listed here."""

import ast
from pathlib import Path

import nerf_lightning

PACKAGE = Path(nerf_lightning.__file__).parent
READS = {"read_text", "read_bytes", "open", "imread", "imiter", "fromfile", "memmap", "FileHandler"}
LOADERS = {"np", "torch", "OmegaConf"}
# The program's own text, its own process's, the system's, or what it has written a moment ago.
OURS = {
    "callbacks/live_view.py": ["print"],  # the address, which is ours
    "cli.py": ["load", "read_text", "print", "print", "print"],
    "commands/console.py": ["print"],
    "commands/sweep.py": ["print"],
    "commands/environment.py": ["read_text"],
    "commands/processes.py": ["open", "read_text"],
    "commands/recorded_scene.py": ["read_text"],
    "commands/viewing.py": ["open"],
    "export/images.py": ["load"],
    "reports/page.py": ["read_text"],
    "reports/published.py": ["read_text"],
    "selftest/checks/files.py": ["read_text"],
    "selftest/machine.py": ["read_text", "read_text"],
    "worker.py": ["load", "load"],
    "evaluation/lpips.py": ["load"],
    "closed_pipe.py": ["open"],
}
# For writing, in a folder of its own, or of what was opened by us.
OTHERWISE = {
    "callbacks/checkpoint_file.py": ["open", "open"],
    "commands/filming.py": ["open"],
    "commands/metrics_files.py": ["open"],
    "commands/table_files.py": ["open"],
    "data/bricks/cache.py": ["open", "open"],
    "data/images.py": ["open"],
    "data/numpy_files.py": ["open", "open"],
    "data/photograph_folder.py": ["open", "open"],
    "data/photographs.py": ["open"],
    "data/structure_from_motion.py": ["open"],
    "data/video_frames.py": ["imiter"],
    "export/atomic.py": ["open", "open"],
    "export/point_file.py": ["open"],
    "tensor_files.py": ["load"],
    "files/regular.py": ["open"],
}


def calls(file):
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            if isinstance(node.func, ast.Attribute) and (node.func.attr in READS or _loads(node.func)):
                yield node.func.attr
            elif isinstance(node.func, ast.Name) and node.func.id in ("open", "print"):
                yield node.func.id


def _loads(function):
    return function.attr == "load" and isinstance(function.value, ast.Name) and function.value.id in LOADERS


def test_they_are_all_known():
    known = OURS | OTHERWISE
    assert len(known) == len(OURS) + len(OTHERWISE)
    found = {file.relative_to(PACKAGE).as_posix(): sorted(calls(file)) for file in PACKAGE.rglob("*.py")}
    assert {name: those for name, those in found.items() if those} == {k: sorted(v) for k, v in known.items() if v}
