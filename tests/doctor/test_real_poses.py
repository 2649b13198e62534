"""Poses as they are read from real captures: a ray through a point of one photograph passes its match in another."""

import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.captures import real_capture

from nerf_lightning.data.readers.colmap import ColmapReader
from nerf_lightning.data.readers.llff import LlffReader
from nerf_lightning.nerf.geometry.cameras import project, rays_through_pixels
from nerf_lightning.nerf.types.rays import PixelIndex

pytestmark = pytest.mark.data
LARGEST_MEDIAN = 1.5
DEPTHS = 400


def epipolar_distances(scene, view, other, here, there):
    """Return how far, in pixels of the other view, matches (n, 2) lie from the rays through their partners.

    The ray is followed in steps and each place projected, so that lenses need no care.
    """
    count = len(here)
    # One camera for each match, its picture shifted so that the match is the centre of pixel 0.
    many = replace(scene.cameras, ndc=None).map(lambda x: x[view].expand(count, *x.shape[1:]))
    many = replace(many, center=many.center + 0.5 - torch.from_numpy(here).float())
    zero = torch.zeros(count, dtype=torch.int64)
    rays = rays_through_pixels(many, PixelIndex(torch.arange(count), zero, zero), torch.zeros(count), torch.ones(count))
    along = torch.logspace(-1, 3, DEPTHS)[:, None, None]
    double = scene.cameras.map(lambda x: x.double() if x.is_floating_point() else x)
    points = (rays.origins + along * rays.directions).double()
    ahead = -(points - double.c2w[other, :, 3]) @ double.c2w[other, :, 2] > 0.01
    seen = project(double, other, points)
    start, step = seen[:-1], seen.diff(dim=0)
    match = torch.from_numpy(there)
    share = (((match - start) * step).sum(-1) / step.square().sum(-1).clamp(min=1e-12)).clamp(0, 1)
    off = (start + share[..., None] * step - match).norm(dim=-1)
    return torch.where(ahead[:-1] & ahead[1:], off, torch.inf).amin(dim=0).numpy()


def median_over_pairs(scene, matches):
    found = [
        epipolar_distances(scene, scene.view_names.index(a), scene.view_names.index(b), here[::4], there[::4])
        for (a, b), (here, there) in matches.items()
    ]
    distances = np.concatenate(found)
    print(f"{scene.name}: median {np.median(distances):.3f} px of {len(distances)} matches in {len(matches)} pairs")
    assert len(distances) > 300
    return float(np.median(distances))


def tracked_features(path):
    """Return the features of each photograph in images.bin that belong to a sparse point: {name: {point: (x, y)}}."""
    data, place, found = path.read_bytes(), 8, {}
    for _ in range(struct.unpack_from("<Q", data)[0]):
        end = data.index(b"\0", place + 64)
        (count,) = struct.unpack_from("<Q", data, end + 1)
        rows = np.frombuffer(data, [("xy", "<2f8"), ("point", "<i8")], count, end + 9)
        rows = rows[rows["point"] >= 0]
        found[data[place + 64 : end].decode()] = dict(zip(rows["point"].tolist(), rows["xy"], strict=True))
        place = end + 9 + 24 * count
    return found


def shared_features(tracks, a, b):
    common = sorted(tracks[a].keys() & tracks[b].keys())
    return np.array([tracks[a][p] for p in common]).reshape(-1, 2), np.array([tracks[b][p] for p in common]).reshape(
        -1, 2
    )


def cup_matches(root):
    tracks = tracked_features(root / "sparse" / "0" / "images.bin")
    names = sorted(tracks)
    pairs = [(a, b) for i, a in enumerate(names) for b in names[i + 1 : i + 30 : 14]][::7]
    matches = {(a, b): shared_features(tracks, a, b) for a, b in pairs}
    return {pair: found for pair, found in sorted(matches.items()) if len(found[0]) >= 40}


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


def read(reader, root, cache):
    return reader(str(root), cache_dir=str(cache)).read()


def test_cup_from_colmap(cache):
    root = real_capture("cup_colmap")
    assert median_over_pairs(read(ColmapReader, root, cache), cup_matches(root)) < LARGEST_MEDIAN


def test_the_rows_of_cups_poses_bounds_belong_to_names_sorted_as_text(cache):
    """Its one focal length is only about right, so the poses are compared with COLMAP's."""
    root = real_capture("cup_colmap")
    llff, colmap = read(LlffReader, root, cache), read(ColmapReader, root, cache)
    assert llff.view_names == colmap.view_names
    assert llff.view_names[:3] == ("1.jpg", "10.jpg", "11.jpg")
    centers = [s.cameras.c2w[:, :, 3] @ s.to_user[:3, :3].T + s.to_user[:3, 3] for s in (llff, colmap)]
    torch.testing.assert_close(*centers, atol=1e-3, rtol=1e-3)
    axes = [s.to_user[:3, :3] @ s.cameras.c2w[:, :, :3] for s in (llff, colmap)]
    turned = (axes[0] / axes[0].norm(dim=1, keepdim=True) * axes[1] / axes[1].norm(dim=1, keepdim=True)).sum(dim=1)
    assert float(turned.min()) > 0.9999
    # In numeric order they would belong to others.
    numeric = sorted(range(len(llff.view_names)), key=lambda view: int(llff.view_names[view].split(".")[0]))
    assert float((centers[0][numeric] - centers[1]).norm(dim=-1).median()) > 0.1
