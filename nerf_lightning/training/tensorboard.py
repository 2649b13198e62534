"""TensorBoard's names for what a run logs: it sorts groups by name, capital letters first."""

from collections.abc import Mapping
from pathlib import Path

from lightning.pytorch.loggers import TensorBoardLogger

GROUPS = (
    ("train/psnr_", "PSNR/train_"),
    ("val/psnr", "PSNR/validation"),
    ("test/psnr", "PSNR/test"),
    ("train/loss_", "Training loss/"),
    ("train/loss", "Training loss/sum"),
    ("validation/picture", "Pictures/validation"),
    ("scene/cameras", "Pictures/cameras"),
)
"""Prefixes of names and their groups. Pictures come between PSNR and losses, and histograms last."""
ALONG_RAYS, PER_RAY = "weights_along_rays/weight", "weights_per_ray/effective_samples"
WHOLE = ("val/psnr", "test/psnr", "train/loss", "validation/picture", "scene/cameras")
"""Names that are not prefixes of others."""


class OrderedTensorBoard(TensorBoardLogger):
    """TensorBoard's files, by Lightning, with names that put PSNR, pictures and losses on top.

    Args:
        save_dir: the run folder.
        name: the folder of the files, in the run folder.
        version: a folder in that one; empty: none.
        purge_step: the first step of which an earlier start's data is discarded.
    """

    def __init__(
        self, save_dir: str | Path, name: str = "tensorboard", version: str = "", purge_step: int | None = None
    ):
        super().__init__(save_dir, name=name, version=version, purge_step=purge_step)

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Write scalars under TensorBoard's names."""
        super().log_metrics({shown_name(name): value for name, value in metrics.items()}, step)


def shown_name(name: str) -> str:
    """Return the name under which TensorBoard shows a scalar or a picture.

    >>> [shown_name(name) for name in ("val/psnr", "val/psnr_standard_error", "train/loss_fine", "speed/rays_per_step")]
    ['PSNR/validation', 'val/psnr_standard_error', 'Training loss/fine', 'speed/rays_per_step']
    """
    for beginning, group in GROUPS:
        if name == beginning if beginning in WHOLE else name.startswith(beginning):
            return group + name.removeprefix(beginning)
    return name
