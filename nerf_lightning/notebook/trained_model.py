"""A trained model, opened from its run or its checkpoint, and rendered from any camera."""

import os
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from nerf_lightning.checkpoints.reading import Checkpoint
from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.cli.prepare import prepared
from nerf_lightning.commands.export import export as export_checkpoint
from nerf_lightning.config.compose import compose_config, composed_job
from nerf_lightning.config.error_messages import in_words
from nerf_lightning.config.instantiate import build
from nerf_lightning.config.open_checkpoint import open_checkpoint
from nerf_lightning.config.overrides import quoted
from nerf_lightning.data.captures.checks import known_background
from nerf_lightning.data.captures.joined import shown_capture
from nerf_lightning.files.budgets import Budgets, set_limits
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.world_frame import poses_from_user, unit_of
from nerf_lightning.nerf.models.base import Model, show_photographs
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import Picture, render_picture
from nerf_lightning.nerf.types.scene import Cameras, Scene, SceneRecord
from nerf_lightning.video.shots import Subject, content_of, lay_path, shot_of


@dataclass(frozen=True)
class TrainedModel:
    """A trained model on its device, in evaluation mode, with the cameras of its capture."""

    module: Model = field(repr=False)
    """The network: a PyTorch module that renders rays."""
    checkpoint: Checkpoint = field(repr=False)
    """The checkpoint: config, chosen options, step, precision."""
    tile_points: int
    """Maximum number of points that go through a field at once."""

    @property
    def scene(self) -> SceneRecord:
        """Cameras (refined ones, if training refined them), bounds, splits and names, without photographs."""
        return self.checkpoint.scene

    def render(self, camera: Cameras | int | str, background: str | None = None) -> Picture:
        """Render the view of a camera.

        Args:
            camera: one camera in the user's own frame (of `Cameras.from_opencv`, `scene.user_cameras[3]` of any reading
                of the capture, `model.path("orbit")[0]`), or the index or the name of a view of `model.scene`.
            background: what lies behind the scene: white, black or none; None: as in training.

        Returns:
            On the CPU: `rgb` (height x width x 3, sRGB in [0, 1] up to rounding), `depth` (height x width, the expected
            distance along each pixel's ray in the user's units; light that escapes ends at far), `opacity` (height x
            width).

        Raises:
            InputError: unknown view or background, or several cameras.
        """
        with torch.no_grad(), in_words("render"):
            scene, behind = self.scene, known_background(background or self.scene.background)
            if isinstance(camera, Cameras):
                one = _one(camera)
                c2w = poses_from_user(one.c2w.double().cpu(), scene.to_user).float()
                shot = shot_of(Subject(self.module, scene, behind), replace(one.to("cpu"), c2w=c2w), self.tile_points)
                picture = shot.picture(0)
            else:
                rays_of = RayGenerator.of_views(scene, self.module.needs_photographs)
                picture = render_picture(self.module, rays_of, self._view(camera), behind, self.tile_points)
            return replace(picture, depth=unit_of(scene.to_user) * picture.depth)

    def path(self, name: str = "orbit", **settings: Any) -> Cameras:
        """Return the cameras of a path around the capture, in its own frame, one per frame.

        Args:
            name: a path in `conf/path/`: orbit, spiral, keyframes, ...
            **settings: settings of the path, as `nerf help render path=...` lists them, in the capture's own frame and
                units: `num_frames=40`, `width=320`.

        Raises:
            InputError: unknown path or setting, or the path does not suit this capture.
        """
        overrides = [f"path={name}", *(f"path.{key}={quoted(value)}" for key, value in settings.items())]
        with in_words("render"):
            config = compose_config("render", overrides).config
            subject = Subject(self.module, self.scene, self.scene.background)
            cameras = lay_path(build(config.path), self.scene, partial(content_of, subject, self.tile_points))
            return replace(self.scene, cameras=cameras).user_cameras

    def of_scene(self, scene: Scene) -> "TrainedModel":
        """Return the same network for another scene; it then renders from that scene's photographs.

        For models of many scenes. If several captures were joined, the first one that was held out is used.

        Raises:
            InputError: the model knows only its own scene, or cannot render from these photographs.
        """
        if not self.module.needs_photographs:
            raise InputError(f"This model can render only its own scene, {self.scene.name}.")
        shown = shown_capture(scene)
        show_photographs(self.module, shown)
        return replace(self, checkpoint=replace(self.checkpoint, scene=scene_record(shown), given_cameras=None))

    def export(self, what: str, folder: str | os.PathLike[str] | None = None, **settings: Any) -> list[Path]:
        """Write files for other programs, as `nerf export` does: `model.export("splats", format="spz")`.

        The checkpoint is read again in float32, and so are the photographs of its run if the exporter needs them.

        Args:
            what: the exporter in `conf/what/`: mesh, points, splats, page, ...
            folder: destination; None: the folder `export` of the run.
            **settings: of the exporter, as `nerf help export what=mesh` lists them.

        Returns:
            The files.

        Raises:
            InputError: unknown exporter or setting, or the model contains nothing to export.
        """
        if self.module.needs_photographs:
            raise InputError("This model renders from photographs: give those to nerf export with scene=....")
        overrides = [f"ckpt={quoted(self.checkpoint.path)}", f"what={what}", f"paths.output_dir={quoted(folder)}"]
        overrides += [f"what.{key}={quoted(value)}" for key, value in settings.items()]
        with in_words("export"), composed_job("export", prepared("export", overrides)) as config:
            return export_checkpoint(config)

    def _view(self, camera: int | str) -> int:
        names = self.scene.view_names
        if isinstance(camera, str) and camera in names:
            return names.index(camera)
        if isinstance(camera, int) and -len(names) <= camera < len(names):
            return camera % len(names)
        raise InputError(
            f"{self.scene.name} has no view {camera!r}: it has {len(names)}, numbered from 0 and named as in "
            "model.scene.view_names."
        )


def load(run: str | os.PathLike[str], *overrides: str) -> TrainedModel:
    """Load a trained model from the newest checkpoint of a run folder, or from a checkpoint.

    Nothing in the file is executed, and the capture is not needed.

    Args:
        run: the run folder or the checkpoint.
        *overrides: settings of the machine, as on the command line: "trainer=cpu", "trainer.tile_points=4096".

    Raises:
        InputError: the file is not a checkpoint of this package, or is damaged.
    """
    with in_words("render"):
        config = compose_config("render", [f"ckpt={quoted(run)}", *overrides]).config
        set_limits(Budgets(**config.budgets))
        opened = open_checkpoint(config)
    return TrainedModel(opened.model.eval(), opened.checkpoint, opened.tile_points)


def _one(camera: Cameras) -> Cameras:
    """Return one camera as cameras of one view."""
    if camera.c2w.dim() == 2:
        return camera.map(lambda tensor: tensor[None])
    if camera.c2w.shape[0] != 1:
        raise InputError(f"These are {camera.c2w.shape[0]} cameras, but render takes one: cameras[0].")
    return camera
