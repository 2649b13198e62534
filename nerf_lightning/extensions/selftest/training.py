"""Small trainings of each kind of model, in every precision of the device, compared with the CPU in float32."""

from collections.abc import Sequence
from functools import cache, partial

import torch
from torch import Tensor

from nerf_lightning.config.compose import compose_config
from nerf_lightning.data.pixels.placement import on_device
from nerf_lightning.data.ray_batches import FixedRays, RayBatches
from nerf_lightning.extensions.selftest.check import Check, gradient_bound, norm_apart
from nerf_lightning.nerf.encoders.base import tables_of
from nerf_lightning.nerf.geometry.cameras import all_pixels, pinhole_cameras, rays_through_pixels
from nerf_lightning.nerf.geometry.poses import look_at
from nerf_lightning.nerf.kernels.backends import CPU_BACKENDS, without
from nerf_lightning.nerf.matmul_precision import MatmulPrecision, set_precision
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.nerf.types.scene import PixelStore, Scene
from nerf_lightning.training.build_step import build_step
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.training.validation import RayErrors

RADIUS = 0.8
NUM_VIEWS, SIZE = 10, 20
FOCAL = 1.6 * SIZE
TRAIN, HELD_OUT = tuple(range(8)), (8, 9)


def ball_scene() -> Scene:
    """Return ten small views from a circle, with alpha; eight are for training, two are held out."""
    angle = 2.4 * torch.arange(NUM_VIEWS)  # the golden angle: all parts of the views are spread over the circle
    eyes = 4.0 * torch.stack([angle.cos(), angle.sin(), 0.4 + 0.0 * angle], dim=-1)
    cameras = pinhole_cameras(look_at(eyes, torch.zeros_like(eyes), torch.tensor([0.0, 0.0, 1.0])), FOCAL, SIZE, SIZE)
    near, far = torch.full((NUM_VIEWS,), 2.0), torch.full((NUM_VIEWS,), 6.5)
    pictures = []
    for view in range(NUM_VIEWS):
        rays = rays_through_pixels(cameras, all_pixels(cameras, view), near, far)
        along = -(rays.origins * rays.directions).sum(-1)
        closest = rays.origins + along[..., None] * rays.directions
        half = (RADIUS**2 - closest.square().sum(-1)).clamp(min=0).sqrt()
        normal = (closest - half[..., None] * rays.directions) / RADIUS
        hit = (half > 0).float()[..., None]
        pictures.append(torch.cat([(0.5 + 0.5 * normal).clamp(0, 1) * hit, hit], dim=-1))
    rgba = (torch.stack(pictures) * 255).round().to(torch.uint8).reshape(-1, 4)
    sizes = torch.full((NUM_VIEWS,), SIZE)
    return Scene(
        name="ball",
        cameras=cameras,
        pixels=PixelStore(rgba, torch.arange(NUM_VIEWS) * SIZE**2, sizes, sizes, has_transparency=True),
        near=near,
        far=far,
        aabb=torch.tensor([[-1.0] * 3, [1.0] * 3]),
        splits={"train": TRAIN, "val": HELD_OUT, "test": HELD_OUT},
        view_names=tuple(f"ball_{view}" for view in range(NUM_VIEWS)),
        background="random",
        to_user=torch.eye(4, dtype=torch.float64),
        protocol={},
        truth=None,
    )


SEED, STEPS, BATCH_RAYS, TILE_POINTS = 7, 60, 192, 4096
ENCODER = (
    *("encoder.num_levels=4", "encoder.features_per_level=4", "encoder.log2_table_size=11"),
    *("encoder.min_resolution=4", "encoder.max_resolution=48", "field.width=32"),
)
# Keep all samples: where almost no light is left, rounding decides whether the last one is visible, and however little
# of it is seen, Adam scales its gradients up to full steps (fast_small in bfloat16: 0.36 dB apart instead of 0.005).
GRID = tuple(
    f"model.levels.fine.sampler.{each}"
    for each in ("resolution=16", "num_steps=48", "update_every=8", "warmup_steps=16", "opaque_below=0.0")
)
METHODS = {
    "nerf_tiny": ("optimizer.lr=5e-3",),
    "fast_small": (*ENCODER, *GRID),
    "fast_dense": (*ENCODER, *GRID),
    "fast_proposal": ENCODER,
}
"""Settings that make the models of conf/model small."""
LAYERS = 6
"""Maximum number of consecutive matrix products in a forward pass, over which rounding adds up."""
# Over 8 seeds, which change rays, jitter and weights at once, the PSNR of these trainings has a standard deviation of
# 0.5 to 0.75 dB. The effect of rounding on a run must be smaller if products have 8 or 11 bits (of five runs of
# fast_dense with factors rounded to 11 bits at random, one was 0.21 dB off), and a tenth of that if only the order
# differs.
PSNR_APART: dict[MatmulPrecision, float] = {"float32": 0.05, "tf32": 0.5, "bfloat16": 0.5}
LEARNT = 1e4  # Tables start between -1e-4 and 1e-4, and grow to about 1
CPU = torch.device("cpu")


class Training:
    """A training that is set up."""

    def __init__(self, method: str, device: torch.device, matmul_precision: MatmulPrecision, tile_points: int | None):
        scene, progress = ball_scene(), Progress()
        config = compose_config("train", [f"model={method}", f"seed={SEED}", *METHODS[method]]).config
        settings = TrainerSettings(max_steps=STEPS, accelerator="cpu", precision="32-true", tile_points=tile_points)
        self.train_step = build_step(config, settings, scene, progress)
        self.train_step.objective.to(device)
        self.train_step.num_steps = STEPS
        set_precision(self.train_step.objective.model, matmul_precision)
        self.loader = RayBatches(on_device(scene, device), progress, SEED, BATCH_RAYS)
        self.held_out = FixedRays(scene, "val", 10**6, 400)
        self.optimizer = self.train_step.new_optimizer()

    def gradients(self) -> dict[str, Tensor]:
        """Return the gradients of the first batch, with tables scaled like trained ones."""
        # New tables are almost zero: what is done with them would hardly matter.
        with torch.no_grad():
            for table in tables_of(self.train_step.objective.model):
                table.mul_(LEARNT)
        self.optimizer.zero_grad()
        self.train_step.gradients(self.loader.batch_at(0, 0).to(self.train_step.device), self.train_step.key)
        named = self.train_step.objective.model.named_parameters()
        return {name: value.grad.clone() for name, value in named if value.grad is not None}

    def psnr(self) -> float:
        """Train, and return the PSNR of the held-out views."""
        train_step, errors = self.train_step, RayErrors()
        for _ in range(STEPS):
            train_step(self.loader.batch_at(0, train_step.progress.rays_seen).to(train_step.device), self.optimizer)
        with torch.no_grad():
            for batch in self.held_out:
                errors.of(train_step.objective, batch.to(train_step.device), train_step.tiles.points)
        if train_step.guard.skipped:
            raise ValueError(f"{train_step.guard.skipped} of {STEPS} steps had gradients that are not finite")
        return errors.summary()["val/psnr"]


def checks(device: torch.device, precisions: Sequence[MatmulPrecision]) -> list[Check]:
    """Return the checks of gradients and of whole trainings."""
    found = []
    for method in METHODS:
        for matmul_precision in precisions:
            name = f"{method}, {matmul_precision}"
            found += [
                Check(
                    f"{name}: gradients of a batch",
                    gradient_bound(matmul_precision, LAYERS),
                    f"{LAYERS} layers of {matmul_precision} products, and ReLUs within rounding of zero, which switch",
                    partial(_gradients, method, device, matmul_precision),
                ),
                Check(
                    f"{name}: PSNR after {STEPS} steps, dB",
                    PSNR_APART[matmul_precision],
                    "rounding moves a training less than another seed does, whose standard deviation is 0.5 dB",
                    partial(_psnr, method, device, matmul_precision),
                ),
            ]
    return found


@cache
def reference_gradients(method: str) -> dict[str, Tensor]:
    """Return the gradients of the first batch in plain torch on the CPU, in float32, without tiles."""
    with without(*CPU_BACKENDS):
        return Training(method, CPU, "float32", None).gradients()


@cache
def reference_psnr(method: str) -> float:
    """Return the PSNR of a training by the same means."""
    with without(*CPU_BACKENDS):
        return Training(method, CPU, "float32", None).psnr()


def gradients_apart(actual: dict[str, Tensor], expected: dict[str, Tensor]) -> float:
    """Return the norm of the difference of all of a model's gradients, over the norm of the expected ones."""
    if names := actual.keys() ^ expected.keys():
        raise ValueError(f"gradients of {sorted(names)} are there in one and not in the other")
    ours, theirs = (torch.cat([each[name].cpu().flatten() for name in expected]) for each in (actual, expected))
    return norm_apart(ours, theirs)


def _gradients(method: str, device: torch.device, matmul_precision: MatmulPrecision) -> float:
    found = Training(method, device, matmul_precision, TILE_POINTS).gradients()
    return gradients_apart(found, reference_gradients(method))


def _psnr(method: str, device: torch.device, matmul_precision: MatmulPrecision) -> float:
    return abs(Training(method, device, matmul_precision, TILE_POINTS).psnr() - reference_psnr(method))
