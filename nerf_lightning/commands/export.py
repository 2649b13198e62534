"""Export a trained scene as a page, mesh, points, splats, volume, depth maps or cameras."""

import logging
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from jaxtyping import Float
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from nerf_lightning.checkpoints.reading import Checkpoint
from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.compute import ranks
from nerf_lightning.config.exporters import build_exporter
from nerf_lightning.config.instantiate import build
from nerf_lightning.config.load_model import load_correction
from nerf_lightning.config.open_checkpoint import LoadedModel, open_checkpoint, read_photographs, scene_to_look_at
from nerf_lightning.evaluation.main_numbers import main_numbers
from nerf_lightning.export.base import Export, Neutral, RunContext
from nerf_lightning.files.json_files import read_json_object
from nerf_lightning.messages.console import say, say_written
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.clipping import CropBox
from nerf_lightning.nerf.models.base import point_field
from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.nerf.types.scene import Scene, SceneRecord
from nerf_lightning.runs.command_folder import beside_checkpoint, filled_folder
from nerf_lightning.runs.file_steps import record_steps
from nerf_lightning.runs.summary import read_note, scene_of_run
from nerf_lightning.training.launch.processes import on_all_processes
from nerf_lightning.video.paths.as_keyframes import as_keyframes
from nerf_lightning.video.paths.auto import AutoPath
from nerf_lightning.video.paths.base import CameraPath, Content, PathFrame
from nerf_lightning.video.paths.keyframe_path import KeyframePath
from nerf_lightning.video.paths.recorded_path import RecordedPath
from nerf_lightning.video.settings import Corner, crop_corners
from nerf_lightning.video.shots import Subject, content_of, frame_around

Keyframes = tuple[dict[str, Any], ...]

BESIDES_QUALITY = ("training", "steps", "parameters", "size of the weights")
"""What a page says of a model; it compares the quality itself, on its own views without lens distortion."""

log = logging.getLogger(__name__)


def run(config: DictConfig) -> None:
    """Write the files."""
    on_all_processes("export", config, export)


def export(config: DictConfig) -> list[Path]:
    """Export a checkpoint, which is all that is needed. Only one process exports, however many there are."""
    if not ranks.is_first():
        return []
    what: Export = build_exporter(config, str(HydraConfig.get().runtime.choices.get("what")))
    path = build(config.path) if what.plays_path else None
    crop = crop_corners(OmegaConf.to_container(config.crop) if OmegaConf.is_config(config.crop) else config.crop)
    if crop is not None and not what.crops:
        raise InputError("crop: this exporter writes the whole scene. Use what=page, splats, points or mesh.")
    if not isinstance(config.min_opacity, int | float) or not 0 <= config.min_opacity < 1:
        raise InputError(f"min_opacity={config.min_opacity}: give a share of the light, from 0 to below 1.")
    # In float32, whatever the training precision: a surface shows the steps of bfloat16.
    opened = open_checkpoint(config, float32=True)
    if what.needs_density:
        point_field(opened.model)
    photographs = read_photographs(config, opened) if what.needs_photographs and config.photographs else None
    default = beside_checkpoint(opened.checkpoint.path, "export")
    with filled_folder(config.paths.output_dir, default) as folder:
        written = write_files(what, opened, photographs, path, folder, crop, config.min_opacity)
        if folder == default:  # which the report shows
            record_steps(folder, written, opened.checkpoint.step)
    if opened.checkpoint.given_cameras is not None:
        say("the cameras are the refined ones (refinement=...), not those that were read")
    say_written(*written)
    return written


def write_files(
    what: Export,
    opened: LoadedModel,
    photographs: Scene | None,
    path: CameraPath | None,
    folder: Path,
    crop: tuple[Corner, Corner] | None = None,
    min_opacity: float = RunContext.min_opacity,
) -> list[Path]:
    """Export an opened model, or the part of it between the corners of `crop`, into an existing folder."""
    record = opened.checkpoint.scene
    content = partial(content_of, Subject(opened.model, record, record.background), opened.tile_points)
    run = run_context(opened, photographs, path if what.plays_path else None, content)
    run = replace(run, min_opacity=min_opacity)
    if crop is not None:
        run = replace(run, crop=CropBox.from_user(*crop, record.to_user))
    if opened.model.needs_photographs:
        record = scene_record(scene_to_look_at(opened, None))
    with torch.no_grad():
        return what.export(opened.model, record, folder, opened.tile_points, run)


def run_context(
    opened: LoadedModel,
    photographs: Scene | None,
    path: CameraPath | None,
    content: Content,
) -> RunContext:
    """Return what is known about a checkpoint's run: its photographs, its metrics, and a camera path."""
    checkpoint = opened.checkpoint
    run = beside_checkpoint(checkpoint.path, "metrics.json").parent
    metrics = read_json_object(run / "metrics.json")
    known = [
        ("model", checkpoint.choices.get("model", "")),
        *(pair for pair in main_numbers(metrics, read_note(run)) if pair[0] in BESIDES_QUALITY),
    ]
    corrected = checkpoint.choices.get("correction", "none") != "none"
    neutral = neutral_colors(checkpoint, opened.trusted) if corrected and photographs is not None else None
    keyframes = () if path is None else page_path(path, checkpoint.scene, run, content)
    name = scene_of_run(checkpoint.scene.name, run)
    return RunContext(photographs, neutral, tuple(known), keyframes, name)


def neutral_colors(checkpoint: Checkpoint, trusted: Sequence[str] = ()) -> Neutral:
    """Return the function that maps photographs to the model's colors, by its learned correction."""
    if not checkpoint.correction:  # Pruned checkpoints keep the model alone.
        return lambda rgb, name: None
    correction, scene = load_correction(checkpoint, trusted), checkpoint.scene

    def neutral(rgb: Float[Tensor, "height width 3"], name: str) -> Float[Tensor, "height width 3"] | None:
        height, width, _ = rgb.shape
        view = scene.view_names.index(name)
        full = scene.cameras.width[view] / width, scene.cameras.height[view] / height
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        return correction.neutral(rgb, PixelIndex(torch.full_like(x, view), (x * full[0]).long(), (y * full[1]).long()))

    return neutral


def page_path(
    path: CameraPath,
    record: SceneRecord,
    run: Path,
    content: Content = PathFrame.content,
) -> Keyframes:
    """Return the keyframes of a path; for path=auto, those last saved by `nerf view` in the run's folder, if any."""
    around = frame_around(record, content)
    if not isinstance(path, AutoPath):
        return tuple(map(asdict, as_keyframes(path, around)))
    folder = run / "viewer"
    recorded = [] if folder.is_symlink() else RecordedPath(around, folder).files()
    for name in recorded[:1]:
        try:
            found = as_keyframes(KeyframePath(str(folder / name)), around)
            log.info("the page plays %s", folder / name)
            return tuple(map(asdict, found))
        except InputError as error:
            log.warning("The page does not play the path that was recorded last: %s", error)
    try:
        return tuple(map(asdict, as_keyframes(path, around)))
    except InputError as error:
        log.warning("The page has no camera path: %s", error)
        return ()
