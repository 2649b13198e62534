"""What these exporters refuse: settings that make no sense, missing libraries, frames and disks that it cannot use."""

import sys
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec

import psutil
import pytest
from support.known_fields import ball, solid
from support.scenes import ball_scene

from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.export import base
from nerf_lightning.extensions.geometry_exports.mesh import MeshExport
from nerf_lightning.extensions.geometry_exports.points import PointsExport
from nerf_lightning.extensions.geometry_exports.volume import VolumeExport
from nerf_lightning.messages import errors
from nerf_lightning.messages.errors import InputError

TILE = 1 << 15
with_xatlas = pytest.mark.skipif(find_spec("xatlas") is None, reason="xatlas is not installed (the extra texture)")


def record(**changes):
    return replace(scene_record(ball_scene(num_views=8, size=24)), **changes)


def exported(folder, what, **changes):
    return what.export(solid(ball()), record(**changes), folder, TILE)


@pytest.mark.parametrize(
    ("exporter", "settings", "said"),
    [
        (MeshExport, {"threshold": 0.0}, "what.threshold=0.0"),
        (MeshExport, {"surface": "tsdf", "threshold": 3.0}, "what.threshold=3.0 belongs to what.surface=density"),
        (MeshExport, {"surface": "tsdf", "seen_only": False}, "what.seen_only=false asks for a closed mesh"),
        (MeshExport, {"texture": True, "format": "ply"}, "what.format=ply has no texture"),
        (MeshExport, {"surface": "tsdf", "format": "stl"}, "what.format=stl asks for a closed mesh"),
        (PointsExport, {"agreement": 9}, "what.agreement=9"),
    ],
)
def test_settings_that_make_no_sense_are_refused(exporter, settings, said):
    with pytest.raises(InputError) as error:
        exporter(**settings)
    assert said in str(error.value)


@pytest.mark.parametrize("exporter", [MeshExport, VolumeExport])
def test_no_grid_is_laid_over_ndc_or_has_one_cell(tmp_path, exporter):
    with pytest.raises(InputError, match=r"what=\w+: ball was trained in normalized device coordinates"):
        exported(tmp_path, exporter(8), space="ndc")
    with pytest.raises(InputError, match=r"what\.resolution=1: give the number of cells"):
        exported(tmp_path, exporter(1))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("what", "said"),
    [
        (VolumeExport(1024), r"12\.9 GB, but only 0\.8 GB of memory are available\. what\.resolution=\d+ would fit"),
        (MeshExport(2048, "tsdf"), r"2049 x 2049 x 2049 points, which takes 103\.\d GB.*what\.resolution=\d+ would"),
        pytest.param(
            MeshExport(texture=True, texture_size=8192),
            r"8192 x 8192 texels, which takes 6\.\d GB.*texture_size=\d+ w",
            marks=with_xatlas,
        ),
    ],
)
def test_what_is_beyond_memory_is_refused_with_what_would_fit(tmp_path, monkeypatch, what, said):
    monkeypatch.setattr(psutil, "virtual_memory", lambda: type("Memory", (), {"available": 1e9}))
    with pytest.raises(InputError, match=said):
        exported(tmp_path, what)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("library", "what", "said"),
    [
        ("skimage", MeshExport(16), r"needs scikit-image, .*pip install '\.\[mesh\]'"),
        ("xatlas", MeshExport(16, texture=True), r"texture needs xatlas, .*pip install '\.\[texture\]'"),
        ("laspy", PointsExport(format="las"), r"points as LAS needs laspy, .*pip install '\.\[las\]'"),
    ],
)
def test_a_missing_library_is_named_with_its_cure(tmp_path, monkeypatch, library, what, said):
    def absent(name):
        if name.startswith(library):
            raise ImportError(f"No module named '{library}'")
        return import_module(name)

    monkeypatch.setattr(errors, "import_module", absent)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(InputError, match=said):
        exported(tmp_path, what)
    assert not list(tmp_path.iterdir())


def test_without_numba_a_fused_surface_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(base, "backend", lambda module: None)
    with pytest.raises(InputError, match=r"what\.surface=tsdf needs numba.*use what\.surface=density"):
        exported(tmp_path, MeshExport(16, "tsdf"))


TEXTURED = MeshExport(10, texture=True, texture_size=64, format="obj")


@pytest.mark.parametrize("what", [MeshExport(10), pytest.param(TEXTURED, marks=with_xatlas)])
def test_a_full_disk_leaves_nothing(tmp_path, monkeypatch, what):
    def full(self, content):
        self.open("wb").close()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(OSError, match="No space left"):
        exported(tmp_path, what)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("what", [PointsExport(agreement=1), MeshExport(resolution=16, surface="tsdf")])
def test_fainter_matter_than_asked_for_is_left_out_of_points_and_meshes(tmp_path, what):
    """A ball that stops at most four fifths of the light."""
    haze, scene = solid(ball(), inside=1.0), record()
    with pytest.raises(InputError, match="There is no surface to export"):
        what.export(haze, scene, tmp_path, TILE, base.RunContext(min_opacity=0.9))
    assert what.export(haze, scene, tmp_path, TILE)[0].is_file()
