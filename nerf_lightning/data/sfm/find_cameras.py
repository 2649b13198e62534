"""Find cameras in successive attempts, as long as photographs are left out."""

import logging
from pathlib import Path
from typing import Any

from nerf_lightning.data.sfm.gps import align_to_gps
from nerf_lightning.data.sfm.photograph_folder import FoundPhotograph
from nerf_lightning.data.sfm.reconstruction import (
    WITHOUT_DEPTH,
    NothingFoundError,
    SparseModel,
    cause_of_nothing,
    in_short,
    reconstruct,
    require_pycolmap,
)
from nerf_lightning.data.sfm.settings import SfmSettings, attempts, stage_costs
from nerf_lightning.files.made_folders import make_folder
from nerf_lightning.messages.console import StageProgress

WORSE = 1.5
"""Factor by which the reprojection error may grow if more photographs are placed."""

log = logging.getLogger(__name__)


def find_cameras(
    photographs: list[FoundPhotograph], folder: Path, work: Path, sparse: Path, settings: SfmSettings
) -> SparseModel:
    """Find the cameras of photographs and write the largest model in COLMAP's binary form.

    Poses are COLMAP's: world to camera, axes right, down, forward, in a frame and scale of its own, or in meters with z
    up if GPS is available (`align_to_gps`). Of several attempts, the one that places most photographs counts.

    Args:
        photographs: in the order in which they were taken.
        folder: contains the upright pictures under the photographs' names.
        work: a folder for databases and lists; its contents can be deleted afterward.
        sparse: the folder for cameras.bin, images.bin, points3D.bin; created here.
        settings: of structure from motion.

    Raises:
        InputError: pycolmap is missing, or one camera has photographs of several sizes.
        NothingFoundError: nothing can be reconstructed.
    """
    best: list[Any] = []
    for number, attempt in enumerate(tried := attempts(settings, len(photographs))):
        with StageProgress(stage_costs(photographs, settings, attempt)) as report:
            models = reconstruct(photographs, folder, work, settings, attempt, report)
        if models and (not best or _is_better(models[0], best[0])):
            best = models
        placed = best[0].num_reg_images() if best else 0
        cause = "" if best else cause_of_nothing(work, attempt)
        if placed == len(photographs) or cause == WITHOUT_DEPTH:
            break
        if placed and number + 1 < len(tried):
            log.info("cameras: %d of %d placed; next try: %s", placed, len(photographs), tried[number + 1])
    if not best:
        raise NothingFoundError(
            f"No camera could be placed: the {len(photographs)} pictures {cause}. Take more photographs that overlap "
            "by two thirds, from positions a few steps apart (do not turn on the spot), sharp, with one zoom and "
            "without mirrors or bare walls filling the picture; then try again.",
            cause,
        )
    align_to_gps(require_pycolmap(), best[0], folder)
    best[0].write_binary(make_folder(sparse))
    return in_short(best, [photograph.name for photograph in photographs])


def _is_better(model: Any, than: Any) -> bool:
    errors = (each.compute_mean_reprojection_error() for each in (model, than))
    return model.num_reg_images() > than.num_reg_images() and next(errors) <= WORSE * next(errors)
