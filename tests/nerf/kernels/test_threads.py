import multiprocessing
import threading
import time

import numpy as np
import pytest
import torch

from nerf_lightning.nerf.kernels.search import search, search_by_comparison
from nerf_lightning.nerf.kernels.threads import in_parallel, num_threads, over_rows, torch_on_one_thread


@pytest.fixture(autouse=True)
def two_threads(set_threads):
    set_threads(2)


def threads_of_parts(_=None):
    return in_parallel(lambda part: torch.get_num_threads(), range(6))


def test_each_part_computes_alone_and_other_threads_keep_theirs():
    assert threads_of_parts() == [1] * 6
    torch.set_num_threads(3)
    assert threads_of_parts() == [1] * 6
    torch.set_num_threads(2)
    assert threads_of_parts() == [1] * 6
    seen = []
    other = threading.Thread(target=lambda: seen.append(torch.get_num_threads()))
    other.start()
    other.join()
    assert [*seen, torch.get_num_threads()] == [2, 2]


def test_results_come_in_order_parts_within_parts_wait_for_nobody_and_what_fails_fails_here():
    def slow_first(part):
        time.sleep(0.05 if part == 0 else 0.0)
        return [part, *in_parallel(lambda inner: inner, range(3))]

    assert in_parallel(slow_first, range(4)) == [[part, 0, 1, 2] for part in range(4)]
    with pytest.raises(ZeroDivisionError):
        in_parallel(lambda part: 1 // part, range(3))


def test_torch_may_have_one_thread_while_work_is_shared_out():
    with torch_on_one_thread():
        assert (torch.get_num_threads(), num_threads()) == (1, 2)
        seen = in_parallel(lambda part: (torch.get_num_threads(), num_threads(), threading.get_ident()), range(64))
        assert {each[:2] for each in seen} == {(1, 1)}
        with torch_on_one_thread():
            assert num_threads() == 2
        assert (torch.get_num_threads(), num_threads()) == (1, 2)
    assert (torch.get_num_threads(), num_threads()) == (2, 2)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.enable_grad, torch.inference_mode])
def test_gradients_are_kept_in_a_part_where_they_are_outside(mode):
    with mode():
        wanted = (torch.is_grad_enabled(), torch.is_inference_mode_enabled())
        seen = in_parallel(lambda part: (torch.is_grad_enabled(), torch.is_inference_mode_enabled()), range(3))
    assert seen == [wanted] * 3


@pytest.mark.parametrize("rows", [0, 1, 511, 1024, 5000])
def test_every_row_is_taken_once(rows):
    taken = torch.zeros(rows)

    def take(first, last, into):
        into[first:last] += 1

    over_rows(take, rows, taken)
    assert taken.tolist() == [1.0] * rows


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork on this system")
def test_a_fork_has_threads_of_its_own():
    threads_of_parts()
    with multiprocessing.get_context("fork").Pool(1) as forks:
        assert forks.apply_async(threads_of_parts).get(timeout=60) == [1] * 6


@pytest.mark.parametrize("right", [False, True])
@pytest.mark.parametrize("way", [search, search_by_comparison])
def test_every_way_finds_what_numpy_finds(way, right, generator):
    ordered = torch.rand(5, 13, generator=generator).sort(-1).values
    ordered[:, 4] = ordered[:, 3]  # equal neighbors
    numbers = torch.cat([torch.rand(5, 20, generator=generator) * 1.4 - 0.2, ordered], dim=-1)
    found = way(ordered, numbers, right)
    for row in range(5):
        expected = np.searchsorted(ordered[row].numpy(), numbers[row].numpy(), side="right" if right else "left")
        assert found[row].tolist() == expected.tolist()


def test_devices_without_a_search_of_their_own_compare(monkeypatch):
    monkeypatch.setattr(torch, "searchsorted", None)
    assert search(torch.ones(2, 3, device="meta"), torch.ones(2, 5, device="meta")).shape == (2, 5)
