"""Find the camera poses of photographs or of a video (structure from motion), so that they can be trained on.

Written is a folder that `scene=colmap` reads.
"""

import time
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from nerf_lightning.config.instantiate import require_fitting_values, required_path
from nerf_lightning.config.overrides import to_type
from nerf_lightning.console import say
from nerf_lightning.errors import InputError, require_positive
from nerf_lightning.escaping import listed
from nerf_lightning.runs.folder import job_folder
from nerf_lightning.sfm.find_poses import from_photographs, from_video
from nerf_lightning.sfm.reconstruction import SparseModel, require_pycolmap
from nerf_lightning.sfm.settings import SfmSettings
from nerf_lightning.video.encoding import require_ffmpeg

ENOUGH = 0.8


def run(config: DictConfig) -> int:
    """Find the poses as the config says, print what was found, and return how many."""
    started = time.monotonic()
    settings = _settings(config)
    require_pycolmap()
    folder = _output(config)
    if config.video is not None:
        require_ffmpeg()
        model, matching = from_video(Path(config.video), config.every, folder, settings)
    else:
        if not isinstance(config.allow_outside, bool):
            raise InputError(f"allow_outside={config.allow_outside} does not fit: it must be true or false.")
        model, matching = from_photographs(Path(config.images), folder, settings, config.allow_outside)
    say(*_summary(model, matching, config, folder, time.monotonic() - started))
    return len(model.registered)


def _settings(config: DictConfig) -> SfmSettings:
    if (config.images is None) == (config.video is None):
        raise InputError("Give either images=DIR (a folder of photographs) or video=FILE, one of the two.")
    for key in ("images", "video"):
        if config[key] is not None:
            required_path(key, config[key])
    values = OmegaConf.to_container(config, resolve=True)
    assert isinstance(values, dict)
    target = f"{SfmSettings.__module__}.{SfmSettings.__name__}"
    chosen = {key: values[key] for key in SfmSettings.__dataclass_fields__}
    require_fitting_values({"_target_": target, **chosen})
    if config.every is not None:
        if not isinstance(config.every, int):
            raise InputError(f"every={config.every} does not fit: it must be a whole number or null.")
        require_positive(every=config.every)
    return SfmSettings(**chosen)


def _output(config: DictConfig) -> Path:
    """Return the folder to write; refuse one that has poses already."""
    source = Path(config.images or config.video)
    name = source.resolve().stem if config.video else source.resolve().name
    folder = job_folder() or Path(config.paths.output_dir or Path(config.paths.root_dir) / "poses" / name)
    if (folder / "sparse" / "0").exists():
        raise InputError(
            f"{folder} has camera poses already (sparse/0). Remove them to find them again, or give another folder "
            "with paths.output_dir=DIR."
        )
    images = folder / "images"
    if images.exists() and (config.video or not source.is_dir() or not images.samefile(source)):
        raise InputError(
            f"{images} exists already, and is not what images= names. Give an empty folder with paths.output_dir=DIR."
        )
    return folder


def _summary(model: SparseModel, matching: str, config: DictConfig, folder: Path, seconds: float) -> list[str]:
    found, total = len(model.registered), len(model.registered) + len(model.left_out)
    what = "frames" if config.video else "photographs"
    cameras = "one camera" if model.num_cameras == 1 else f"{model.num_cameras} cameras"
    lines = [
        f"registered          {found} of {total} {what} ({cameras}, {matching} matching)",
        f"reprojection error  {model.reprojection_error:.2f} px",
        f"points              {model.num_points}",
        f"time                {seconds:.0f} s",
        f"written to          {folder}",
    ]
    if model.left_out:
        lines.append(f"left out            {listed(model.left_out)}")
    if found < ENOUGH * total:
        lines.append(_advice(matching, bool(config.video)))
    return [
        *lines,
        f"next                nerf train model=fast_proposal scene=colmap {to_type('scene.root', str(folder))}",
    ]


def _advice(matching: str, is_video: bool) -> str:
    words = ["few were registered:"]
    if is_video:
        words.append("film slowly, walking rather than turning; a smaller every= takes more frames of this video.")
    else:
        words.append("take more photographs between those left out and the others (overlapping by two thirds),")
        words.append("sharp ones, with one zoom and from places some steps apart.")
    if matching == "sequential":
        words.append("matching=exhaustive compares every photograph with every other.")
    return " ".join([*words, "num_features=8192 finds more details."])
