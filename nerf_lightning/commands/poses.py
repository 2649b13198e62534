"""Find the cameras of photographs or of a video by structure from motion.

The output is a folder that `scene=colmap` reads.
Its summary: `summary_lines` in `data/sfm/find_poses.py`.
"""

import time
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from nerf_lightning.config.instantiate import require_fitting_values, required_path
from nerf_lightning.config.overrides import to_type
from nerf_lightning.data.sfm.find_poses import from_photographs, from_video, require_new_capture, summary_lines
from nerf_lightning.data.sfm.reconstruction import require_pycolmap
from nerf_lightning.data.sfm.settings import SfmSettings
from nerf_lightning.files.made_folders import child_of
from nerf_lightning.messages.console import say
from nerf_lightning.messages.errors import InputError, require_positive
from nerf_lightning.runs.run_folder import job_folder
from nerf_lightning.video.encoding import require_ffmpeg


def run(config: DictConfig) -> int:
    """Find the poses as configured, print a summary, and return their number."""
    started = time.monotonic()
    source, settings = _source(config), _settings(config)
    require_pycolmap()
    is_video = config.video is not None
    name = source.resolve().stem if is_video else source.resolve().name
    folder = job_folder() or Path(config.paths.output_dir or child_of(Path(config.paths.root_dir), "poses", name))
    require_new_capture(folder, source, is_video)
    if is_video:
        require_ffmpeg()
        model, matching = from_video(source, config.every, folder, settings)
    else:
        model, matching = from_photographs(source, folder, settings)
    say(
        *summary_lines(model, matching, is_video, folder, time.monotonic() - started),
        f"next                nerf train model=fast_proposal scene=colmap {to_type('scene.root', str(folder))}",
    )
    return len(model.registered)


def _source(config: DictConfig) -> Path:
    if (config.images is None) == (config.video is None):
        raise InputError("Give either images=DIR (a folder of photographs) or video=FILE.")
    key = "images" if config.video is None else "video"
    return Path(required_path(key, config[key]))


def _settings(config: DictConfig) -> SfmSettings:
    values = OmegaConf.to_container(config, resolve=True)
    assert isinstance(values, dict)
    chosen = {key: values[key] for key in SfmSettings.__dataclass_fields__}
    require_fitting_values({"_target_": f"{SfmSettings.__module__}.{SfmSettings.__name__}", **chosen})
    if config.every is not None:
        if not isinstance(config.every, int):
            raise InputError(f"every={config.every} is not valid: it must be a whole number or null.")
        require_positive(every=config.every)
    return SfmSettings(**chosen)
