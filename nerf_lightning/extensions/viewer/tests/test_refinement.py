"""Coarse at once, finer while still, nothing stale."""

import pytest
import torch

from nerf_lightning.extensions.viewer.camera_state import CameraState
from nerf_lightning.extensions.viewer.progressive import ProgressiveRendering
from nerf_lightning.extensions.viewer.render_queue import RenderQueue
from nerf_lightning.extensions.viewer.renderer import SlicedRenderer

MOVING = 40


class FakeRenderer(SlicedRenderer):
    """Every picture takes as many slices as it is high, over 10."""

    def __init__(self):
        pass

    def height_while_moving(self, look):
        return MOVING

    def slices(self, look, height):
        for _ in range(height // 10):
            yield
        return look, height


@pytest.fixture
def seen():
    return []


@pytest.fixture
def refinement(seen):
    return ProgressiveRendering(lambda view, look, finest: seen.append((*view, finest)), most_height=300)


def a_look(height=1000):
    return CameraState(torch.eye(4)[:3], 1.0, 1000, height)


def work_out(refinement, most=10_000):
    for count in range(most):
        if not refinement.work(FakeRenderer()):
            return count
    raise AssertionError("it never rests")


def test_a_still_person_gets_finer_pictures_up_to_the_finest_and_then_there_is_rest(refinement, seen):
    assert work_out(refinement) == 0
    refinement.ask(a_look())
    work_out(refinement)
    assert [(height, finest) for _, height, finest in seen] == [(40, False), (80, False), (160, False), (300, True)]
    assert not refinement.work(FakeRenderer())


def test_a_small_window_needs_no_larger_picture(refinement, seen):
    refinement.ask(a_look(height=30))
    work_out(refinement)
    assert [height for _, height, _ in seen] == [30]


def test_a_finer_picture_of_an_old_wish_is_dropped(refinement, seen):
    old, new = a_look(), a_look()
    refinement.ask(old)
    while len(seen) < 1:
        refinement.work(FakeRenderer())
    refinement.work(FakeRenderer())  # the finer one has begun
    refinement.ask(new)
    work_out(refinement)
    assert [look is old for look, _, _ in seen] == [True, False, False, False, False]


def test_who_never_stops_moving_still_sees_pictures(refinement, seen):
    for _ in range(50):
        refinement.ask(a_look())
        refinement.work(FakeRenderer())
    assert len(seen) == 10  # 4 slices and the showing
    assert {height for _, height, _ in seen} == {MOVING}


def test_what_cannot_be_rendered_is_tried_again_with_another_model_and_a_wish_meanwhile_is_not_lost(refinement, seen):
    refinement.ask(a_look())
    refinement.work(FakeRenderer())
    refinement.give_up()
    assert work_out(refinement) == 0
    refinement.refresh()
    work_out(refinement)
    assert [height for _, height, _ in seen] == [300]
    refinement.ask(a_look())
    refinement.work(FakeRenderer())
    refinement.ask(wished := a_look())
    refinement.give_up()
    work_out(refinement)
    assert [look is wished for look, _, _ in seen[1:]] == [True] * 4


def test_a_refreshed_view_is_rendered_once_more_at_its_finest(refinement, seen):
    refinement.ask(a_look())
    work_out(refinement)
    refinement.refresh()
    work_out(refinement)
    assert [height for _, height, _ in seen[-2:]] == [300, 300]
    assert len(seen) == 5


def test_who_moves_comes_before_who_waits_for_details_and_nobody_starves():
    seen = []
    queue = RenderQueue(FakeRenderer())
    people = [
        ProgressiveRendering(lambda view, look, finest, who=who: seen.append((who, view[1])), 300) for who in range(3)
    ]
    for who, person in enumerate(people):
        person.ask(a_look())
        queue.add(who, person)
    while queue.work():
        pass
    assert [height for _, height in seen[:3]] == [40, 40, 40]
    assert sorted(who for who, height in seen if height == 300) == [0, 1, 2]
    people[2].ask(a_look())
    people[1].refresh()
    queue.work()
    assert people[2]._job is not None
    assert people[1]._job is None
