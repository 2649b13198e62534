import pytest
import torch
from scenes import ball_scene

from nerf_lightning.checkpoints import make_record, read_checkpoint
from nerf_lightning.errors import InputError

FISHEYE = (0.1, -0.02, 0.01, 0.0, 0.0, 0.0)


def saved(path, change=lambda cameras: None):
    record = make_record(ball_scene(lens=FISHEYE, lens_model="fisheye"), config="", choices={})
    change(record["scene"]["cameras"])
    state = {"precision": "32-true", "tile_points": None}
    torch.save({"state_dict": {}, "global_step": 0, "nerf_lightning": record | state}, path / "last.ckpt")
    return path / "last.ckpt"


def test_the_lens_is_kept(tmp_path):
    cameras = read_checkpoint(saved(tmp_path)).scene.cameras
    assert cameras.lens_model == "fisheye"
    assert torch.equal(cameras.lens, torch.tensor([FISHEYE] * 6))


def test_a_checkpoint_from_before_lenses_is_a_pinholes(tmp_path):
    def forget(cameras):
        del cameras["lens"], cameras["lens_model"]

    cameras = read_checkpoint(saved(tmp_path, forget)).scene.cameras
    assert cameras.lens_model == "pinhole"
    assert cameras.lens.tolist() == [[0.0] * 6] * 6


def test_an_unknown_lens_is_refused(tmp_path):
    path = saved(tmp_path, lambda cameras: cameras.update(lens_model="squinting"))
    with pytest.raises(InputError, match="garbles lens_model 'squinting'"):
        read_checkpoint(path)
