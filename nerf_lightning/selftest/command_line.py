"""The command line, whole: a run that is resumed, a checkpoint that is read back, a film of two frames."""

import json
import subprocess
import sys
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import torch
from torch import Tensor

from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.config.load_model import load_model
from nerf_lightning.data.pixels.images import read_rgba
from nerf_lightning.data.sfm.video_frames import count_frames
from nerf_lightning.evaluation.metrics import psnr
from nerf_lightning.files.tensor_files import load_tensors
from nerf_lightning.nerf.matmul_precision import MatmulPrecision
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import render_picture
from nerf_lightning.selftest.check import Check
from nerf_lightning.selftest.scene import HELD_OUT, ball_scene, write_npz

STEPS, STOP, MOST_SECONDS = 40, 20, 900
ONE_STEP = 0.03  # The learning rate: about what a step moves a weight by
# A film through two photographs: its frames are those views.
FILM = ("path=photographs", f"path.views=[{HELD_OUT[0]},{HELD_OUT[1]}]", "path.num_frames=2")
# A hash grid behind an occupancy grid, which has all the state that a run can have. A constant rate, since the two
# runs are meant to be of different lengths at first; a tile that is named, since each run would measure its own.
SETTINGS = (
    "model=fast_small", "encoder.num_levels=4", "encoder.log2_table_size=10", "encoder.max_resolution=32",
    "field.width=16", "model.levels.fine.sampler.resolution=16", "model.levels.fine.sampler.num_steps=48",
    "data.batch_rays=256", "data.sample_budget=4000", "data.val_rays=128", "scheduler=constant",
    "trainer.tile_points=8192", "evaluation.num_pictures=0", "evaluation.num_worst=0", "logger=none", *FILM,
)  # fmt: skip


class CommandLine:
    """Runs of the command line in two chains beside the other checks: most of their time is that of starting up.

    Args:
        folder: where to write; the runs are `whole` (in one go, evaluated and filmed) and `resumed` (stopped in the
            middle), and `film` holds the frames.
        overrides: of every command.
    """

    def __init__(self, folder: Path, overrides: list[str]):
        self.folder, self.overrides = folder, [*overrides, "trainer.num_threads=1"]
        write_npz(folder / "ball.npz")
        self.pool = ThreadPoolExecutor(2)
        self.chains: list[Future[None]] = [self.pool.submit(self._train_and_film), self.pool.submit(self._resume)]

    def finished(self) -> Path:
        """Wait for all runs, and return the folder."""
        for chain in self.chains:
            chain.result()
        return self.folder

    def _train_and_film(self) -> None:
        self._train("whole", f"trainer.max_steps={STEPS}")
        checkpoint = self.folder / "whole" / "checkpoints" / "last.ckpt"
        shown = ("format=frames", "outputs=[rgb]", *FILM)
        self._nerf("render", f"ckpt={checkpoint}", *shown, f"paths.output_dir={self.folder}/film")

    def _resume(self) -> None:
        self._train("resumed", f"trainer.max_steps={STOP}", "final.evaluate=false", "final.video=false")
        self._nerf("train", f"resume={self.folder}/resumed", f"trainer.max_steps={STEPS}")

    def _train(self, name: str, *more: str) -> None:
        scene = ("scene=npz", f"scene.path={self.folder}/ball.npz")
        self._nerf("train", *scene, *SETTINGS, f"paths.output_dir={self.folder}/{name}", *more)

    def _nerf(self, *arguments: str) -> None:
        command = [sys.executable, "-m", "nerf_lightning", *arguments, *self.overrides]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=MOST_SECONDS)
        if done.returncode:
            said = " ".join(f"{done.stdout} {done.stderr}".split())[-300:]
            raise RuntimeError(f"nerf {arguments[0]} ended with exit code {done.returncode}: {said}")


def checks(runs: CommandLine, device: torch.device, matmul_precision: MatmulPrecision) -> list[Check]:
    """Return the checks of what the command line leaves on the disk."""
    resume = (0.1, "GPUs add in any order, and Adam makes whole steps of rounding where gradients are all but zero")
    if device.type == "cpu":
        resume = (0.0, "on the CPU a resumed run is the uninterrupted one, bit for bit")
    return [
        Check(
            f"resume at step {STOP} of {STEPS}: share of the state that differs", *resume,
            lambda: state_apart(runs.finished(), 0.0 if device.type == "cpu" else ONE_STEP),
        ),
        Check(
            "checkpoint read back: PSNR of the held-out views, dB", 0.01, "only tiles and rounding differ",
            lambda: _psnr_apart(runs.finished(), device, matmul_precision),
        ),
        Check(
            "film: two frames against the same pictures rendered here, levels of 255", 1.0, "colours are rounded",
            lambda: _frames_apart(runs.finished(), device, matmul_precision),
        ),
        Check(
            "film: frames missing from the video (mp4)", 0.0, "two were asked for",
            lambda: abs(count_frames(runs.finished() / "whole" / "video.mp4") - 2),
        ),
    ]  # fmt: skip


def state_apart(folder: Path, tolerance: float) -> float:
    """Return the share of a resumed run's state that is not the uninterrupted one's; with a tolerance, of weights."""
    paths = (folder / run / "checkpoints" / "last.ckpt" for run in ("whole", "resumed"))
    whole, resumed = (_state(path, tolerance == 0) for path in paths)
    if whole.keys() != resumed.keys():
        raise ValueError(f"one state lacks {sorted(whole.keys() ^ resumed.keys())[:3]}")
    differ = sum(int(((whole[name] - resumed[name]).abs() > tolerance).sum()) for name in whole)
    return differ / sum(tensor.numel() for tensor in whole.values())


def _state(path: Path, whole: bool) -> dict[str, Tensor]:
    """Return the weights of a checkpoint by name; if `whole`, its grid, the optimizer's state and progress, too."""
    content = load_tensors(path)
    found: dict[str, Tensor] = {name: value.double() for name, value in content["state_dict"].items()}
    if not whole:
        return {name: value for name, value in found.items() if name.endswith((".table", "mlp.0", "mlp.1"))}
    progress = sorted(content["nerf_lightning"]["progress"].items())
    found["progress"] = torch.tensor([float(value) for _, value in progress])
    for number, state in content["optimizer_states"][0]["state"].items():
        found |= {f"optimizer.{number}.{name}": torch.as_tensor(value).double() for name, value in state.items()}
    return found


def _pictures(folder: Path, device: torch.device, matmul_precision: MatmulPrecision) -> list[Tensor]:
    """Return the held-out views as the finished run's model renders them here, (height width 3) each."""
    checkpoint = read_checkpoint(folder / "whole" / "checkpoints" / "last.ckpt")
    model, scene = load_model(checkpoint).to(device), checkpoint.scene
    model.set_precision(matmul_precision)
    rays = RayGenerator(scene.cameras, scene.near, scene.far)
    return [render_picture(model, rays, view, scene.background, 1 << 16).rgb.cpu() for view in HELD_OUT]


def _psnr_apart(folder: Path, device: torch.device, matmul_precision: MatmulPrecision) -> float:
    views = [ball_scene().pixels.view(view).float() / 255.0 for view in HELD_OUT]
    pictures = _pictures(folder, device, matmul_precision)
    errors = [(seen - v[..., :3] * v[..., 3:]).square().mean() for seen, v in zip(pictures, views, strict=True)]
    measured = json.loads((folder / "whole" / "metrics.json").read_text())["psnr"]
    return abs(sum(float(psnr(error)) for error in errors) / len(errors) - measured)


def _frames_apart(folder: Path, device: torch.device, matmul_precision: MatmulPrecision) -> float:
    files = sorted((folder / "film" / "video").glob("*.png"))
    if len(files) != len(HELD_OUT):
        raise ValueError(f"{len(files)} frames were written, and {len(HELD_OUT)} were asked for")
    written = torch.stack([torch.from_numpy(read_rgba(file)[..., :3].copy()).float() for file in files])
    seen = torch.stack(_pictures(folder, device, matmul_precision))
    return float((255.0 * seen.clamp(0, 1) - written).abs().max())
