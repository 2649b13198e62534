"""Paths whose names hold values: they lie in their folder, whatever the value is, and nobody else makes such paths."""

import ast
import sys
from pathlib import Path, PureWindowsPath

from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from nerf_lightning.cli.prepare import sweep_arguments
from nerf_lightning.files.folders import PACKAGE
from nerf_lightning.files.made_folders import child_of, file_name

VALUES = (
    st.text()
    | st.text(st.sampled_from("./\\\0: \n\udcff~aé"))
    | st.sampled_from(["", ".", "..", "/", "NUL", "con.txt", "Com1 .a", "a.", "é" * 300, "../../x", "C:\\x", "\x7f"])
)
FREE = {  # Names of this program, numbers, digests; files that are read as they are named
    "checkpoints": {"path.with_name(name)", "target.with_name(PREVIOUS)"},
    "cli": {"SCRIPTS / f'nerf.{shell}'"},
    "config": {"PACKAGE.joinpath(*module.split('.')[1:])"},
    "data": {
        "folder / f'{key}.npz'",
        "named.with_name(named.name + ending)",
        "pixels.path.with_name(hashlib.sha256(parts.encode()).hexdigest()[:24])",
        *("root / f'{stem}_{split}.json'", "folder / f'{name}{ending}'", "folder / f'cameras{ending}'"),
        *("path / f'cameras{e}'", "folder / f'images{ending}'", "work / f'{attempt.database}_{attempt.mapper}'"),
        *(
            "folder / f'{other}{ending}'",
            "folder / f'frame_{number:06d}.jpg'",
            "picture.with_name(f'dynamic_mask_{picture.name}')",
        ),
    },
    "evaluation": {"folder / f'{part}.png'"},
    "extensions": {
        "folder / f'{part}.png'",
        "folder / f'table{ending}'",
        *("keyframes / 'depth' / f'{path.stem}.png'", "folder / 'pose' / f'{stem}.txt'"),
        *("folder / 'intrinsics' / f'{stem}.txt'", "picture.with_name(picture.name.replace('frame', 'depth'))"),
        "path.with_name(layout.depth.format(path.stem.removeprefix(before)))",
    },
    "files": {
        "path.with_name(f'.{path.stem}.{os.getpid()}_{MACHINE}.nerf_lightning.part{path.suffix}')",
        "folder / f'{name}.yaml'",
    },
    "runs": {"make_folder(records_folder(sweep_folder)) / f'{self.number}.json'"},
    "video": {"folder / f'{stem}_{number:03d}{ending}'"},
    "training": {"folder / f'epoch_{epoch:04d}.png'", "folder / f'step_{step:07d}.png'"},
}


@given(VALUES, st.sampled_from(["", ".png", ".npy"]))
def test_a_value_names_a_file_in_its_folder(value, ending):
    name = file_name(value, ending)
    assert child_of(Path("folder"), value, ending=ending) == Path("folder") / name
    for path in (Path(name), PureWindowsPath(name)):
        assert path.name == name
        assert path.parts == (name,)
    assert not (sys.version_info < (3, 13) and PureWindowsPath(name).is_reserved())
    assert name.rstrip(". ") == name != ""
    assert name.endswith(ending)
    assert len(name.encode()) <= 201
    assert name.isprintable() or not name.isascii()
    assert file_name(name) == name


def test_long_values_that_begin_alike_have_names_of_their_own(tmp_path):
    names = {file_name("a" * 300 + end, ".png") for end in "bc"}
    assert len(names) == 2
    for name in names:
        (tmp_path / name).touch()


@settings(deadline=None)  # the first call imports Hydra
@given(VALUES.filter(lambda value: max(value, default="a") < "\ud800"))
def test_the_folder_of_a_job_is_a_child_of_its_sweep_whatever_is_swept(value):
    for typed in ((), ("hydra.sweep.subdir='${scene.name}/../${seed}'",)):
        *_, subdir = sweep_arguments(["-m", "scene.name=a,b", *typed])
        name = subdir.partition("=")[2].strip("'")
        config = {"hydra": {"job": {"num": 3}, "sweep": {"subdir": name}}, "scene": {"name": value}, "seed": 0}
        resolved = OmegaConf.create(config).hydra.sweep.subdir
        assert Path(resolved).name == resolved
        assert resolved not in ("", "..")


def test_no_other_path_is_made_of_values():
    for file in PACKAGE.rglob("*.py"):
        room = file.relative_to(PACKAGE).parts[0]
        if "tests" not in file.parts:
            paths = set(map(ast.unparse, filter(_is_path_of_values, ast.walk(ast.parse(file.read_text("utf-8"))))))
            assert paths <= FREE.get(room, set()), f"{file}: use child_of of files/made_folders.py"


def _is_path_of_values(node):
    if isinstance(node, ast.BinOp):
        return isinstance(node.op, ast.Div) and isinstance(node.right, ast.JoinedStr)
    named = isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
    joins = named and node.func.attr in ("with_name", "with_stem", "joinpath")
    return joins and not all(isinstance(argument, ast.Constant) for argument in node.args)
