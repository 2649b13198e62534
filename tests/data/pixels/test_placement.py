"""Pixels on a device, batches made ahead: the same rays in the same order as from memory, whatever the run does."""

import pickle
import threading
from dataclasses import replace

import psutil
import pytest
import torch
from support.scenes import ball_scene

from nerf_lightning.data import datamodule
from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.data.pixels import placement
from nerf_lightning.data.pixels.mapped_store import Header, stored
from nerf_lightning.data.pixels.placement import budget_bytes, on_device
from nerf_lightning.data.ray_batches import RayBatches, made_ahead
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.types.progress import Progress

CPU = torch.device("cpu")


def loader(scene, ahead=False):
    batches = RayBatches(scene, Progress(), seed=3, batch_rays=50)
    batches.crop_to(0.5, steps=2, restart_steps=3)
    batches.prefetch_for = CPU if ahead else None
    return batches


def equal(ours, theirs):
    pairs = [(ours.rgba, theirs.rgba), (ours.weight, theirs.weight)]
    pairs += [(value, vars(theirs.pixels)[name]) for name, value in vars(ours.pixels).items()]
    return all(torch.equal(a, b) for a, b in pairs)


def masked_scene():
    scene = ball_scene()
    mask = (torch.arange(len(scene.pixels.rgba)) % 7 > 0).to(torch.uint8)
    return replace(scene, pixels=replace(scene.pixels, mask=mask))


def wander(batches):
    """Batches of a run that restarts, changes its batch size, stands still and goes back, as a resumed one does."""
    progress, stream, seen = batches.progress, iter(batches), []
    for step in range(20):
        batch = next(stream)
        seen.append(batch)
        if step not in (8, 9):
            progress.advance(batch.num_rays)
        if step in (4, 12):
            progress.restart()
        if step in (6, 15):
            progress.batch_rays = 25 if step == 6 else 50
        if step == 17:
            progress.rays_seen = 100
    return seen


def test_batches_made_ahead_are_those_that_the_progress_asks_for():
    plain, ahead = wander(loader(masked_scene())), wander(loader(masked_scene(), ahead=True))
    assert all(equal(ours, theirs) for ours, theirs in zip(ahead, plain, strict=True))
    assert {batch.num_rays for batch in plain} == {25, 50}


def test_the_next_batch_is_made_by_another_thread_while_the_step_runs():
    made = {}
    place, ready = [0, 0, 10], threading.Event()

    def make(*at):
        made[at] = threading.current_thread().name
        if at[1] == 10:
            ready.set()
        return at

    stream = made_ahead(make, lambda: tuple(place))
    assert next(stream) == (0, 0, 10)
    assert ready.wait(timeout=30)  # the step has not asked for it yet
    place[1] = 10
    assert next(stream) == (0, 10, 10)
    assert made[0, 0, 10] == threading.current_thread().name
    assert made[0, 10, 10].startswith("batches")
    stream.close()
    assert not any(thread.name.startswith("batches") for thread in threading.enumerate())


def test_what_goes_wrong_in_the_thread_is_raised_in_the_step():
    place = [0, 0, 10]

    def make(attempt, rays_seen, batch_rays):
        if rays_seen:
            raise OSError("the disk is gone")

    stream = made_ahead(make, lambda: tuple(place))
    next(stream)
    place[1] = 10
    with pytest.raises(OSError, match="the disk is gone"):
        next(stream)


@pytest.mark.parametrize("scene", [ball_scene(), masked_scene()])
def test_pixels_on_a_device_give_the_same_batches(scene, monkeypatch):
    monkeypatch.setattr(placement, "CHUNK_BYTES", 1000)  # several parts, the last one smaller
    there = on_device(scene, CPU)
    assert there.pixels.rgba.data_ptr() != scene.pixels.rgba.data_ptr()
    assert all(equal(a, b) for a, b in zip(wander(loader(there)), wander(loader(scene)), strict=True))


def test_everything_that_a_batch_needs_moves():
    """The meta device has shapes only, and refuses whatever was left behind."""
    there = on_device(masked_scene(), torch.device("meta"))
    tensors = [there.near, there.far, there.pixels.rgba, there.pixels.mask, there.pixels.offset, there.pixels.width]
    assert {tensor.device.type for tensor in [*tensors, there.cameras.c2w, there.cameras.lens]} == {"meta"}


def test_the_budget_decides(monkeypatch):
    assert budget_bytes(0.5, torch.device("cuda")) == 500_000_000
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (8_000, 80_000))
    assert budget_bytes("auto", torch.device("cuda")) == 4_000
    assert budget_bytes("auto", torch.device("xla", 0)) == 0

    scene = ball_scene()  # 6 views of 12 x 12 pixels: 3456 bytes
    data = RayDataModule(scene, Progress(), seed=0)
    assert data.fits(torch.device("cuda"))
    assert not data.fits(CPU)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (6_000, 80_000))
    assert not data.fits(torch.device("cuda"))
    with pytest.raises(InputError, match="device_budget=-1"):
        RayDataModule(scene, Progress(), seed=0, device_budget=-1)


@pytest.mark.parametrize(
    ("prefetch", "kind", "available", "threads", "expected"),
    [
        ("auto", "cpu", 10**9, 1, None),
        ("auto", "cpu", 10**9, 2, "cpu"),
        ("auto", "cpu", 1000, 1, "cpu"),
        ("auto", "cuda", 10**9, 1, "cuda"),
        (False, "cuda", 1000, 2, None),
        (True, "cpu", 10**9, 1, "cpu"),
    ],
)
def test_batches_are_made_ahead_where_it_helps(monkeypatch, prefetch, kind, available, threads, expected):
    data = RayDataModule(ball_scene(), Progress(), seed=0, device_budget=0, prefetch=prefetch)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: type("Memory", (), {"available": available}))
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    data.settle(torch.device(kind))
    assert data.batches.prefetch_for == (None if expected is None else torch.device(expected))
    assert data.batches.scene is data.scene


def test_pixels_that_fit_move_once(monkeypatch):
    moves = []
    scene = ball_scene()
    data = RayDataModule(scene, Progress(), seed=0, device_budget=1)
    monkeypatch.setattr(datamodule, "on_device", lambda *arguments: moves.append(arguments) or on_device(scene, CPU))
    for _ in range(2):
        data.settle(torch.device("cuda"))
    assert len(moves) == 1
    assert data.batches.prefetch_for is None
    assert data.batches.scene is not scene
    assert equal(data.batches.batch_at(0, 0), RayDataModule(scene, Progress(), seed=0).batches.batch_at(0, 0))


def test_a_mapped_store_is_sent_by_name(tmp_path):
    def make(path):
        path.write_bytes(bytes(range(20)) * 8)
        return Header(1, [[4, 8]], has_transparency=True, masked=True, contents=None, spots=0, checksum=0)

    store = stored(tmp_path / "store", None, make)
    message = pickle.dumps(store)
    assert len(message) < 1000
    again = pickle.loads(message)
    assert torch.equal(again.rgba, store.rgba)
    assert torch.equal(again.mask, store.mask)
    assert torch.equal(again.height, store.height)
    assert again.rgba.data_ptr() != store.rgba.data_ptr()
