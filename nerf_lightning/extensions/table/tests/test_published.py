"""Numbers that others published, and the scenes they are for."""

import statistics

import pytest

from nerf_lightning.extensions.table.published import published_for

BLENDER = ("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship")
LLFF = ("fern", "flower", "fortress", "horns", "leaves", "orchids", "room", "trex")
MIP360 = ("bicycle", "flowers", "garden", "stump", "treehill", "room", "counter", "kitchen", "bonsai")
SEVEN_OF_MIP360 = ("bicycle", "garden", "stump", "bonsai", "counter", "kitchen", "room")


@pytest.mark.parametrize(
    ("method", "scenes", "reader", "mean"),
    [
        ("NeRF", BLENDER, "blender", 31.01),
        ("NeRF of nerf-factory", BLENDER, "blender", 32.33),
        ("MLP with occupancy grid of nerfacc", BLENDER, "blender", 31.55),
        ("ngp_pl", BLENDER, "blender", 32.96),
        ("Zip-NeRF", BLENDER, "blender", 33.69),
        ("Instant NGP, on black", BLENDER, "blender", 33.18),
        ("Instant NGP", BLENDER, "blender", 32.20),
        ("Instant NGP with occupancy grid of nerfacc", BLENDER, "blender", 33.11),
        ("Instant NGP with proposals of nerfacc", BLENDER, "blender", 31.76),
        ("nerfacto", BLENDER, "blender", 29.19),
        ("gsplat", BLENDER, "blender", 31.47),
        ("NeRF of nerf-factory", LLFF, "llff", 26.85),
        ("Zip-NeRF", MIP360, "colmap", 28.56),
        ("Instant NGP with occupancy grid of nerfacc", SEVEN_OF_MIP360, "colmap", 26.41),
        ("Instant NGP with proposals of nerfacc", SEVEN_OF_MIP360, "colmap", 27.58),
    ],
)
def test_the_numbers_give_the_published_means(method, scenes, reader, mean):
    """A mistyped digit would show: each method's mean was published beside its scenes."""
    found = [
        next(result.psnr for result in published_for(scene, reader) if result.method == method) for scene in scenes
    ]
    assert statistics.fmean(found) == pytest.approx(mean, abs=0.0105)


def test_a_scene_is_found_by_its_first_word_and_in_its_own_format_alone():
    assert next(found.method for found in published_for("Lego_200", "blender")) == "Instant NGP, on black"
    assert published_for("lego", "colmap") == []
    assert published_for("legolas", "blender") == []
    assert {found.benchmark for found in published_for("room", "colmap")} == {"LLFF", "mip-NeRF 360"}
