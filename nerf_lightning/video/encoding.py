"""Videos: H.264 in mp4 by the ffmpeg that imageio-ffmpeg carries.

ffmpeg is run here, not by imageio's writer, which rescales odd sizes and says nothing when ffmpeg fails.
"""

import shutil
import subprocess
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

import torch
from jaxtyping import UInt8
from torch import Tensor

from nerf_lightning.errors import InputError
from nerf_lightning.files.atomic import whole_file

# The picture is converted by the rule of BT.709 and says so: untagged, players guess the rule from the size.
# Newer ffmpegs convert by the tag alone, those before 7 need the filter.
_COLORS = "-vf scale=out_color_matrix=bt709:out_range=tv -colorspace bt709 -color_primaries bt709 -color_trc bt709"
# yuv420p and faststart: what browsers and phones can play, from the first byte on.
_CODEC = f"{_COLORS} -an -c:v libx264 -crf 16 -preset medium -pix_fmt yuv420p -movflags +faststart -f mp4"


def write_video(
    path: Path, frames: Iterable[UInt8[Tensor, "height width 3"]], fps: int, total: int | None = None
) -> None:
    """Write frames of one size as an mp4 that plays everywhere, whole or not at all.

    Frames are taken one at a time and never rescaled. H.264 wants even sides: an odd one gets one more pixel,
    a copy of the edge.

    Args:
        path: where to; ends in .mp4. Missing folders are made.
        frames: pictures, row 0 on top.
        fps: frames per second.
        total: how many frames there should be, where it is known.

    Raises:
        InputError: the name does not end in .mp4, there is no ffmpeg, or ffmpeg fails (it is quoted).
        ValueError: no frames, another number than `total`, or frames of different sizes.
    """
    if path.suffix.lower() != ".mp4":
        raise InputError(f"{path}: videos are written as mp4; choose a name that ends in .mp4")
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise ValueError(f"{path}: a video needs at least one frame")
    height, width, _ = (pad_to_even(first)).shape
    with whole_file(path) as part, _encoder(part, width, height, fps) as pipe:
        count = 0
        for frame in _chain(first, frames):
            if frame.shape != first.shape:
                raise ValueError(f"{path}: frame {count} is {tuple(frame.shape)}, the first {tuple(first.shape)}")
            pipe.write(pad_to_even(frame).contiguous().numpy().tobytes())
            count += 1
        if total is not None and count != total:
            raise ValueError(f"{path}: {count} frames came, {total} were promised")


def pad_to_even(picture: UInt8[Tensor, "height width 3"]) -> UInt8[Tensor, "even_height even_width 3"]:
    """Return the picture with even sides; an odd one repeats its last row or column."""
    height, width, _ = picture.shape
    rows = torch.arange(height + height % 2).clamp(max=height - 1)
    columns = torch.arange(width + width % 2).clamp(max=width - 1)
    return picture[rows][:, columns]


def _chain(first: Tensor, rest: Iterator[Tensor]) -> Iterator[Tensor]:
    yield first
    yield from rest


@contextmanager
def _encoder(path: Path, width: int, height: int, fps: int) -> Iterator[IO[bytes]]:
    """Lend the pipe that takes raw frames; wait for ffmpeg at the end, and stop it at once on an error."""
    source = f"-y -v error -f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {fps} -i -"
    command = [require_ffmpeg(), *source.split(), *_CODEC.split(), str(path)]
    with TemporaryFile() as words:
        try:
            process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=words)
        except OSError as error:
            raise InputError(f"ffmpeg ({command[0]}) does not start: {error}. {_CURE}") from error
        assert process.stdin is not None
        broken: BrokenPipeError | None = None
        try:
            yield process.stdin
            process.stdin.close()
        except BrokenPipeError as error:
            broken = error  # ffmpeg has given up: its own words, read below, say more
        except BaseException:
            process.kill()
            raise
        finally:
            with suppress(BrokenPipeError):  # closing writes what is left, perhaps to nobody
                process.stdin.close()
            code = process.wait()
        if code != 0:
            words.seek(0)
            said = words.read().decode(errors="replace").strip()
            raise InputError(f"ffmpeg failed with code {code}: {said}. {_CURE}")
        if broken is not None:
            raise broken


_CURE = (
    "Install one with `pip install imageio-ffmpeg`, name one in the environment variable IMAGEIO_FFMPEG_EXE, "
    "or write PNG frames instead."
)


def require_ffmpeg() -> str:
    """Return where ffmpeg is.

    Raises:
        InputError: there is none.
    """
    import imageio_ffmpeg

    try:
        program = str(imageio_ffmpeg.get_ffmpeg_exe())
    except RuntimeError as error:
        raise InputError(f"A video needs ffmpeg, and there is none. {_CURE}") from error
    if shutil.which(program) is None:
        raise InputError(f"ffmpeg ({program}) does not start: there is no such program. {_CURE}")
    return program
