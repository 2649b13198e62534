"""Sharp frames of a video: the least blurred of every few consecutive frames. Only videos are opened."""

import logging
import math
import re
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageFilter

from nerf_lightning.data.sfm.hdr_films import hdr_transfer, tone_mapped
from nerf_lightning.files.budgets import limits, require_within
from nerf_lightning.files.regular import open_regular
from nerf_lightning.messages.errors import InputError

FRAMES_WANTED = 100
SHARPNESS_SIDE = 480
JPEG_QUALITY = 95
# Share of its fine details that a blurred frame keeps when it is blurred again. Sharp photographs keep a tenth, and
# nine tenths after a blur of two pixels.
BLURRED = 0.7
# Only the file itself is opened.
INPUT = ["-protocol_whitelist", "file"]
COPIED = re.compile(rb"^Output #0.*?Video: .*?, (\d+)x(\d+).*\bframe= *(\d+)", re.DOTALL | re.MULTILINE)
"""In ffmpeg's output: width and height of the stream, and the number of copied frames. Text from the file itself, such
as a title, never begins a line."""
# Otherwise frames are repeated if they come at uneven times, as from phones.
EACH_ONCE = ["-fps_mode", "passthrough"]

# It warns that the size of films taken in portrait orientation differs from their stream's.
logging.getLogger("imageio_ffmpeg").setLevel(logging.ERROR)


def sharpness(frame: UInt8[np.ndarray, "height width 3"]) -> float:
    """Return the variance of the Laplacian of a small gray version: higher is sharper.

    The measure of Pech-Pacheco et al., "Diatom autofocusing in brightfield microscopy", ICPR 2000. It compares frames
    of one scene; a blank wall is never sharp. The frame is first averaged down to at most 480 pixels or so on its
    longer side, which removes noise and keeps motion across pixels from camera shake.

    >>> sharpness(np.full((20, 20, 3), 128, dtype=np.uint8))
    0.0
    """
    return _roughness(_small_grey(frame))


def is_blurred(frame: UInt8[np.ndarray, "height width 3"]) -> bool:
    """Return whether a small gray version of a frame lacks details as fine as its pixels could show.

    A sharp frame loses most of its fine details in a blur of one pixel; a blurred one has none to lose (after Crete et
    al., "The blur effect", 2007). A blank frame counts as blurred.
    """
    grey = _small_grey(frame)
    return _roughness(grey.filter(ImageFilter.GaussianBlur(1.0))) >= BLURRED * _roughness(grey)


def _small_grey(frame: UInt8[np.ndarray, "height width 3"]) -> Image.Image:
    return Image.fromarray(frame).convert("L").reduce(max(1, max(frame.shape[:2]) // SHARPNESS_SIDE))


def _roughness(grey: Image.Image) -> float:
    g = np.asarray(grey, dtype=np.float32)
    laplacian = g[:-2, 1:-1] + g[2:, 1:-1] + g[1:-1, :-2] + g[1:-1, 2:] - 4 * g[1:-1, 1:-1]
    return float(laplacian.var())


def count_frames(path: Path) -> int:
    """Return how many frames a video has; refuse files that are not videos."""
    import imageio_ffmpeg

    require_video(path)
    most = limits().video_frames
    # Packets are copied: decoding them would take as long as the film, and small packets can decode to any size.
    copied = ("-map", "0:v:0", "-map_metadata", "-1", "-c", "copy", "-frames:v", str(most + 1), "-f", "null", "-")
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-nostdin", *INPUT, "-i", str(path), *copied]
    result = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)
    said = COPIED.search(result.stderr)
    if result.returncode or said is None:
        raise InputError(_not_a_video(path))
    width, height, count = map(int, said.groups())
    require_within("megapixels", math.ceil(width * height / 1e6), path, "megapixels in each frame")
    require_within("video_frames", math.inf if count > most else count, path, "frames")
    return count


def frame_stride(num_frames: int, every: int | None) -> int:
    """Return how many consecutive frames one is chosen from: `every`, else such that about a hundred are left.

    >>> frame_stride(1000, None), frame_stride(30, None), frame_stride(1000, 4)
    (10, 1, 4)
    """
    return every or max(1, num_frames // FRAMES_WANTED)


def write_sharp_frames(
    video: Path, folder: Path, every: int, on_frame: Callable[[int], None] = lambda count: None
) -> int:
    """Write the sharpest of every `every` frames as frame_000123.jpg, by its number in the video; return the count.

    Frames are upright, and tone-mapped if the film is HDR; a shorter last group counts as one; `on_frame` gets the
    number of frames read so far.

    Raises:
        InputError: the file is not a video, or has no frames.
    """
    with _named(video):
        transfer = hdr_transfer(video, INPUT)
    written, sharpest = 0, -1.0
    for index, frame in enumerate(_frames(video)):
        # Only the best frame so far is kept: a group of large frames would take gigabytes.
        if (here := sharpness(frame)) > sharpest:
            sharpest, best, number = here, frame, index
        on_frame(index + 1)
        if (index + 1) % every == 0:
            written, sharpest = written + _write(folder, best, number, transfer), -1.0
    if sharpest >= 0:
        written += _write(folder, best, number, transfer)
    if not written:
        raise InputError(_not_a_video(video))
    return written


def _write(folder: Path, frame: UInt8[np.ndarray, "height width 3"], number: int, transfer: str | None) -> int:
    shown = frame if transfer is None else tone_mapped(frame, transfer)
    Image.fromarray(shown).save(folder / f"frame_{number:06d}.jpg", quality=JPEG_QUALITY, subsampling=0)
    return 1


def _frames(video: Path) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    with _named(video):
        yield from iio.imiter(video, plugin="FFMPEG", input_params=INPUT, output_params=EACH_ONCE)


@contextmanager
def _named(video: Path) -> Iterator[None]:
    """Report files that ffmpeg cannot read as not being videos."""
    try:
        yield
    except (OSError, RuntimeError, ValueError, IndexError) as error:
        raise InputError(_not_a_video(video)) from error


def _not_a_video(path: Path) -> str:
    return (
        f"{path} is not a video that ffmpeg can read, or it holds no frames. Play it to see whether it is complete, "
        "and convert it to an mp4 (H.264) if it is."
    )


# Matroska and WebM, MPEG program stream and video, Flash, Ogg, Windows Media, GIF.
STARTS = (
    *(b"\x1a\x45\xdf\xa3", b"\x00\x00\x01\xba", b"\x00\x00\x01\xb3", b"FLV\x01", b"OggS"),
    *(b"\x30\x26\xb2\x75\x8e\x66\xcf\x11", b"GIF87a", b"GIF89a"),
)
BOXES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot")
"""The beginning of an mp4 or QuickTime file, after four bytes of length."""
PACKETS = ((0, 188), (4, 192))
"""First byte and length of the packets of an MPEG transport stream."""
SYNC = 0x47


def require_video(path: Path) -> None:
    """Refuse files that are not video containers, and name those that are read."""
    with open_regular(path, "video") as file:
        start = file.read(600)
    known = start.startswith(STARTS) or start[4:8] in BOXES
    riff = start[:4] == b"RIFF" and start[8:12] == b"AVI "
    stream = any(start[first::length][:3] == bytes([SYNC]) * 3 for first, length in PACKETS)
    if not (known or riff or stream):
        raise InputError(
            f"{path} is not in a supported video format (mp4, mov, mkv, webm, avi, ts, mpg, flv, ogg, wmv, gif). "
            "Playlists and scripts of ffmpeg are not followed. Convert it to an mp4 (H.264)."
        )
