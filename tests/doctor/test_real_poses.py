"""Poses of one real capture in two formats; whether they fit its pixels: test_doctor_checks.py."""

import pytest
import torch
from support.captures import real_capture

from nerf_lightning.data.readers.colmap import ColmapReader
from nerf_lightning.data.readers.llff import LlffReader

pytestmark = pytest.mark.data


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


def read(reader, root, cache):
    return reader(str(root), cache_dir=str(cache)).read()


def test_the_rows_of_cups_poses_bounds_belong_to_names_sorted_as_text(cache):
    """Its one focal length is only about right, so the poses are compared with COLMAP's."""
    root = real_capture("cup_colmap")
    llff, colmap = read(LlffReader, root, cache), read(ColmapReader, root, cache)
    assert llff.view_names == colmap.view_names
    assert llff.view_names[:3] == ("1.jpg", "10.jpg", "11.jpg")
    centers = [s.cameras.c2w[:, :, 3].double() @ s.to_user[:3, :3].T + s.to_user[:3, 3] for s in (llff, colmap)]
    torch.testing.assert_close(*centers, atol=1e-3, rtol=1e-3)
    axes = [s.to_user[:3, :3] @ s.cameras.c2w[:, :, :3].double() for s in (llff, colmap)]
    turned = (axes[0] / axes[0].norm(dim=1, keepdim=True) * axes[1] / axes[1].norm(dim=1, keepdim=True)).sum(dim=1)
    assert float(turned.min()) > 0.9999
    # In numeric order they would belong to others.
    numeric = sorted(range(len(llff.view_names)), key=lambda view: int(llff.view_names[view].split(".")[0]))
    assert float((centers[0][numeric] - centers[1]).norm(dim=-1).median()) > 0.1
