"""Photographs and nothing else: cameras are found once, and kept."""

import shutil

import numpy as np
import pytest
from PIL import Image
from support.captures import real_capture
from support.posed_captures import Known, write_colmap

from nerf_lightning.data.sfm import reader
from nerf_lightning.data.sfm.reader import PhotosReader
from nerf_lightning.data.sfm.reconstruction import SparseModel
from nerf_lightning.messages.errors import InputError


@pytest.fixture
def photographs(tmp_path):
    """A folder of photographs, and a stand-in for structure from motion that knows their cameras."""
    folder = tmp_path / "photographs"
    write_colmap(tmp_path / "known", Known())
    shutil.move(tmp_path / "known" / "images", folder)
    return folder


@pytest.fixture
def found(tmp_path, monkeypatch):
    """The calls of structure from motion, which gives what is known."""
    calls = []

    model = SparseModel(("a", "b", "c"), ("d", "e"), ("d",), num_points=9, num_cameras=1, reprojection_error=0.5)

    def from_photographs(source, folder, settings):
        calls.append(source)
        shutil.copytree(tmp_path / "known" / "sparse", folder / "sparse")
        shutil.copytree(source, folder / "images")
        return model, "exhaustive"

    monkeypatch.setattr(reader, "from_photographs", from_photographs)
    monkeypatch.setattr(reader, "require_pycolmap", lambda: None)
    return calls


def test_cameras_are_found_once_and_again_where_a_photograph_has_changed(photographs, found, tmp_path, caplog):
    caplog.set_level("INFO")
    settings = {"root": str(photographs), "cache_dir": str(tmp_path / "cache")}
    first, second = PhotosReader(**settings).read(), PhotosReader(**settings).read()
    assert first.view_names == second.view_names
    assert found == [photographs]
    assert "cameras: found 3 of 5, with an error of 0.50 pixels" in caplog.text
    assert "cameras: d fit together but not with the rest: if they show another place" in caplog.text
    assert "few were registered: take more photographs" in caplog.text
    changed = sorted(photographs.iterdir())[0]
    Image.fromarray(np.zeros(np.asarray(Image.open(changed)).shape, np.uint8)).save(changed)
    PhotosReader(**settings).read()
    assert len(found) == 2


def test_cameras_of_plain_photographs_are_not_taken_for_those_of_panoramas(photographs, found, tmp_path):
    for panoramas in ("auto", False, False):
        PhotosReader(root=str(photographs), cache_dir=str(tmp_path / "cache"), panoramas=panoramas).read()
    assert found == [photographs] * 2


def test_photographs_in_images_below_the_folder_are_found(photographs, found, tmp_path):
    (tmp_path / "capture").mkdir()
    shutil.move(photographs, tmp_path / "capture" / "images")
    PhotosReader(root=str(tmp_path / "capture"), cache_dir=str(tmp_path / "cache"), hold_every=2).read()
    assert found == [tmp_path / "capture" / "images"]


def test_a_folder_of_a_known_format_is_read_as_what_it_is(tmp_path, found, caplog):
    caplog.set_level("INFO")
    write_colmap(tmp_path / "capture", Known())
    scene = PhotosReader(root=str(tmp_path / "capture"), cache_dir=str(tmp_path / "cache")).read()
    assert not found
    assert "read as scene=colmap" in caplog.text
    assert scene.background == "black"


@pytest.mark.parametrize("given", [{}, {"root": "a", "video": "b"}])
def test_a_folder_or_a_video_is_needed_and_not_both(given):
    with pytest.raises(InputError, match=r"scene\.root=DIR\) or a video \(scene\.video=FILE\), and not both"):
        PhotosReader(**given).read()


@pytest.mark.slow
@pytest.mark.parametrize(("smaller", "points"), [(6, 200), pytest.param(1, 500, marks=pytest.mark.exhaustive)])
def test_real_photographs_become_a_scene(tmp_path, smaller, points):
    pytest.importorskip("pycolmap")
    (tmp_path / "images").mkdir()
    for path in (real_capture("sceaux_photos") / "images").glob("*.jpg"):
        photograph = Image.open(path)
        photograph.reduce(smaller).save(tmp_path / "images" / path.name, quality=95, exif=photograph.getexif())
    scene = PhotosReader(root=str(tmp_path), downscale=max(1, 8 // smaller), cache_dir=str(tmp_path / "cache")).read()
    assert len(scene.view_names) >= 9
    assert len(scene.points) > points
