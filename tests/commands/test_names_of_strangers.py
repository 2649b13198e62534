"""Names from files: refused where they cannot be names, and shown as text wherever they are shown."""

import json
import logging
import logging.config
import os
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from hydra import compose
from hydra.core.global_hydra import GlobalHydra
from hydra.initialize import initialize_config_dir
from omegaconf import OmegaConf
from PIL import Image
from support.captures import write_blender
from support.known_fields import ball, solid
from support.posed_captures import Known, read, ring, write_colmap, write_llff, write_transforms
from support.scenes import ball_scene

from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.config.hydra_versions import DEFAULTS
from nerf_lightning.data.readers.blender import BlenderReader
from nerf_lightning.data.sfm.photograph_folder import find_photographs
from nerf_lightning.doctor.check import Check
from nerf_lightning.doctor.picture import _write_verdicts
from nerf_lightning.evaluation.protocol import split_hash
from nerf_lightning.export.cameras import CamerasExport, colmap_files
from nerf_lightning.files.folders import conf_folder
from nerf_lightning.messages.errors import InputError
from nerf_lightning.visualization.figures import new_figure, picture_of
from nerf_lightning.visualization.pictures import with_caption

NOT_UTF8 = os.fsdecode(b"p_\xff.png")
BAD = ["p_\n.png", "p_\x1b[2J.png", "p_\x9b2J.png", NOT_UTF8]
FORMATS = {"llff": write_llff, "transforms": write_transforms, "colmap": write_colmap}


# In files of text, names are UTF-8 already.
@pytest.mark.parametrize(("kind", "name"), [*((kind, BAD[1]) for kind in FORMATS), ("llff", NOT_UTF8)])
def test_a_view_of_such_a_name_is_left_out(tmp_path, caplog, kind, name):
    known = Known(c2w=ring(), names=(name, *Known(c2w=ring()).names[1:]))
    assert len(read(kind, FORMATS[kind](tmp_path / "capture", known)).view_names) == 8
    assert re.search(r"has the name '.*p_\\.*', which holds control characters, is not UTF-8", caplog.text)
    assert name not in caplog.text


@pytest.mark.parametrize("name", BAD)
def test_a_photograph_without_a_pose_is_left_out_whatever_its_name(tmp_path, name, caplog):
    root = write_colmap(tmp_path / "capture", Known())
    (root / "images" / "p_0.png").rename(root / "images" / name)
    Image.new("RGB", (16, 12)).save(root / "images" / "p_0.png")
    assert read("colmap", root).left_out == (name,)
    assert "1 photographs have no pose and are left out: p_\\" in caplog.text


@pytest.mark.parametrize("name", BAD)
def test_a_frame_of_the_blender_format_is_left_out(tmp_path, caplog, name):
    root = write_blender(tmp_path / "capture", {"train": 3, "val": 1, "test": 1})
    (root / "train" / "r_1.png").rename(root / "train" / name)
    path = root / "transforms_train.json"
    content = json.loads(path.read_text())
    content["frames"][1]["file_path"] = f"train/{name}"
    path.write_text(json.dumps(content))
    assert len(BlenderReader(str(root)).read().view_names) == 4
    assert re.search(r"frames\[1\] has the name 'train/p_\\.*', which holds control characters", caplog.text)


@pytest.mark.parametrize("name", BAD)
def test_a_photograph_to_find_the_pose_of_is_left_out(tmp_path, name, caplog):
    for photograph in ("a.png", "b.png", name):
        Image.new("RGB", (80, 80)).save(tmp_path / photograph)
    with pytest.raises(InputError, match=r"holds only a\.png, b\.png"):
        find_photographs(tmp_path)
    Image.new("RGB", (80, 80)).save(tmp_path / "c.png")
    caplog.clear()
    assert [each.path.name for each in find_photographs(tmp_path)] == ["a.png", "b.png", "c.png"]
    assert ["1 of 4 photographs are left out" in text and "p_\\" in text for text in caplog.messages] == [True]


def test_names_of_all_languages_are_read_and_exported(tmp_path):
    names = ("ü b.png", "\u0645\u06cc\u200c.png", "at 9.41\u202fAM.png", *Known(c2w=ring()).names[3:])
    scene = read("transforms", write_transforms(tmp_path / "capture", Known(c2w=ring(), names=names)))
    assert scene.view_names[:3] == tuple(f"images/{name}" for name in names[:3])
    CamerasExport().export(solid(ball()), scene_record(scene), tmp_path / "out", 4096)
    text = (tmp_path / "out" / "sparse" / "0" / "images.txt").read_text(encoding="utf-8")
    assert all(f" images/{name}\n" in text for name in names)


def test_the_hash_of_a_split_takes_any_name():
    scene = ball_scene()
    hashes = {
        split_hash(replace(scene, view_names=(name, *scene.view_names[1:])), [0]) for name in ("a", "\ud800", NOT_UTF8)
    }
    assert len(hashes) == 3


PLANTED = "a.png\n7 1 0 0 0 0 0 0 1 planted.png\n"


@pytest.mark.parametrize("name", [PLANTED, "a\rb", "c\u2028d"])
def test_a_name_adds_no_line_to_a_colmap_model(name):
    scene = ball_scene()
    with pytest.raises(InputError, match=r"photograph 1 has the name '.*\\.*', which holds control"):
        colmap_files(scene.cameras, ("a.png", name, *scene.view_names[2:]))


@pytest.mark.parametrize("part", ["job_logging", "hydra_logging"])
def test_what_is_logged_steers_no_terminal(part, capsys):
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(conf_folder()), **DEFAULTS):
        settings = OmegaConf.to_container(compose("train", return_hydra_config=True).hydra[part])
    root = logging.getLogger()
    former = root.handlers[:], root.level
    try:
        logging.config.dictConfig(settings | {"disable_existing_loggers": False})
        logging.getLogger("nerf_lightning").warning("%s has no pose", "\x1b[2J\nnerf: all is well")
    finally:
        root.handlers[:], root.level = former
    assert capsys.readouterr().err.rstrip().endswith(r"\x1b[2J\nnerf: all is well has no pose")


def test_drawings_show_names_as_text():
    figure = new_figure(300, 200)
    _write_verdicts(figure.subplots(), [Check("blur", "look", r"$\nothing$ is blurred", "Remove it.")])
    assert picture_of(figure).shape == (200, 300, 3)
    assert with_caption(torch.zeros(4, 4, 3, dtype=torch.uint8), "a\ud800\nb", 10).shape[1] > 20
    np.testing.assert_array_equal(
        with_caption(torch.zeros(4, 4, 3, dtype=torch.uint8), "a\nb", 10),
        with_caption(torch.zeros(4, 4, 3, dtype=torch.uint8), r"a\nb", 10),
    )
