"""A training says what is wrong with its capture as far as that is seen in no time, though no doctor is asked."""

import numpy as np
from PIL import Image
from support.captures import npz_content, picture, write_blender, write_npz
from support.posed_captures import Known, ring, write_transforms
from support.running import FAST

from nerf_lightning import build_run

FEW = "number of views"


def warnings(caplog, *scene):
    caplog.clear()
    small = [setting for setting in FAST if setting.startswith(("model", "data"))]
    build_run(*scene, *small, "trainer=cpu", "doctor=off")
    return [record.message for record in caplog.records if record.levelname == "WARNING" and FEW not in record.message]


def of_npz(caplog, tmp_path, images):
    path = write_npz(tmp_path / "a.npz", images=images)
    return warnings(caplog, "scene=npz", f"scene.path={path}")


def test_photographs_of_one_colour_show_nothing_and_a_few_are_named(caplog, tmp_path):
    assert of_npz(caplog, tmp_path, npz_content()["images"]) == []
    images = npz_content()["images"]
    for level, told in ((0, "8 of 8 training photographs of npz show nothing: 0 (all 0, 0, 0)"), (1, "8 of 8")):
        (said,) = of_npz(caplog, tmp_path, np.full_like(images, level))
        assert said.startswith(told)
    images[2] = 0
    (said,) = of_npz(caplog, tmp_path, images)
    assert said.startswith("1 of 8 training photographs of npz show nothing: 2 (all 0, 0, 0).")


def test_photographs_that_are_all_transparent_show_nothing(caplog, tmp_path):
    root = write_blender(tmp_path / "c", {"train": 6, "val": 1, "test": 1})
    for view in range(6):
        rgba = picture(view)
        rgba[..., 3] = 0
        Image.fromarray(rgba).save(root / "train" / f"r_{view}.png")
    (said,) = warnings(caplog, "scene=blender", f"scene.root={root}")
    assert said.startswith("6 of 6 training photographs of blender show nothing: train/r_0 (transparent)")
    assert "alpha" in said


def test_masks_that_keep_the_dark_outside_are_asked_about(caplog, tmp_path):
    known = Known()
    root = write_transforms(tmp_path / "c", known)
    (root / "masks" / "images").mkdir(parents=True)
    for name in known.names:
        rgb = np.zeros((12, 16, 3), np.uint8)
        rgb[4:8, 4:8] = np.random.default_rng(0).integers(0, 255, (4, 4, 3))
        Image.fromarray(rgb).save(root / "images" / name)
        Image.fromarray(np.where(rgb.any(-1), 0, 255).astype(np.uint8)).save(root / "masks" / "images" / name)
    settings = ("scene=transforms", f"scene.root={root}", f"scene.cache_dir={tmp_path}/cache", "scene.masks=masks")
    (said,) = warnings(caplog, *settings)
    assert "8 of 8" not in said
    assert "show nothing: images/p_1.png (all 0, 0, 0)" in said
    assert "scene.masks_keep" in said


def test_cameras_that_look_away_are_said_with_the_cure(caplog, tmp_path):
    known = Known(c2w=ring(20) * [1, -1, -1, 1])
    root = write_transforms(tmp_path / "c", known)
    said = warnings(caplog, "scene=transforms", f"scene.root={root}", f"scene.cache_dir={tmp_path}/cache")
    assert any("OpenCV's axes rather than OpenGL's" in each and "negate the second and third" in each for each in said)
