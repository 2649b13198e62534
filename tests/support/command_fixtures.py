"""A capture that a command can read, a finished run on it, and ways to call `nerf`."""

import csv
import os
import sys
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from support.made_once import made_once
from support.resumed import trained
from support.running import FAST, FAST_PATH, NO_LAYOUT, output_of, start_cold
from support.scenes import ball_scene

from nerf_lightning.cli import main as cli
from nerf_lightning.data.readers.npz import NpzReader


@dataclass
class Result:
    """What a command left."""

    code: int
    out: str
    err: str


@pytest.fixture(scope="session")
def capture(tmp_path_factory):
    """The ball as an npz file."""
    return made_once(tmp_path_factory, "capture", save_ball) / "ball.npz"


def save_ball(folder):
    scene = ball_scene(num_views=10, size=16, background="black")
    pictures = torch.stack([scene.pixels.view(view) for view in range(10)]).float() / 255
    poses = torch.eye(4).repeat(10, 1, 1)
    poses[:, :3] = scene.cameras.c2w
    images = (pictures[..., :3] * pictures[..., 3:]).numpy()
    np.savez(folder / "ball.npz", images=images, poses=poses.numpy(), focal=1.6 * 16)
    NpzReader(str(folder / "ball.npz")).read()  # so that no command says that it has cached the pictures


@pytest.fixture
def nerf(monkeypatch, capfd):
    """Call the command line in this process."""

    def call(*arguments: str) -> Result:
        monkeypatch.setattr(sys, "argv", ["nerf", *map(str, arguments)])
        capfd.readouterr()
        code, environment = 0, dict(os.environ)
        try:
            cli.main()
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 1
        finally:
            # What a command says to the processes that it starts is not said to those of later tests.
            for name in os.environ.keys() - environment.keys():
                del os.environ[name]
            monkeypatch.undo()
        return Result(code, *capfd.readouterr())

    return call


@pytest.fixture
def train(nerf, capture, tmp_path):
    """Call `nerf train` on the ball, as small as a test wants it, into tmp_path/run."""
    place = ("scene=npz", f"scene.path={capture}", *FAST, f"paths.output_dir={tmp_path}/run")
    return lambda *settings: nerf("train", *place, *settings)


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory, capture):
    """A run of 20 steps, evaluated and filmed."""

    def train(folder):
        steps = ("trainer.max_steps=20", f"paths.output_dir={folder}/run")
        # Most other runs of the tests are forks; this one is as whole as a person's.
        whole = [setting for setting in FAST if setting != NO_LAYOUT]
        output = output_of(start_cold("nerf_lightning", "train", "scene=npz", f"scene.path={capture}", *whole, *steps))
        assert "Traceback" not in output
        assert "Exception ignored" not in output
        (folder / "run" / "output.txt").write_text(output)

    return made_once(tmp_path_factory, "finished", train) / "run"


@pytest.fixture
def table(nerf, tmp_path):
    """Call `nerf table` on tmp_path/runs; return what it printed and the rows of its CSV."""

    def call(*arguments):
        out = tmp_path / "out"
        result = nerf("table", tmp_path / "runs", f"out={out}", *arguments)
        written = out / "table.csv"
        return result, list(csv.DictReader(written.read_text().splitlines())) if result.code == 0 else []

    return call


@pytest.fixture(scope="session")
def stopped(tmp_path_factory, capture):
    """A run whose optimizer is fused Adam."""
    return made_once(tmp_path_factory, "stopped", lambda folder: trained(folder, capture)) / "run"


@pytest.fixture(scope="session")
def stopped_fast(tmp_path_factory, capture):
    """A run with an occupancy grid, and the optimizer of tables."""
    return made_once(tmp_path_factory, "stopped_fast", lambda folder: trained(folder, capture, *FAST_PATH)) / "run"
