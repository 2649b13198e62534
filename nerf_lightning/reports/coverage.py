"""From where a scene was photographed, by the cameras that a checkpoint keeps."""

import torch

from nerf_lightning.checkpoints import SceneRecord
from nerf_lightning.export.camera_layout import coverage_picture
from nerf_lightning.reports.embedding import Embedded, embedded
from nerf_lightning.types.scene import PixelStore, Scene


def coverage(record: SceneRecord) -> Embedded:
    """Return the coverage map of a recorded scene."""
    return embedded(coverage_picture(_without_pictures(record)).numpy())


def _without_pictures(record: SceneRecord) -> Scene:
    none = torch.zeros(0, dtype=torch.long)
    pixels = PixelStore(torch.zeros(0, 4, dtype=torch.uint8), none, none, none, has_transparency=False)
    splits = {split: record.splits.get(split, ()) for split in ("train", "val", "test")}
    return Scene(**{**vars(record), "splits": splits}, pixels=pixels, protocol={}, truth=None)
