"""What the command line left: a resume that is scrambled, a checkpoint or a frame that is changed, are wrong."""

import shutil

import numpy as np
import pytest
import torch
from PIL import Image

from nerf_lightning.selftest.check import carried_out
from nerf_lightning.selftest.command_line import CommandLine, checks

# Four runs of the command line; `nerf selftest` itself is run by .ci/run.
pytestmark = pytest.mark.exhaustive


class Finished(CommandLine):
    """Runs that are there already."""

    def __init__(self, folder):
        self.folder = folder

    def finished(self):
        return self.folder


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of all runs, made once."""
    return CommandLine(tmp_path_factory.mktemp("runs"), ["trainer=cpu", "trainer.precision=32-true"]).finished()


@pytest.fixture
def copied(finished, tmp_path):
    """A copy that may be spoilt."""
    return shutil.copytree(finished, tmp_path / "runs")


def outcome(folder, name, device="cpu"):
    found = checks(Finished(folder), torch.device(device), "float32")
    return next(carried_out(check).outcome for check in found if check.name.startswith(name))


def change(folder, run, fault):
    path = folder / run / "checkpoints" / "last.ckpt"
    content = torch.load(path, weights_only=True)
    fault(content)
    torch.save(content, path)


def test_what_the_command_line_leaves_is_right(finished):
    rows = [carried_out(check) for check in checks(Finished(finished), torch.device("cpu"), "float32")]
    assert [row.outcome for row in rows] == ["ok"] * 4, rows


def other_weight(content):
    content["state_dict"]["model.levels.fine.field.density_mlp.0"][0, 0] += 1e-6


def other_moment(content):
    content["optimizer_states"][0]["state"][0]["exp_avg"].view(-1)[0] += 1e-9


def other_grid(content):
    content["state_dict"]["model.levels.fine.sampler.grid.cells"].view(-1)[0] ^= 1


def other_place(content):
    content["nerf_lightning"]["progress"]["rays_seen"] += 1


def no_optimizer(content):
    content["optimizer_states"][0]["state"].popitem()


@pytest.mark.parametrize("fault", [other_weight, other_moment, other_grid, other_place, no_optimizer])
def test_a_resume_that_ends_elsewhere_is_wrong(fault, copied):
    change(copied, "resumed", fault)
    assert outcome(copied, "resume") == "wrong"


def another_order_of_rays(content):
    table = content["state_dict"]["model.levels.fine.field.position_encoder.table"]
    table += 0.05 * torch.randn(table.shape)


def test_on_a_gpu_other_weights_are_wrong_and_rounding_is_not(copied):
    change(copied, "resumed", other_weight)
    assert outcome(copied, "resume", "cuda") == "ok"
    change(copied, "resumed", another_order_of_rays)
    assert outcome(copied, "resume", "cuda") == "wrong"


def test_films_with_other_colours_or_without_a_frame_and_checkpoints_that_lost_weights_are_wrong(copied):
    frame = copied / "film" / "video" / "frame_0001.png"
    picture = np.array(Image.open(frame))
    picture[3, 4, 0] ^= 2
    Image.fromarray(picture).save(frame)
    assert outcome(copied, "film: two frames") == "wrong"
    frame.unlink()
    assert outcome(copied, "film: two frames") == "wrong"
    change(copied, "whole", lambda content: content["state_dict"]["model.levels.fine.field.color_mlp.1"].mul_(0.5))
    assert outcome(copied, "checkpoint") == "wrong"


def test_a_command_that_fails_is_quoted(tmp_path):
    with pytest.raises(RuntimeError, match=r"nerf train ended with exit code 2: .*trainer\.precision=quantum"):
        CommandLine(tmp_path, ["trainer=cpu", "trainer.precision=quantum"]).finished()
