"""Structure from motion from end to end: turn photographs or a video into a capture in a folder, or nothing."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from nerf_lightning.data.pixels.picture_files import read_rgba
from nerf_lightning.data.sfm.find_cameras import find_cameras
from nerf_lightning.data.sfm.image_pairs import chosen_matching
from nerf_lightning.data.sfm.panoramas import of_one_kind
from nerf_lightning.data.sfm.photograph_folder import FoundPhotograph, check_pixels, find_photographs, put_upright
from nerf_lightning.data.sfm.reconstruction import NothingFoundError, SparseModel
from nerf_lightning.data.sfm.settings import SfmSettings
from nerf_lightning.data.sfm.video_frames import count_frames, frame_stride, is_blurred, write_sharp_frames
from nerf_lightning.files.atomic import full_disk_named
from nerf_lightning.files.made_folders import ScratchFolder, child_of, empty_ours, make_folder, remove_empty
from nerf_lightning.messages.console import StageProgress, spoken
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.geometry.subset import evenly_spaced_subset

READING, FRAMES = "reading photographs", "choosing frames"
READING_COST, FRAME_COST = 0.1, 0.02
# Number of frames that are examined to explain why a video failed.
FRAMES_JUDGED = 20
UNFINISHED = ".poses.part"


def require_new_capture(folder: Path, source: Path, is_video: bool) -> None:
    """Refuse to overwrite poses, or pictures that are not those of `source`, even through links."""
    if child_of(folder, "sparse", "0").exists():
        raise InputError(
            f"{folder} has camera poses already (sparse/0). Remove them to find them again, or give another folder "
            "with paths.output_dir=DIR."
        )
    images = folder / "images"
    if images.exists() and (is_video or not source.is_dir() or not images.samefile(source)):
        raise InputError(
            f"{images} exists already, and is not the folder given with images=. Give an empty folder with "
            "paths.output_dir=DIR."
        )


@contextmanager
def _unfinished(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder in `folder`; delete it at the end, and `folder` with it if that is empty."""
    scratch, is_new = ScratchFolder(folder, UNFINISHED, "finds poses"), not folder.exists()
    scratch.hold()
    try:
        empty_ours(scratch.path)  # of files that a killed process left
        with full_disk_named(folder):
            yield scratch.path
    finally:
        scratch.remove()
        if is_new:
            remove_empty(folder)


def from_photographs(source: Path, folder: Path, settings: SfmSettings) -> tuple[SparseModel, str]:
    """Find the cameras of photographs, and write a capture; return the model, and how photographs were paired.

    The output folder may be the one that contains the photographs in `images`.

    Raises:
        InputError: photographs are unusable, or their cameras cannot be found.
    """
    photographs = of_one_kind(find_photographs(source), settings.panoramas, f"images={source}")
    in_place = (folder / "images").exists()
    anew = [photograph.path.name for photograph in photographs if not photograph.as_it_is]
    if in_place and anew:
        raise InputError(
            f"{listed(anew)} in {source} are rotated by EXIF, or in a format that COLMAP does not read, and must be "
            "converted, but they are in the output folder itself. Give another folder with paths.output_dir=DIR."
        )
    costs = {READING: READING_COST * sum(p.width * p.height for p in photographs) / 1e6}
    with _unfinished(folder) as work:
        images = folder / "images" if in_place else make_folder(work, "images")
        with StageProgress(costs) as report:
            for number, photograph in enumerate(photographs):
                report(READING, number / len(photographs))
                check_pixels(photograph)
                if not in_place:
                    put_upright(photograph, images)
        model = find_cameras(photographs, images, work, work / "sparse" / "0", settings)
        _publish(work, folder)
    return model, chosen_matching(settings.matching, len(photographs))


def from_video(video: Path, every: int | None, folder: Path, settings: SfmSettings) -> tuple[SparseModel, str]:
    """Choose sharp frames of a video, one in `every` (None: about a hundred), find their cameras, and write a capture.

    Raises:
        InputError: the file is not a video, or its cameras cannot be found.
    """
    num_frames = count_frames(video)
    stride = frame_stride(num_frames, every)
    with _unfinished(folder) as work:
        images = make_folder(work, "images")
        with StageProgress({FRAMES: FRAME_COST * num_frames}) as report:
            write_sharp_frames(video, images, stride, lambda count: report(FRAMES, count / num_frames))
        try:
            found = find_photographs(images)
        except InputError as error:
            raise InputError(
                f"video={video}: one of every {stride} of its {num_frames} frames is not enough, or they are tiny. "
                "Give a longer or larger video, or a smaller every=."
            ) from error
        photographs = of_one_kind(found, settings.panoramas, f"video={video}")
        try:
            model = find_cameras(photographs, images, work, work / "sparse" / "0", settings)
        except NothingFoundError as error:
            raise InputError(_nothing_in_video(video, photographs, error.cause)) from error
        _publish(work, folder)
    return model, chosen_matching(settings.matching, len(photographs))


def _nothing_in_video(video: Path, frames: list[FoundPhotograph], cause: str) -> str:
    some = evenly_spaced_subset(range(len(frames)), FRAMES_JUDGED)
    blurred = sum(is_blurred(read_rgba(frames[number].path)[..., :3]) for number in some)
    if 2 * blurred > len(some):
        cause = "are nearly all blurred, although they are the sharpest that there are"
        cure = "Film again in more light, in focus, holding still or moving slowly"
    else:
        cure = "Film again: walk slowly around what matters rather than turning on the spot"
    return (
        f"video={video}: no camera could be placed for the {len(frames)} frames that were chosen: they {cause}. "
        f"{cure}, with one zoom. A smaller every= takes more frames of this video."
    )


def _publish(work: Path, folder: Path) -> None:
    """Move finished files to their destination; sparse/0 comes last, because it marks completion."""
    if (work / "images").exists():
        (work / "images").rename(folder / "images")
    (work / "sparse" / "0").rename(make_folder(folder, "sparse") / "0")


# Share of the photographs: if fewer were registered, give advice.
ENOUGH = 0.8


def summary_lines(model: SparseModel, matching: str, is_video: bool, folder: Path, seconds: float) -> list[str]:
    """Return what was found and written to `folder` as lines, with advice if it is little."""
    found, total = len(model.registered), len(model.registered) + len(model.left_out)
    what = "frames" if is_video else "photographs"
    cameras = "one camera" if model.num_cameras == 1 else f"{model.num_cameras} cameras"
    lines = [
        f"registered          {found} of {total} {what} ({cameras}, {matching} matching)",
        f"reprojection error  {model.reprojection_error:.2f} px",
        f"points              {model.num_points}",
        f"time                {spoken(seconds)}",
        f"written             {folder}",
    ]
    if model.left_out:
        lines.append(f"left out            {listed(model.left_out)}")
    return [*lines, *remarks(model, matching, is_video)]


def remarks(model: SparseModel, matching: str, is_video: bool) -> list[str]:
    """Return what to do differently, if anything."""
    lines = []
    if model.disconnected:
        lines.append(
            f"{listed(model.disconnected, 4)} fit together but not with the rest: if they show another place, make "
            "a separate capture of them; if not, photographs between the two are missing."
        )
    if len(model.registered) < ENOUGH * (len(model.registered) + len(model.left_out)):
        more = (
            "film slowly, walking rather than turning; a smaller every= takes more frames of this video."
            if is_video
            else "take more photographs between those left out and the others (overlapping by two thirds), sharp ones, "
            "with one zoom and from positions a few steps apart."
        )
        pairs = " matching=exhaustive compares every photograph with every other." if matching == "sequential" else ""
        lines.append(f"few were registered: {more}{pairs}")
    return lines
