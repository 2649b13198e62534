"""Which photographs a view is rendered from: the nearest, of its own capture, and never its own."""

from dataclasses import replace

import pytest
import torch
from support.looking import rays_of_views
from support.scenes import ball_scene

from nerf_lightning.errors import InputError
from nerf_lightning.nerf.geometry.photographs import photographs_of
from nerf_lightning.nerf.models.view_transformer.source_views import choose_sources
from nerf_lightning.nerf.randomness import batch_random

NUM_VIEWS = 12


def chosen(scene, views, targets, count=4, key=None, named=True):
    rays = rays_of_views(scene, targets, every=50)
    if not named:
        rays = replace(rays, photograph=None)
    photographs = photographs_of(scene, list(views))
    random = None if key is None else batch_random(key, len(rays.near))
    sources = choose_sources(photographs, rays, count, random)
    of_ray = {}
    for ray, target in enumerate(sources.target.tolist()):
        places = sources.places[target][sources.given[target]]
        of_ray.setdefault(int(rays_of_views(scene, targets, every=50).photograph[ray]), set()).add(
            tuple(photographs.numbers[places].tolist())
        )
    assert all(len(of_view) == 1 for of_view in of_ray.values())
    return {view: of_view.pop() for view, of_view in of_ray.items()}


def test_the_nearest_around_the_content_are_taken():
    scene = ball_scene(NUM_VIEWS)
    assert {view: set(of) for view, of in chosen(scene, range(NUM_VIEWS), [0, 5]).items()} == {
        0: {10, 11, 1, 2},
        5: {3, 4, 6, 7},
    }


def test_around_content_directions_count_and_not_distances():
    """A camera that stands twice as far in the same direction is a better source than a neighbour."""
    scene = ball_scene(NUM_VIEWS)
    c2w = scene.cameras.c2w.clone()
    c2w[6, :, 3] = 3.0 * c2w[0, :, 3]
    c2w[6, :, :3] = c2w[0, :, :3]
    scene = replace(scene, cameras=replace(scene.cameras, c2w=c2w))
    assert chosen(scene, range(NUM_VIEWS), [0], count=1) == {0: (6,)}


def test_facing_forward_distances_count():
    scene = ball_scene(NUM_VIEWS)
    c2w = scene.cameras.c2w[:1].repeat(NUM_VIEWS, 1, 1)
    c2w[:, 0, 3] += torch.arange(NUM_VIEWS) ** 1.5
    scene = replace(scene, cameras=replace(scene.cameras, c2w=c2w))
    assert chosen(scene, range(NUM_VIEWS), [9], count=3) == {9: (8, 10, 7)}


@pytest.mark.parametrize("key", [None, *range(40)])
def test_a_photograph_is_never_among_its_own_sources(key):
    scene = ball_scene(NUM_VIEWS)
    for view, sources in chosen(scene, range(NUM_VIEWS), [0, 3, 11], key=key).items():
        assert view not in sources
        assert len(set(sources)) == len(sources)


def test_who_only_stands_where_a_photograph_was_taken_sees_it():
    scene = ball_scene(NUM_VIEWS)
    assert chosen(scene, range(NUM_VIEWS), [3], named=False)[3][0] == 3


def test_sources_are_of_the_same_capture():
    scene = ball_scene(NUM_VIEWS)
    capture = torch.tensor([0, 1] * (NUM_VIEWS // 2))
    scene = replace(scene, capture_of=tuple(capture.tolist()), captures=("even", "odd"))
    rays = rays_of_views(scene, [2, 3], every=50)
    rays = replace(rays, capture=capture[rays.photograph])
    sources = choose_sources(photographs_of(scene, range(NUM_VIEWS)), rays, 4, None)
    for ray, target in enumerate(sources.target.tolist()):
        assert set((sources.places[target] % 2).tolist()) == {int(rays.capture[ray])}


def test_numbers_and_pools_vary_in_training_and_follow_the_key_alone():
    scene = ball_scene(NUM_VIEWS)
    seen = [chosen(scene, range(NUM_VIEWS), [0], key=key)[0] for key in range(60)]
    assert {len(each) for each in seen} == {2, 3, 4, 5, 6}
    assert len({view for each in seen for view in each}) > 8
    assert seen[7] == chosen(scene, range(NUM_VIEWS), [0], key=7)[0]
    # Whatever other targets are beside it, and wherever the tile is cut.
    assert seen[7] == chosen(scene, range(NUM_VIEWS), [4, 0, 9], key=7)[0]


def test_a_capture_without_other_photographs_is_refused():
    with pytest.raises(InputError, match="none but its own"):
        chosen(ball_scene(NUM_VIEWS), [3], [3])
