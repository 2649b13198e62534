"""Refined cameras from the command line: trained, said, measured, measured again, and exported."""

import json

import pytest
import torch
from support.posed_captures import Known, wall, write_llff
from support.running import FAST, FAST_PATH, done

from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.evaluation import camera_fit
from nerf_lightning.nerf.geometry.world_frame import poses_from_user

SETTINGS = (*[x for x in FAST if not x.startswith(("model=", "data.batch", "data.crop", "trainer.max_steps"))],
            *FAST_PATH, "trainer.max_steps=20", "final.video=false")  # fmt: skip


@pytest.mark.minutes
def test_a_run_says_how_far_its_cameras_moved_and_every_command_uses_them(nerf, capture, tmp_path):
    with pytest.MonkeyPatch.context() as patch:  # how close fitted cameras come is tried where they are fitted
        patch.setattr(camera_fit, "NUM_STEPS", 6)
        refined_cameras_are_used(nerf, capture, tmp_path)


def refined_cameras_are_used(nerf, capture, tmp_path):
    settings = (*SETTINGS, "refinement=se3", "encoder.blend_in=0.3", f"paths.output_dir={tmp_path / 'run'}")
    result = done(nerf("train", "scene=npz", f"scene.path={capture}", *settings))
    assert "cameras      refined: half of them moved by more than" in result.out
    checkpoint = tmp_path / "run" / "checkpoints" / "last.ckpt"
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["protocol"]["cameras"] == "refined"
    assert metrics["origin"]["config"]
    done(nerf("eval", f"ckpt={checkpoint}", f"paths.output_dir={tmp_path / 'eval'}", "evaluation.max_views=2"))
    again = json.loads((tmp_path / "eval" / "metrics.json").read_text())
    assert again["protocol"] == metrics["protocol"]
    assert again["psnr"] == pytest.approx(metrics["psnr"], abs=1e-3)
    result = done(nerf("export", f"ckpt={checkpoint}", "what=cameras", f"paths.output_dir={tmp_path / 'export'}"))
    assert "the cameras are the refined ones" in result.out
    record, given = read_checkpoint(checkpoint).scene, read_checkpoint(checkpoint).given_cameras
    frames = json.loads((tmp_path / "export" / "transforms.json").read_text())["frames"]
    written = torch.tensor([frame["transform_matrix"] for frame in frames], dtype=torch.float64)[:, :3]
    back = torch.linalg.inv(record.to_user.double())
    torch.testing.assert_close(written, poses_from_user(record.cameras.c2w.double(), back), atol=1e-6, rtol=0)
    assert float((record.cameras.c2w - given.c2w).abs().max()) > 1e-4


def test_a_scene_whose_rays_are_bent_is_refused_with_the_reason(nerf, tmp_path):
    root = write_llff(tmp_path, Known(c2w=wall()))
    result = nerf("train", "scene=llff", f"scene.root={root}", "scene.space=ndc", *SETTINGS, "refinement=se3",
                  f"paths.output_dir={tmp_path / 'run'}")  # fmt: skip
    assert result.code == 2, result.err
    for part in ("normalized device coordinates", "scene.space=contracted", "refinement=none"):
        assert part in result.err.splitlines()[-1]
    assert not (tmp_path / "run").exists()
