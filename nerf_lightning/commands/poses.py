"""Find the camera poses of photographs or of a video (structure from motion), so that they can be trained on.

Written is a folder that `scene=colmap` reads.
"""

import contextlib
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout
from omegaconf import DictConfig, OmegaConf

from nerf_lightning.config.instantiate import require_fitting_values, required_path
from nerf_lightning.config.overrides import to_type
from nerf_lightning.console import StageProgress, say
from nerf_lightning.errors import InputError, require_positive
from nerf_lightning.escaping import listed
from nerf_lightning.runs.folder import job_folder
from nerf_lightning.sfm.image_pairs import chosen_matching
from nerf_lightning.sfm.photographs import FoundPhotograph, check_pixels, find_photographs, put_upright
from nerf_lightning.sfm.reconstruction import SparseModel, reconstruct, require_pycolmap
from nerf_lightning.sfm.settings import SfmSettings, stage_costs
from nerf_lightning.sfm.video_frames import count_frames, frame_stride, write_sharp_frames
from nerf_lightning.video.encoding import require_ffmpeg

READING, FRAMES = "reading photographs", "choosing frames"
READING_COST, FRAME_COST = 0.1, 0.02
ENOUGH = 0.8
UNFINISHED = ".poses.part"


def run(config: DictConfig) -> int:
    """Find the poses as the config says, print what was found, and return how many."""
    started = time.monotonic()
    settings = _settings(config)
    require_pycolmap()
    folder = _output(config)
    if config.video is not None:
        model, matching = _from_video(Path(config.video), config.every, folder, settings)
    else:
        if not isinstance(config.allow_outside, bool):
            raise InputError(f"allow_outside={config.allow_outside} does not fit: it must be true or false.")
        model, matching = _from_photographs(Path(config.images), folder, settings, config.allow_outside)
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


@contextmanager
def _unfinished(folder: Path) -> Iterator[Path]:
    """Lend a folder in `folder` that vanishes at the end, and `folder` with it if nothing came to lie in it."""
    work, is_new = folder / UNFINISHED, not folder.exists()
    work.mkdir(parents=True, exist_ok=True)
    lock = FileLock(work / "lock")
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise InputError(
            f"{folder} is in use by another process that finds poses there. Wait for it, or give another folder with "
            "paths.output_dir=DIR."
        ) from error
    try:
        _remove_content(work)  # what a killed process left
        yield work
    finally:
        lock.release()
        shutil.rmtree(work, ignore_errors=True)
        if is_new:
            with contextlib.suppress(OSError):  # not empty
                folder.rmdir()


def _remove_content(work: Path) -> None:
    for path in work.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name != "lock":
            path.unlink()


def _from_photographs(
    source: Path, folder: Path, settings: SfmSettings, allow_outside: bool
) -> tuple[SparseModel, str]:
    photographs = find_photographs(source, allow_outside)
    in_place = (folder / "images").exists()
    turned = [photograph.path.name for photograph in photographs if not photograph.upright]
    if in_place and turned:
        raise InputError(
            f"{listed(turned)} in {source} are stored turned (EXIF orientation) and must be written anew, but they lie "
            "in the output folder itself. Give another folder with paths.output_dir=DIR."
        )
    costs = {READING: READING_COST * sum(p.width * p.height for p in photographs) / 1e6}
    with _unfinished(folder) as work, StageProgress(costs | stage_costs(photographs, settings)) as report:
        images = folder / "images" if in_place else work / "images"
        images.mkdir(exist_ok=True)
        for number, photograph in enumerate(photographs):
            report(READING, number / len(photographs))
            check_pixels(photograph)
            if not in_place:
                put_upright(photograph, images)
        model = reconstruct(photographs, images, work, work / "sparse" / "0", settings, report)
        _publish(work, folder)
    return model, chosen_matching(settings.matching, len(photographs))


def _from_video(video: Path, every: int | None, folder: Path, settings: SfmSettings) -> tuple[SparseModel, str]:
    require_ffmpeg()
    num_frames = count_frames(video)
    stride = frame_stride(num_frames, every)
    with _unfinished(folder) as work:
        images = work / "images"
        images.mkdir()
        with StageProgress({FRAMES: FRAME_COST * num_frames}) as report:
            write_sharp_frames(video, images, stride, lambda count: report(FRAMES, count / num_frames))
        photographs = _frames(video, images, stride, num_frames)
        with StageProgress(stage_costs(photographs, settings)) as report:
            model = reconstruct(photographs, images, work, work / "sparse" / "0", settings, report)
        _publish(work, folder)
    return model, chosen_matching(settings.matching, len(photographs))


def _frames(video: Path, images: Path, stride: int, num_frames: int) -> list[FoundPhotograph]:
    try:
        return find_photographs(images)
    except InputError as error:
        raise InputError(
            f"video={video}: one of every {stride} of its {num_frames} frames is not enough, or they are tiny. Give a "
            "longer or larger video, or a smaller every=."
        ) from error


def _publish(work: Path, folder: Path) -> None:
    """Move what is finished to its place; sparse/0 comes last, for it says that all is there."""
    if (work / "images").exists():
        (work / "images").rename(folder / "images")
    (folder / "sparse").mkdir(exist_ok=True)
    (work / "sparse" / "0").rename(folder / "sparse" / "0")


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
