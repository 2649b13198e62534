"""The page of a run that has just been trained; whatever goes wrong costs the page alone, not the run."""

import logging
from pathlib import Path

import torch

from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.checkpoints.recorded_frame import as_trained
from nerf_lightning.commands.export import beside
from nerf_lightning.commands.train_job.build import TrainJob
from nerf_lightning.config.instantiate import build
from nerf_lightning.config.load_model import load_model
from nerf_lightning.export.page import PageExport
from nerf_lightning.messages.console import say
from nerf_lightning.messages.errors import InputError

# The path of the film, in ten seconds.
PATH = {"num_frames": 120, "fps": 12}

log = logging.getLogger(__name__)


def write_final_page(what: PageExport, job: TrainJob, folder: Path) -> None:
    """Write `page.html` into the folder of a run from its last checkpoint, or say why there is none."""
    try:
        # From the file, as nerf export does: what was trained in bfloat16 is baked in float32.
        checkpoint = read_checkpoint(folder / "checkpoints" / "last.ckpt")
        model = load_model(checkpoint).to(job.settings.device).eval()
        path = job.config.path.copy()
        path.update(PATH)
        what.beside = beside(checkpoint, as_trained(job.scene, checkpoint), build(path))
        with torch.no_grad():
            written = what.export(model, checkpoint.scene, folder, job.settings.inference_tile_points)
        say(*(f"page         {file}" for file in written))
    except Exception as error:  # out of graphics memory, a full disk, a broken compiler: the run is there all the same
        reason = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        log.warning(
            "The run is whole, but its page (final.page) could not be made: %s Once that is mended, "
            "nerf export ckpt=%s what=page makes it.",
            reason if reason.endswith(".") else f"{reason}.",
            folder,
        )
