"""Films as one file: with ffmpeg, H.264 in mp4, and with alpha VP9 in webm and ProRes 4444 in mov; and animated WebP.

ffmpeg (imageio-ffmpeg includes one) is run directly, not by imageio's writer, which rescales odd sizes and fails
silently.
"""

import shutil
import subprocess
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from nerf_lightning.files.atomic import whole_file
from nerf_lightning.messages.errors import InputError

# The picture is converted by BT.709 and tagged so: untagged, players guess the matrix from the size. Newer ffmpegs
# convert by the tag alone; those before 7 need the filter.
_COLORS = "-vf scale=out_color_matrix=bt709:out_range=tv -colorspace bt709 -color_primaries bt709 -color_trc bt709"


@dataclass(frozen=True)
class Codec:
    """How ffmpeg writes videos with one file ending."""

    encoder: str
    settings: str
    plain: str
    """Pixel format of pictures without alpha."""
    with_alpha: str | None
    """Pixel format of pictures with alpha; None: not supported."""


CODECS = {
    # yuv420p and faststart: what browsers and phones can play, from the first byte on.
    ".mp4": Codec("libx264", "-crf 16 -preset medium -movflags +faststart -f mp4", "yuv420p", None),
    # Out-of-order frames, such as alt-refs, would lose their alpha.
    ".webm": Codec(
        "libvpx-vp9", "-crf 20 -b:v 0 -deadline good -cpu-used 3 -auto-alt-ref 0 -f webm", "yuv420p", "yuva420p"
    ),
    ".mov": Codec("prores_ks", "-profile:v 4444 -alpha_bits 16 -f mov", "yuv444p10le", "yuva444p10le"),
}


def write_video(
    path: Path, frames: Iterable[UInt8[Tensor, "height width channels"]], fps: int, total: int | None = None
) -> None:
    """Write frames of one size as a video, whole or not at all.

    Frames are taken one at a time and never rescaled. The codecs need even sides: an odd one gets one more pixel, a
    copy of the edge.

    Args:
        path: the file, ending in .mp4, which plays everywhere, or, for frames with alpha, too, in .webm or .mov.
            Missing folders are created.
        frames: pictures in RGB, or RGB with straight alpha, row 0 on top.
        fps: frames per second.
        total: expected number of frames, if known.

    Raises:
        InputError: the name has another ending, there is no ffmpeg, or ffmpeg fails (its error is quoted).
        ValueError: no frames, another number than `total`, frames of different sizes, or with alpha in an mp4.
    """
    codec = CODECS.get(path.suffix.lower())
    if codec is None:
        raise InputError(f"{path}: videos are written as mp4; choose a name that ends in .mp4 (or .webm, or .mov)")
    first, frames = _counted(path, frames, total)
    height, width, channels = pad_to_even(first).shape
    with whole_file(path) as part, _encoder(part, codec, (width, height), channels == 4, fps) as pipe:
        for frame in frames:
            pipe.write(pad_to_even(frame).contiguous().numpy().tobytes())


LARGEST_SIDE = 16383  # Of a WebP, in pixels
QUALITY = 80


def write_animation(
    path: Path, frames: Iterable[UInt8[Tensor, "height width channels"]], fps: int, total: int | None = None
) -> None:
    """Write frames as an animated WebP, which pages and messages play by themselves in an endless loop.

    The arguments are those of `write_video`; each frame is shown for a whole number of milliseconds, equal neighbors
    as one.
    """
    first, frames = _counted(path, frames, total)
    height, width, _ = first.shape
    if max(height, width) > LARGEST_SIDE:
        raise InputError(
            f"{path}: a frame of {width} x {height} pixels is larger than a WebP can be, {LARGEST_SIDE} on a side. "
            "Lower path.width, or write format=video."
        )
    pictures = (Image.fromarray(frame.numpy()) for frame in frames)
    shown = {"duration": round(1000 / fps), "loop": 0, "quality": QUALITY}
    with whole_file(path) as part:
        next(pictures).save(part, "WEBP", save_all=True, append_images=pictures, **shown)


def _counted(path: Path, frames: Iterable[Tensor], total: int | None) -> tuple[Tensor, Iterator[Tensor]]:
    """Return the first frame, and an iterator over all, which raises a ValueError if they are not as promised."""
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise ValueError(f"{path}: a film needs at least one frame")

    def checked() -> Iterator[Tensor]:
        count = 0
        for frame in chain([first], frames):
            if frame.shape != first.shape:
                raise ValueError(f"{path}: frame {count} is {tuple(frame.shape)}, the first {tuple(first.shape)}")
            yield frame
            count += 1
        if total is not None and count != total:
            raise ValueError(f"{path}: {count} frames came, {total} were promised")

    return first, checked()


def pad_to_even(picture: UInt8[Tensor, "height width channels"]) -> UInt8[Tensor, "even_height even_width channels"]:
    """Return the picture with even sides; an odd one repeats its last row or column."""
    height, width, _ = picture.shape
    rows = torch.arange(height + height % 2).clamp(max=height - 1)
    columns = torch.arange(width + width % 2).clamp(max=width - 1)
    return picture[rows][:, columns]


@contextmanager
def _encoder(path: Path, codec: Codec, size: tuple[int, int], has_alpha: bool, fps: int) -> Iterator[IO[bytes]]:
    """Yield the pipe for raw frames; wait for ffmpeg at the end, and stop it at once on an error."""
    pixels, stored = ("rgba", codec.with_alpha) if has_alpha else ("rgb24", codec.plain)
    if stored is None:
        raise ValueError(f"{path}: {codec.encoder} has no alpha")
    source = f"-y -v error -f rawvideo -pix_fmt {pixels} -s {size[0]}x{size[1]} -r {fps} -i -"
    target = f"{_COLORS} -an -c:v {codec.encoder} {codec.settings} -pix_fmt {stored}"
    command = [require_ffmpeg(), *source.split(), *target.split(), str(path)]
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
            broken = error  # ffmpeg has failed: its own message, read below, says more
        except BaseException:
            process.kill()
            raise
        finally:
            with suppress(BrokenPipeError):  # closing writes what is left, perhaps to a closed pipe
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


def require_encoder(ending: str) -> None:
    """Refuse videos with an ending whose encoder this machine's ffmpeg lacks, and all videos without ffmpeg."""
    name, program = CODECS[ending].encoder, require_ffmpeg()
    asked = [program, "-v", "error", "-hide_banner", "-h", f"encoder={name}"]
    try:
        answer = subprocess.run(asked, capture_output=True, stdin=subprocess.DEVNULL, check=False).stdout
    except OSError as error:
        raise InputError(f"ffmpeg ({program}) does not start: {error}. {_CURE}") from error
    if f"Encoder {name}".encode() not in answer:
        raise InputError(f"A video that ends in {ending} needs {name}, which ffmpeg ({program}) lacks. {_CURE}")


def require_ffmpeg() -> str:
    """Return where ffmpeg is, or say how to install it."""
    import imageio_ffmpeg

    try:
        program = str(imageio_ffmpeg.get_ffmpeg_exe())
    except RuntimeError as error:
        raise InputError(f"A video needs ffmpeg, which is not installed. {_CURE}") from error
    if shutil.which(program) is None:
        raise InputError(f"ffmpeg ({program}) does not start: there is no such program. {_CURE}")
    return program
