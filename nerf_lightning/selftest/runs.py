"""The command line at work: trained in one go, stopped and resumed, filmed. In processes of their own.

They take most of a self-test's time, nearly all of it for starting up; so two chains of them run beside the other
checks, on one core each.
"""

import subprocess
import sys
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from nerf_lightning.selftest.scene import write_npz

STEPS, STOP = 40, 20
FILM_VIEWS = (0, 5)
LAST_LINES = 300
MOST_SECONDS = 900

# A hash grid behind an occupancy grid, which has all the state that a run can have. A constant rate, since the two
# runs are meant to be of different lengths at first; a tile that is named, since each run would measure its own.
SETTINGS = (
    "model=fast_small", "encoder.num_levels=4", "encoder.log2_table_size=10", "encoder.max_resolution=32",
    "field.width=16", "model.levels.fine.sampler.resolution=16", "model.levels.fine.sampler.num_steps=48",
    "data.batch_rays=256", "data.sample_budget=4000", "data.val_rays=128", "scheduler=constant",
    "trainer.tile_points=8192", "evaluation.num_pictures=0", "evaluation.num_worst=0", "logger=none",
    "path=photographs", f"path.views=[{FILM_VIEWS[0]},{FILM_VIEWS[1]}]", "path.num_frames=2",
)  # fmt: skip
LENGTH_MARK = "trainer.max_steps"


class Runs:
    """Runs of the command line that begin when this is made, each waited for when it is asked for.

    Args:
        folder: where to; it is theirs.
        overrides: of every command: the trainer that the user has chosen.
    """

    def __init__(self, folder: Path, overrides: list[str]):
        self.folder, self.overrides = folder, [*overrides, "trainer.num_threads=1"]
        self.pool = ThreadPoolExecutor(2, thread_name_prefix="command-line")
        self.started: list[subprocess.Popen[str]] = []
        capture = folder / "ball.npz"
        write_npz(capture)
        scene = ["scene=npz", f"scene.path={capture}"]
        self._whole: Future[Path] = self.pool.submit(self._train_whole, scene)
        self._resumed: Future[Path] = self.pool.submit(self._train_in_two_parts, scene)
        self._film: Future[Path] = self.pool.submit(self._render)

    def whole(self) -> Path:
        """Return the run folder of a training in one go, evaluated and filmed."""
        return self._whole.result()

    def resumed(self) -> Path:
        """Return the run folder of the same training, stopped in the middle and resumed."""
        return self._resumed.result()

    def film(self) -> Path:
        """Return the folder of a film of two frames, as PNG files, of the whole run's checkpoint."""
        return self._film.result()

    def close(self) -> None:
        """End what still runs, and wait for it: the folder may be removed then."""
        self.pool.shutdown(wait=False, cancel_futures=True)
        for process in self.started:
            process.kill()
        self.pool.shutdown(wait=True)

    def _train_whole(self, scene: list[str]) -> Path:
        path = self.folder / "whole"
        self._nerf("train", *scene, *SETTINGS, f"{LENGTH_MARK}={STEPS}", f"paths.output_dir={path}")
        return path

    def _train_in_two_parts(self, scene: list[str]) -> Path:
        path, bare = self.folder / "resumed", ["final.evaluate=false", "final.video=false"]
        settings = [*scene, *SETTINGS, *bare]
        self._nerf("train", *settings, f"{LENGTH_MARK}={STOP}", f"paths.output_dir={path}")
        self._nerf("train", f"resume={path}", f"{LENGTH_MARK}={STEPS}")
        return path

    def _render(self) -> Path:
        path, views = self.folder / "film", ",".join(map(str, FILM_VIEWS))
        shown = ["format=frames", "outputs=[rgb]", "path=photographs", f"path.views=[{views}]", "path.num_frames=2"]
        checkpoint = self.whole() / "checkpoints" / "last.ckpt"
        self._nerf("render", f"ckpt={checkpoint}", *shown, f"paths.output_dir={path}")
        return path / "video"

    def _nerf(self, *arguments: str) -> None:
        command = [sys.executable, "-m", "nerf_lightning", *arguments, *self.overrides]
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace"
        )
        self.started.append(process)
        try:
            output, _ = process.communicate(timeout=MOST_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            output, _ = process.communicate()
            output += f" (stopped after {MOST_SECONDS} seconds)"
        if process.returncode:
            said = " ".join(output.split())[-LAST_LINES:]
            raise RuntimeError(f"nerf {arguments[0]} ended with exit code {process.returncode}: {said}")
