import logging
import zipfile
from dataclasses import replace

import pytest
import torch
from support.budget import budget
from support.planted import write_checkpoint
from support.running import refused
from support.scenes import ball_scene

from nerf_lightning.checkpoints.reading import last_good_checkpoint, newest_checkpoint, read_checkpoint
from nerf_lightning.checkpoints.record import make_record
from nerf_lightning.config.scene_overrides import scene_overrides
from nerf_lightning.messages.errors import InputError

FISHEYE = (0.1, -0.02, 0.01, 0.0, 0.0, 0.0)


def saved(path, change=lambda cameras: None):
    record = make_record(ball_scene(lens=FISHEYE, lens_model="fisheye"), config="", choices={})
    change(record["scene"]["cameras"])
    state = {"precision": "32-true", "tile_points": None}
    torch.save({"state_dict": {}, "global_step": 0, "nerf_lightning": record | state}, path / "last.ckpt")
    return path / "last.ckpt"


def test_the_lens_is_kept_and_a_scene_that_no_checkpoint_could_keep_is_refused_before_training(tmp_path):
    scene = ball_scene()
    with budget(views=2), pytest.raises(InputError, match=r"The scene has 6 views, .* add budgets.views=6"):
        make_record(scene, config="", choices={})
    with pytest.raises(InputError, match=r"cannot be kept in a checkpoint: scene.view_names names two views alike"):
        make_record(replace(scene, view_names=("a",) * 6), config="", choices={})
    cameras = read_checkpoint(saved(tmp_path)).scene.cameras
    assert cameras.lens_model == "fisheye"
    assert torch.equal(cameras.lens, torch.tensor([FISHEYE] * 6))
    path = saved(tmp_path, lambda cameras: cameras.update(lens_model="squinting"))
    with pytest.raises(InputError, match="lens_model is 'squinting', not pinhole or"):
        read_checkpoint(path)


def keep_two(folder, bad_steps=(0, 0)):
    """The last two checkpoints of a run, of steps 8 and 7, and the best."""
    record = make_record(ball_scene(), config="", choices={}) | {"precision": "32-true", "tile_points": None}
    for name, step, in_row in (("last", 8, bad_steps[0]), ("previous", 7, bad_steps[1]), ("best", 5, 0)):
        state = {"state_dict": {"model.weight": torch.full((1000,), float(step))}, "global_step": step}
        torch.save(state | {"nerf_lightning": record | {"bad_steps": [in_row, in_row]}}, folder / f"{name}.ckpt")
    return folder / "last.ckpt"


def change_a_weight(path):
    with zipfile.ZipFile(path) as archive:
        entry = max(archive.infolist(), key=lambda item: item.file_size)
    content = bytearray(path.read_bytes())
    content[entry.header_offset + 200 + entry.file_size // 2] ^= 1
    path.write_bytes(content)


DAMAGE = {
    "a bit of a weight": change_a_weight,
    "cut off": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "no bytes": lambda path: path.write_bytes(b""),
    "zeros in front": lambda path: path.write_bytes(bytes(4096) + path.read_bytes()[4096:]),
    "zeros throughout": lambda path: path.write_bytes(bytes(path.stat().st_size)),
    "another file": lambda path: path.write_text("hello"),
    "missing": lambda path: path.unlink(),
}


def test_the_newest_is_read_and_two_damaged_ones_are_refused(tmp_path, caplog):
    keep_two(tmp_path)
    assert newest_checkpoint(tmp_path).step == 8
    assert not caplog.records
    assert newest_checkpoint(tmp_path / "nothing") is None
    DAMAGE["cut off"](keep_two(tmp_path))
    DAMAGE["no bytes"](tmp_path / "previous.ckpt")
    with pytest.raises(InputError, match=r"last\.ckpt is damaged"):
        newest_checkpoint(tmp_path)


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE.keys())
def test_a_damaged_newest_is_recognised_and_the_one_before_is_used(tmp_path, damage, caplog):
    last = keep_two(tmp_path)
    damage(last)
    with pytest.raises(InputError, match=rf"{tmp_path}/previous\.ckpt or {tmp_path}/best\.ckpt|no checkpoint at"):
        read_checkpoint(last)  # one that was named is not replaced
    with caplog.at_level(logging.WARNING):
        found = newest_checkpoint(tmp_path)
    assert found.step == 7
    assert found.weights["weight"].eq(7).all()
    assert len(caplog.records) == 1
    assert "the previous one is used instead" in caplog.text
    assert "previous.ckpt, of step 7" in caplog.text


@pytest.mark.parametrize(("bad_steps", "good"), [((0, 0), "last"), ((3, 0), "previous"), ((3, 2), None)])
def test_the_last_good_one_was_not_saved_amid_steps_that_were_left_out(tmp_path, bad_steps, good):
    keep_two(tmp_path, bad_steps)
    assert last_good_checkpoint(tmp_path) == (good and tmp_path / f"{good}.ckpt")


def test_a_run_folder_stands_for_its_newest_checkpoint(tmp_path):
    folder = tmp_path / "run" / "checkpoints"
    folder.mkdir(parents=True)
    refused(read_checkpoint, tmp_path / "run", parts=("There is no checkpoint in the folder", "checkpoints/last.ckpt"))
    write_checkpoint(folder / "last.ckpt")
    assert read_checkpoint(tmp_path / "run").path == folder / "last.ckpt"
    assert read_checkpoint(folder).path == folder / "last.ckpt"
    assert scene_overrides(str(tmp_path / "run"))[0] == "scene=bricks"
