"""Folders whose files tell their format."""

import pytest
import torch
from support.captures import write_blender, write_npz
from support.posed_captures import Known, read, write_colmap, write_llff, write_transforms

from nerf_lightning.data.readers.auto import AutoReader
from nerf_lightning.data.readers.transforms import TransformsReader
from nerf_lightning.messages.errors import InputError

WRITERS = {
    "colmap": lambda root: write_colmap(root, Known()),
    "colmap in text": lambda root: write_colmap(root, Known(), kind=".txt", where="sparse"),
    "llff": lambda root: write_llff(root, Known()),
    "transforms": lambda root: write_transforms(root, Known()),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_format_is_recognised_and_read_as_by_its_own_reader(tmp_path, caplog, name):
    caplog.set_level("INFO")
    WRITERS[name](tmp_path)
    kind = name.partition(" ")[0]
    ours, theirs = AutoReader(root=str(tmp_path)).read(), read(kind, tmp_path)
    assert torch.equal(ours.cameras.c2w, theirs.cameras.c2w)
    assert ours.background == theirs.background
    assert f"read as scene={kind}, because it has " in caplog.text


def test_a_capture_below_the_folder_is_searched_for_and_said_once(tmp_path, caplog, monkeypatch):
    caplog.set_level("INFO")
    write_transforms(tmp_path / "capture", Known())
    looked, found_in = [], TransformsReader.found_in
    monkeypatch.setattr(TransformsReader, "found_in", lambda folder: looked.append(folder) or found_in(folder))
    AutoReader(root=str(tmp_path)).read()
    assert looked.count(tmp_path / "capture") == 1
    assert f"{tmp_path / 'capture'}: read as scene=transforms" in caplog.text
    assert "contains no capture" not in caplog.text


def test_the_blender_format_keeps_its_own_defaults(tmp_path):
    write_blender(tmp_path, {"train": 10, "test": 2})
    scene = AutoReader(root=str(tmp_path)).read()
    assert scene.background == "white"
    assert scene.pixels.has_transparency
    assert AutoReader(root=str(tmp_path), background="random").read().background == "random"


def test_settings_go_through_and_those_that_a_format_lacks_are_refused_by_name(tmp_path):
    write_colmap(tmp_path / "colmap", Known())
    assert AutoReader(root=str(tmp_path / "colmap"), hold_every=3).read().splits == (
        read("colmap", tmp_path / "colmap", hold_every=3).splits
    )
    write_blender(tmp_path / "blender", {"train": 10})
    with pytest.raises(InputError, match=r"scene\.images: scene=blender, which .* has no such setting"):
        AutoReader(root=str(tmp_path / "blender"), images="train").read()


def test_a_folder_of_no_known_format_is_told_what_is_looked_for(tmp_path):
    write_npz(tmp_path / "tiny.npz")
    with pytest.raises(InputError, match=r"known format \(blender, .*\): it holds tiny\.npz.*scene=photos"):
        AutoReader(root=str(tmp_path)).read()


HINTS = {
    "Record3D": {"metadata.json": '{"K": [1], "poses": []}', "rgb/0.jpg": ""},
    "A .r3d file of Record3D": {"a.r3d": ""},
    "RealityScan's": {"cameras.csv": "#name,x,y,alt,heading,pitch,roll,f"},
    "XMP files": {"0.xmp": ""},
    "output of 3DGS": {"point_cloud/iteration_7/point_cloud.ply": ""},
    "OpenSfM or ODM": {"cameras.json": '{"a": {"projection_type": "brown"}}'},
    "project of Meshroom": {"a.mg": ""},
    "VisualSFM": {"a.nvm": "NVM_V3 "},
    "recording of ScanNet": {"scene0000_00.sens": ""},
    "openMVG": {"sfm_data.bin": ""},
    "Meshroom's": {"sfm.abc": ""},
    "recording of ARKit": {"ARWorldMap.dat": ""},
    "transforms.json under another name": {"a.json": '{"frames": [{"file_path": "a"}]}'},
    "project of Metashape": {"a.psx": ""},
    "A zip archive": {"a.zip": ""},
}


@pytest.mark.parametrize("words", HINTS)
def test_captures_of_other_programs_are_named_by_what_their_files_hold(tmp_path, words):
    for name, text in HINTS[words].items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=words):
        AutoReader(root=str(tmp_path)).read()


@pytest.mark.parametrize("name", ["a.json", "a.csv", "metadata.json"])
def test_files_that_hold_something_else_are_no_hint(tmp_path, name):
    (tmp_path / name).write_text('{"dataset": 1, "name": 2}')
    (tmp_path / "rgb").mkdir()
    with pytest.raises(InputError, match=r"it holds a?[\w.]+, rgb\. If these are photographs"):
        AutoReader(root=str(tmp_path)).read()
