"""Train, resume, evaluate and render in one process, again and again, and watch memory and open files.

    python tests/soak.py [SECONDS]

One line a round. Ends with 1 where the memory of the later rounds is more than that of the earlier ones by a tenth and
64 MB, or where files stay open.
"""

import contextlib
import gc
import io
import logging
import statistics
import sys
import tempfile
import time
import warnings
from pathlib import Path

import psutil

from nerf_lightning.cli import main as cli

# Rounds until caches, kernels and the allocator have settled.
WARM_UP = 3
MEGABYTE = 1e6
SCENE = ("scene=bricks", "scene.resolution=32", "scene.num_train=8", "scene.num_val=2", "scene.num_test=2")
SMALL = (
    "model=fast_small", "data.batch_rays=256", "data.val_rays=256", "trainer.val_every_steps=20",
    "trainer.max_steps=60",
    "callbacks.checkpoints.every_steps=10", "callbacks.validation_pictures.every_steps=30", "final.video=false",
    "evaluation.num_pictures=1", "trainer.tile_points=16384",
)  # fmt: skip


def nerf(*arguments: str) -> None:
    """Run a command in this process; what it says is shown where it fails."""
    sys.argv = ["nerf", *arguments]
    said = io.StringIO()
    code = 0
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            cli.main()
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 1
    if code:
        sys.exit(f"{' '.join(arguments)} ended with {code}:\n{said.getvalue()}")


def one_round(folder: Path, cache: Path) -> None:
    """A run, its continuation, its measurement, its film."""
    run, scene = folder / "run", (*SCENE, f"scene.cache_dir={cache}")
    nerf("train", *scene, *SMALL, f"paths.output_dir={run}")
    nerf("train", f"resume={run}", f"scene.cache_dir={cache}", "trainer.max_steps=100")
    last = f"ckpt={run}/checkpoints/last.ckpt"
    nerf("eval", last, "evaluation.num_pictures=1")
    nerf("render", last, "path.num_frames=4", "path.width=64")


def grows(resident: list[float], files: list[int]) -> str | None:
    """Return what the rounds after the warm-up have left behind, if anything."""
    resident, files = resident[WARM_UP:], files[WARM_UP:]
    if len(resident) < 2:
        return None
    half = len(resident) // 2
    early, late = statistics.median(resident[:half]), statistics.median(resident[-half:])
    if late > 1.1 * early + 64:
        return f"memory grew from {early:.0f} to {late:.0f} MB"
    if files[-1] > files[0]:
        return f"open files grew from {files[0]} to {files[-1]}"
    return None


def main() -> None:
    """Go round until the time is over."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 1800.0
    warnings.filterwarnings("ignore")
    logging.disable(logging.INFO)
    process, started = psutil.Process(), time.monotonic()
    resident: list[float] = []
    files: list[int] = []
    with tempfile.TemporaryDirectory() as cache:
        while time.monotonic() - started < seconds:
            with tempfile.TemporaryDirectory() as folder:
                one_round(Path(folder), Path(cache))
            gc.collect()
            resident.append(process.memory_info().rss / MEGABYTE)
            files.append(process.num_fds())
            elapsed = time.monotonic() - started
            print(
                f"round {len(files)}  {elapsed:.0f} s  {resident[-1]:.0f} MB  {files[-1]} open files  "
                f"{process.num_threads()} threads",
                flush=True,
            )
    found = grows(resident, files)
    print(found or "memory and open files are flat" + (" (too few rounds to tell)" if len(files) < WARM_UP + 2 else ""))
    sys.exit(found is not None)


if __name__ == "__main__":
    main()
