import subprocess

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image, ImageFilter
from support.budget import budget
from support.corner import noise
from support.running import refused

from nerf_lightning.data.sfm import hdr_films
from nerf_lightning.data.sfm.video_frames import count_frames, frame_stride, is_blurred, sharpness, write_sharp_frames
from nerf_lightning.messages.errors import InputError

# imageio's reader of videos forgets its pipes.
pytestmark = pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
SIDE = 160


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """A camera that slides over a picture, with two frames of six still and the others shaken."""
    imageio = pytest.importorskip("imageio.v3")
    ground = Image.fromarray(noise(320, 0)).convert("RGB")
    path = tmp_path_factory.mktemp("film") / "slide.mp4"
    frames = []
    for number in range(20):
        frame = ground.crop((number * 4, number * 2, number * 4 + SIDE, number * 2 + SIDE))
        shaken = ImageFilter.GaussianBlur({0: 3, 1: 2, 2: 2, 3: 0, 4: 2, 5: 3}[number % 6])
        frames.append(np.asarray(frame.filter(shaken)))
    imageio.imwrite(path, np.stack(frames), plugin="FFMPEG", fps=10, quality=9, macro_block_size=16)
    return path, frames


def test_blurred_frames_are_avoided(film, tmp_path):
    path, frames = film
    seen = []
    assert write_sharp_frames(path, tmp_path, every=6, on_frame=seen.append) == 4
    # The last group has frames 18 and 19 alone; 19 is blurred less.
    assert sorted(file.name for file in tmp_path.iterdir()) == [f"frame_{n:06d}.jpg" for n in (3, 9, 15, 19)]
    assert seen == list(range(1, 21))
    written = np.asarray(Image.open(tmp_path / "frame_000009.jpg"), dtype=float)
    assert np.abs(written - frames[9]).mean() < 6


def test_every_frame_can_be_taken(film, tmp_path):
    assert write_sharp_frames(film[0], tmp_path, every=1) == count_frames(film[0]) == 20


@pytest.mark.parametrize("size", [(40, 60), (1200, 500)])
def test_sharpness_falls_with_blur_and_scales_with_contrast_squared(size):
    picture = Image.fromarray(noise(1280, 1)).crop((0, 0, *size)).convert("RGB")
    blurred = [np.asarray(picture.filter(ImageFilter.GaussianBlur(radius))) for radius in (0, 1, 3, 9)]
    values = [sharpness(frame) for frame in blurred]
    assert values == sorted(values, reverse=True)
    assert sharpness(blurred[0] // 2 * 2) == pytest.approx(4 * sharpness(blurred[0] // 2), rel=0.05)


def test_frames_without_fine_details_are_blurred():
    pixels = np.random.default_rng(0).integers(0, 255, (120, 160, 3), dtype=np.uint8)
    picture = Image.fromarray(pixels).resize((320, 240), Image.Resampling.NEAREST)
    blurred = [is_blurred(np.asarray(picture.filter(ImageFilter.GaussianBlur(radius)))) for radius in (0, 3, 6)]
    assert blurred == [False, True, True]
    assert is_blurred(np.full((60, 80, 3), 90, np.uint8))


def test_an_even_slope_has_contrast_but_is_not_sharp():
    slope = np.repeat(np.arange(0, 250, 5, dtype=np.uint8)[None, :, None], 20, axis=0).repeat(3, axis=2)
    assert sharpness(slope) == 0.0


def test_about_a_hundred_frames_are_left():
    for count in (1, 50, 100, 199, 1000, 12345):
        left = -(-count // frame_stride(count, None))
        assert left == count or 100 <= left < 200


def test_what_is_not_a_video_is_named(tmp_path):
    path = tmp_path / "notes.mp4"
    path.write_text("no film\n" * 100)
    with pytest.raises(InputError, match=r"notes\.mp4 is not in a supported video format \(mp4.*Convert it"):
        count_frames(path)
    with pytest.raises(InputError, match="is not a video that ffmpeg can read"):
        write_sharp_frames(path, tmp_path, every=2)
    with pytest.raises(InputError, match=r"none\.mp4 does not exist; the folder holds"):
        count_frames(tmp_path / "none.mp4")


def ffmpeg(*arguments):
    """Run ffmpeg, or skip the test where it lacks an encoder, a filter or an option."""
    result = subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *map(str, arguments)], capture_output=True)
    if result.returncode:
        pytest.skip(f"this ffmpeg fails: {result.stderr.decode()[:200]}")


def test_a_film_says_nothing_of_its_size_in_its_title(tmp_path):
    """What ffmpeg reports of a file begins with the file's own words."""
    path, title = tmp_path / "large.mp4", "Output #0, null: Video: x, 1x1, frame= 1"
    made = ["-f", "lavfi", "-i", "color=size=1400x1000:rate=2:duration=1", "-metadata", f"title={title}", str(path)]
    subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", *made], check=True)
    assert count_frames(path) == 2
    with budget(megapixels=1):
        refused(count_frames, path, parts=("large.mp4 has 2 megapixels in each frame",))


def test_a_film_that_was_held_upright_is_upright(film, tmp_path, caplog):
    ffmpeg("-display_rotation", 90, "-i", film[0], "-c", "copy", tmp_path / "turned.mp4")
    write_sharp_frames(tmp_path / "turned.mp4", tmp_path, every=6)
    written = np.asarray(Image.open(tmp_path / "frame_000009.jpg"), dtype=float)
    assert np.abs(written - np.rot90(film[1][9])).mean() < 6
    assert not caplog.messages


def test_frames_that_come_at_uneven_times_are_read_once_each(film, tmp_path):
    path = tmp_path / "uneven.mp4"
    ffmpeg("-i", film[0], "-vf", "setpts='if(lt(N,9),N,4*N)/(10*TB)'", "-fps_mode", "passthrough", path)
    assert write_sharp_frames(path, tmp_path, every=1) == count_frames(path) == 20


@pytest.fixture(scope="module")
def hlg_film(tmp_path_factory):
    """Three grays: the HLG signal 0.25, 0.5 and 0.75, of which the last is white."""
    path = tmp_path_factory.mktemp("hlg") / "hlg.mp4"
    tags = "log-level=0:colorprim=bt2020:transfer=arib-std-b67:colormatrix=bt2020nc"
    grey = "color=s=192x64:d=0.3:r=10,format=yuv420p10le,geq=lum='64+876*(1+floor(X/64))/4':cb=512:cr=512"
    ffmpeg("-f", "lavfi", "-i", grey, "-c:v", "libx265", "-crf", 4, "-x265-params", tags, path)
    return path


def greys(folder):
    return np.asarray(Image.open(folder / "frame_000000.jpg"))[32, 32::64, 1].astype(int)


def test_a_film_in_hdr_is_tone_mapped(hlg_film, tmp_path, caplog):
    caplog.set_level("INFO")
    write_sharp_frames(hlg_film, tmp_path, every=3)
    if "will look flat" in caplog.text:
        pytest.skip("this ffmpeg has no zscale")
    # In linear light 0.25 and 0.5 are 0.08 and 0.31 of white, which BT.709 encodes; white itself is compressed.
    assert np.abs(greys(tmp_path) - [64, 136, 237]).max() <= 8
    assert len(caplog.messages) == 1


def test_where_hdr_cannot_be_tone_mapped_one_line_says_so(hlg_film, tmp_path, caplog, monkeypatch):
    monkeypatch.setattr(hdr_films, "FILTERS", {"no_such_filter"})
    write_sharp_frames(hlg_film, tmp_path, every=3)
    assert np.abs(greys(tmp_path) - [64, 128, 191]).max() <= 4
    (said,) = caplog.messages
    assert "HDR (arib-std-b67)" in said
    assert "will look flat. Film without HDR" in said
