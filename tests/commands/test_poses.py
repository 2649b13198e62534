import sys

import numpy as np
import pytest
from PIL import Image, ImageFilter
from support.alignment import colmap_poses, pose_errors
from support.corner import corner_poses, photograph, write_corner
from support.decoders import without_heic
from support.running import done, said

from nerf_lightning.files.made_folders import make_ours

pytest.importorskip("pycolmap")
# imageio's reader of videos forgets its pipes.
pytestmark = pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")

MODEL_FILES = {"cameras.bin", "images.bin", "points3D.bin"}


@pytest.fixture
def photographs(tmp_path):
    """Three pictures without anything in common."""
    folder = tmp_path / "photographs"
    folder.mkdir()
    for number in range(3):
        pixels = np.random.default_rng(number).integers(0, 255, (80, 96, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"{number}.png")
    return folder


@pytest.fixture
def poses(nerf, tmp_path):
    """Call `nerf poses` into tmp_path/found."""
    return lambda *arguments: nerf("poses", f"paths.output_dir={tmp_path / 'found'}", "num_threads=1", *arguments)


def refused(result, tmp_path, *fragments):
    said(result, *fragments)
    assert not (tmp_path / "found").exists()


def test_pycolmap_absent_is_said_with_the_cure(poses, photographs, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    result = poses(f"images={photographs}")
    refused(result, tmp_path, "pycolmap", "pip install '.[colmap]'")


@pytest.mark.parametrize(
    ("settings", "fragment"),
    [
        ([], "either images=DIR (a folder of photographs) or video=FILE"),
        (["images=a", "video=b"], "Give either images=DIR"),
        (["images=a", "camera_model=FULL"], "camera_model=FULL is not valid: it must be SIMPLE_PINHOLE"),
        (["images=a", "num_features=0"], "num_features=0: give 1 or more"),
        (["images=[1]"], "images=[1] is not valid: it must be a path"),
        (["images=nowhere"], "images=nowhere is not a folder that can be read (No such file or directory)"),
        (["video=nowhere.mp4"], "nowhere.mp4 does not exist; the folder holds"),
    ],
)
def test_bad_settings_are_named(poses, tmp_path, settings, fragment):
    refused(poses(*settings), tmp_path, fragment)


def test_folders_without_enough_photographs_are_named(poses, tmp_path):
    folder = tmp_path / "given"
    folder.mkdir()
    refused(poses(f"images={folder}"), tmp_path, f"{folder} holds no PNG, JPEG, TIFF, WebP, AVIF or HEIC, nothing.")
    (folder / "photos").mkdir()
    (folder / "a.HEIC").touch()
    with without_heic():
        refused(
            poses(f"images={folder}"), tmp_path, "holds a.HEIC. HEIC, as phones save it", "magick mogrify", ".[heic]"
        )
    (folder / "a.HEIC").rename(folder / "a.cr2")
    refused(poses(f"images={folder}"), tmp_path, "only other files (.cr2)", "subfolders (photos)", "Convert raw")
    Image.new("RGB", (80, 80)).save(folder / "a.png")
    refused(poses(f"images={folder}"), tmp_path, "holds only a.png. At least 3 photographs")


def test_pictures_that_cannot_be_used_are_left_out_and_named(poses, photographs, tmp_path):
    def left_out(*words):
        result = poses(f"images={photographs}")
        assert result.code == 2
        assert "1 of 4 views are left out: odd.png. The first:" in result.err
        assert all(word in result.err for word in words)
        assert "No camera could be placed: the 3 pictures" in result.err

    odd = photographs / "odd.png"
    Image.new("RGB", (80, 20)).save(odd)
    left_out("odd.png is 80 x 20 pixels: too small")
    odd.unlink()
    odd.symlink_to(odd)
    left_out(f"odd.png is a symbolic link to {odd}, which leads nowhere")
    odd.unlink()
    odd.write_bytes((photographs / "0.png").read_bytes()[:3000])  # damage behind the header stops: it is decoded later
    refused(poses(f"images={photographs}"), tmp_path, "odd.png cannot be read", "cut short")


def test_heic_beside_its_copy_is_passed_over_and_panoramas_are_left_out(poses, photographs):
    (photographs / "0.heic").touch()
    around = b'<x:xmpmeta><rdf:Description GPano:ProjectionType="equirectangular"/></x:xmpmeta>'
    Image.new("RGB", (128, 64)).save(photographs / "around.jpg", xmp=around)
    result = poses(f"images={photographs}")
    assert result.code == 2
    assert "1 of 4 pictures are left out, since they are panoramas: around.jpg." in result.err
    assert "No camera could be placed: the 3 pictures" in result.err


@pytest.mark.minutes
@pytest.mark.parametrize(
    ("pictures", "blur", "why"),
    [
        (4, 6, "are nearly all blurred, although"),
        (4, 0, "share too few"),
        (1, 0, "without depth, all from one position"),
    ],
)
def test_a_film_that_nothing_can_be_made_of_says_why(poses, tmp_path, pictures, blur, why):
    imageio = pytest.importorskip("imageio.v3")
    frames = []
    for number in range(4):  # nothing is seen twice, or the camera stands still
        pixels = np.random.default_rng(number % pictures).integers(0, 255, (96, 96, 3), dtype=np.uint8)
        frame = Image.fromarray(pixels).resize((192, 192), Image.Resampling.NEAREST)
        frames.append(np.asarray(frame.filter(ImageFilter.GaussianBlur(blur))))
    imageio.imwrite(tmp_path / "film.mp4", np.stack(frames), plugin="FFMPEG", fps=10, quality=9)
    result = poses(f"video={tmp_path / 'film.mp4'}", "every=1", "num_features=300")
    refused(result, tmp_path, "no camera could be placed for the 4 frames", why, "Film again")


@pytest.mark.minutes
@pytest.mark.slow
def test_of_photographs_of_two_places_the_larger_part_is_taken_and_the_other_named(poses, tmp_path):
    folder = tmp_path / "given"
    write_corner(folder, count=5)
    for number in range(4):  # another place, with other walls
        picture = Image.fromarray(photograph(corner_poses(4)[number], first_wall=3))
        picture.save(folder / f"elsewhere {number}.png")
    result = done(poses(f"images={folder}", "num_features=350"))
    assert "registered          5 of 9 photographs" in result.out
    assert "elsewhere 3.png fit together but not with the rest: if they show another place, make a" in result.out
    left = sorted(path.name for path in (tmp_path / "found" / "sparse").iterdir())
    assert left == ["0"]


def test_photographs_of_several_sizes_or_without_anything_in_common(poses, photographs, tmp_path):
    refused(poses(f"images={photographs}"), tmp_path, "No camera could be placed: the 3 pictures", "overlap by two")
    Image.new("RGB", (80, 80)).save(photographs / "odd.png")
    refused(poses(f"images={photographs}", "camera_mode=single"), tmp_path, "3 of 96 x 80, 1 of 80 x 80")


def test_poses_and_pictures_that_exist_are_not_overwritten(poses, photographs, tmp_path):
    (tmp_path / "found" / "images").mkdir(parents=True)
    said(poses(f"images={photographs}"), "exists already, and is not the folder given with images=")
    (tmp_path / "found" / "sparse" / "0").mkdir(parents=True)
    said(poses(f"images={photographs}"), "has camera poses already (sparse/0). Remove them")


@pytest.mark.slow
def test_the_cameras_of_a_known_scene_are_found(poses, tmp_path):
    true = write_corner(tmp_path / "found" / "images", count=6)
    (make_ours(tmp_path / "found", ".poses.part") / "models").mkdir()  # as a killed process leaves it
    result = done(poses(f"images={tmp_path / 'found' / 'images'}", "camera_model=SIMPLE_PINHOLE", "num_features=600"))
    assert result.err == ""
    assert "registered          6 of 6 photographs (one camera, exhaustive matching)" in result.out
    assert f"nerf train model=fast_proposal scene=colmap scene.root={tmp_path / 'found'}" in result.out
    assert {path.name for path in (tmp_path / "found").iterdir()} == {"images", "sparse"}
    found = colmap_poses(tmp_path / "found" / "sparse" / "0")
    assert sorted(found) == [f"view {number}.png" for number in range(6)]
    centres, degrees = pose_errors(np.stack([found[name] for name in sorted(found)]), true)
    assert centres.max() < 0.01 * 3.4
    assert degrees.max() < 0.5


@pytest.mark.minutes
@pytest.mark.slow
def test_photographs_left_out_are_named(poses, tmp_path):
    """Four views of the corner, two of them cut narrower, and three pictures of nothing."""
    folder = tmp_path / "given"
    write_corner(folder, count=4)
    for number in (1, 2):
        Image.open(folder / f"view {number}.png").crop((10, 0, 310, 240)).save(folder / f"view {number}.png")
    for number in range(3):
        Image.new("RGB", (200, 150), (60 * number, 90, 120)).save(folder / f"wall {number}.png")
    result = done(poses(f"images={folder}", "num_features=350", "matching=sequential"))
    assert "registered          4 of 7 photographs (2 cameras, sequential matching)" in result.out
    assert "left out            wall 0.png, wall 1.png, wall 2.png" in result.out
    assert "few were registered" in result.out
    assert "matching=exhaustive compares" in result.out
    assert {path.name for path in (tmp_path / "found" / "sparse" / "0").iterdir()} >= MODEL_FILES
    assert len(list((tmp_path / "found" / "images").iterdir())) == 7


@pytest.mark.slow
def test_a_film_is_read_and_reconstructed(poses, tmp_path):
    imageio = pytest.importorskip("imageio.v3")
    write_corner(tmp_path / "frames", count=12)
    frames = [np.asarray(Image.open(tmp_path / "frames" / f"view {n}.png").convert("RGB")) for n in range(12)]
    imageio.imwrite(tmp_path / "film.mp4", np.stack(frames), plugin="FFMPEG", fps=10, quality=9)
    result = done(poses(f"video={tmp_path / 'film.mp4'}", "every=2", "num_features=350"))
    assert "registered          6 of 6 frames" in result.out
    assert len(list((tmp_path / "found" / "images").glob("frame_*.jpg"))) == 6
