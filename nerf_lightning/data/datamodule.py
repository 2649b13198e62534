"""The LightningDataModule: flattens every picture of a scene into ray batches.

Batch size and other numbers: `conf/data/rays.yaml`, and those of each model in `conf/model/`.
"""

import logging
from dataclasses import replace
from typing import Literal

import torch
from lightning.pytorch import LightningDataModule

from nerf_lightning.compute import ranks
from nerf_lightning.compute.machine import free_memory, require_memory
from nerf_lightning.data.pixels.placement import budget_bytes, num_bytes, on_device
from nerf_lightning.data.ray_batches import FixedRays, RayBatches, WholeViews
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.subset import evenly_spaced_subset
from nerf_lightning.nerf.ranges import require_ranges
from nerf_lightning.nerf.types.progress import Progress, batch_sizes
from nerf_lightning.nerf.types.rays import Batch
from nerf_lightning.nerf.types.scene import DRAWN, Scene

# Of a batch, at least: the places of its pixels, its rays, and their colors.
RAY_BYTES = 120

log = logging.getLogger(__name__)


class RayDataModule(LightningDataModule):
    """Ray batches for training, and a fixed subset of rays for validation.

    Args:
        scene: as returned by a reader.
        progress: the run's progress, shared with the system.
        seed: the run's seed.
        batch_rays: rays per training step (the batch size); with a budget, the maximum.
        sample_budget: the target number of visible samples per step, to which the number of rays adapts in a few fixed
            sizes; None: a fixed number of rays. As empty space is skipped, steps then take equally long and see more
            rays; larger budgets make them steadier and slower. Needs a model that skips empty space.
        crop_steps: initial steps that see only the centers of the images.
        crop_fraction: share of each side that the crop keeps.
        restart_crop_steps: the minimum of crop_steps after a restart by the collapse guard.
        val_rays: size of the validation subset.
        device_budget: gigabytes of GPU memory for pixels. If they fit, they are moved there and batches are made there;
            0 keeps them on the host, auto is half of the free memory.
        prefetch: make the next batch in a background thread while a step runs; auto: if several cores or a GPU can do
            both at once, or if a mapped file exceeds the memory. The batches are the same.
        patch: side in pixels of the square patches of training rays, as the loss requires.
        overfit_views: train on this number of photographs, spread over all, without jitter, and validate on them, to
            check that a model can overfit; None: train on all.
        depth_every: one in `depth_every` rays passes through a pixel of known distance, as the loss requires; 0: none.
        views_per_step: take the rays of a step from this number of photographs, equally many of each, for models that
            render each photograph from others; None: from all.
        candidates: pixels of which a ray shows one, more often where photographs have contrast, with a weight that
            makes up for it; 1: all pixels alike. Ignored with `views_per_step` and losses that look at squares.
    """

    def __init__(
        self,
        scene: Scene,
        progress: Progress,
        seed: int,
        batch_rays: int = 1024,
        sample_budget: int | None = None,
        crop_steps: int = 0,
        crop_fraction: float = 0.5,
        restart_crop_steps: int = 500,
        val_rays: int = 4096,
        device_budget: int | float | Literal["auto"] = "auto",
        prefetch: bool | Literal["auto"] = "auto",
        patch: int = 1,
        overfit_views: int | None = None,
        views_per_step: int | None = None,
        depth_every: int = 0,
        candidates: int = 1,
    ):
        super().__init__()
        for name, value in (("batch_rays", batch_rays), ("val_rays", val_rays)):
            if value < 1:
                raise InputError(f"data.{name}={value}: at least one ray is needed. Give a positive number.")
            require_memory(f"data.{name}={value}", value, lambda n: RAY_BYTES * n, f"data.{name}={{}}".format)
        least = batch_rays if sample_budget is None else batch_sizes(batch_rays)[-1]
        least = max(1, least // patch**2)
        if min(least, val_rays) < ranks.world_size():
            raise InputError(
                f"data.batch_rays={batch_rays} and data.val_rays={val_rays} leave some of {ranks.world_size()} "
                "processes without a ray. Raise them, or use fewer devices."
            )
        require_ranges({"data.candidates": candidates}, {"data.candidates": (1, 64)})
        if sample_budget is not None and (sample_budget < 1 or crop_steps):
            raise InputError(
                f"data.sample_budget={sample_budget} with data.crop_steps={crop_steps}: give a positive budget and no "
                "crop (whose length is counted in batches of one size), or data.sample_budget=null."
            )
        if device_budget != "auto" and device_budget < 0:
            raise InputError(f"data.device_budget={device_budget}: give gigabytes, 0 for none, or auto.")
        if not 0 < crop_fraction <= 1:
            raise InputError(f"data.crop_fraction={crop_fraction} is a share of the picture's side: between 0 and 1.")
        _check_background(scene)
        _check_patch(scene, patch, batch_rays)
        if not scene.splits.get("train"):
            raise InputError(f"The scene {scene.name} has no train views, and training needs some.")
        if overfit_views is not None:
            scene = _few_views(scene, overfit_views)
        _check_views_per_step(views_per_step, batch_rays, sample_budget, patch, depth_every)
        self.scene = scene
        self.batches = RayBatches(scene, progress, seed, batch_rays, patch, views_per_step, depth_every, candidates)
        self.batches.crop_to(crop_fraction, crop_steps, restart_crop_steps)
        self.val_rays = val_rays
        self.device_budget, self.prefetch = device_budget, prefetch

    def setup(self, stage: str) -> None:
        """Move the pixels to where this process trains."""
        self.settle(self.trainer.strategy.root_device)  # type: ignore[union-attr]

    def settle(self, device: torch.device) -> None:
        """Move the pixels to the device if they fit the budget; else decide whether batches are made ahead for it."""
        if self.batches.scene is not self.scene:  # they have moved already
            return
        if self.fits(device):
            self.batches.take_from(on_device(self.scene, device))
            return
        from_disk = num_bytes(self.scene.pixels) > free_memory()
        helps = device.type != "cpu" or from_disk or torch.get_num_threads() > 1
        self.batches.prefetch_for = device if (helps if self.prefetch == "auto" else self.prefetch) else None

    def fits(self, device: torch.device) -> bool:
        """Return whether to move the pixels to a device."""
        return device.type != "cpu" and num_bytes(self.scene.pixels) <= budget_bytes(self.device_budget, device)

    def train_dataloader(self) -> RayBatches:
        """Return the training batches; an epoch shows every ray once, or, if steps are counted, lasts for all steps."""
        trainer = self.trainer
        counts_steps = trainer is not None and trainer.max_epochs == -1 and trainer.max_steps != -1
        self.batches.num_steps = trainer.max_steps if counts_steps else self.batches.epoch_steps  # type: ignore[union-attr]
        return self.batches

    def val_dataloader(self) -> FixedRays | list[Batch]:
        """Return the fixed validation rays; an empty list, which Lightning skips, without validation views."""
        if not self.scene.splits.get("val"):
            return []
        return FixedRays(self.scene, "val", self.val_rays, self.batches.batch_rays)

    def test_dataloader(self) -> WholeViews:
        """Return the test views, each a batch of height x width pixels."""
        return WholeViews(self.scene, "test")

    def predict_dataloader(self) -> WholeViews:
        """Return the test views, to be rendered."""
        return self.test_dataloader()


def _few_views(scene: Scene, count: int) -> Scene:
    """Return the scene with a few training views, which also serve for validation; the test views stay."""
    if count < 1:
        raise InputError(f"data.overfit_views={count}: give at least one photograph, or null to train on all.")
    few = tuple(evenly_spaced_subset(scene.splits["train"], count))
    return replace(scene, splits=scene.splits | {"train": few, "val": few})


def _check_views_per_step(
    views: int | None, batch_rays: int, sample_budget: int | None, patch: int, depth_every: int
) -> None:
    if views is None:
        return
    if not 1 <= views <= batch_rays or batch_rays % views:
        raise InputError(
            f"data.views_per_step={views} with data.batch_rays={batch_rays}: each photograph of a step gets as many "
            "rays as the others. Give a number of photographs that divides the number of rays, or null."
        )
    if sample_budget is not None or patch > 1 or depth_every:
        raise InputError(
            f"data.views_per_step={views} cannot be combined with data.sample_budget, whose steps have no fixed number "
            "of rays, or with losses that look at squares of pixels (loss.patch) or at known distances (loss=depth). "
            "Give data.sample_budget=null and another loss, or data.views_per_step=null."
        )


def _check_background(scene: Scene) -> None:
    if scene.background == "none" and scene.pixels.has_transparency:
        raise InputError(
            f"The pictures of {scene.name} have transparent pixels, so something lies behind the scene, and "
            "scene.background=none would train on colors without their alpha. Use white, black or random."
        )
    if scene.background in DRAWN and not scene.pixels.has_transparency:
        log.warning(
            "scene.background=%s: the pictures of %s have no transparent pixels, so whatever lies behind the scene is "
            "part of them and is learned as solid content. Give the background's color instead (scene.background=black "
            "or white).",
            scene.background,
            scene.name,
        )


def _check_patch(scene: Scene, patch: int, batch_rays: int) -> None:
    together = patch**2
    if batch_rays % together:
        fitting = max(1, round(batch_rays / together)) * together
        raise InputError(
            f"loss.patch={patch} draws squares of {together} pixels, and data.batch_rays={batch_rays} is not a "
            f"multiple of that. Give data.batch_rays={fitting}, or a smaller loss.patch."
        )
    train = torch.tensor(scene.splits.get("train", ()), dtype=torch.int64)
    small = train[torch.minimum(scene.pixels.width, scene.pixels.height)[train] < patch].tolist()
    if small:
        view = small[0]
        raise InputError(
            f"loss.patch={patch} draws squares of {patch} x {patch} pixels, and {scene.view_names[view]} of "
            f"{scene.name} has {int(scene.pixels.width[view])} x {int(scene.pixels.height[view])}. Give a smaller "
            "loss.patch (4 or more), or larger pictures (scene.downscale)."
        )
