"""The page during training: it shows the model, does not change it, and closes with the run."""

import math
import re
import socket
from types import SimpleNamespace
from unittest.mock import MagicMock
from urllib.parse import urlsplit

import pytest
import torch
from lightning.pytorch import Trainer
from support.ports import unused_port
from support.running import FAST, start
from support.viser_client import ViserClient

from nerf_lightning.extensions.viewer import live_view, training_switch
from nerf_lightning.extensions.viewer.camera_state import CameraState
from nerf_lightning.extensions.viewer.live_view import LiveView
from nerf_lightning.extensions.viewer.page import Page
from nerf_lightning.extensions.viewer.progressive import ProgressiveRendering
from nerf_lightning.extensions.viewer.render_queue import RenderQueue
from nerf_lightning.extensions.viewer.renderer import SlicedRenderer
from nerf_lightning.extensions.viewer.training_switch import TrainingSwitch
from nerf_lightning.messages.errors import InputError
from nerf_lightning.training.callbacks.stop_signals import StopSignals
from nerf_lightning.training.callbacks.time_budget import TimeBudget


def run(capture, folder, *arguments):
    return start(
        "train", "scene=npz", f"scene.path={capture}", *FAST, "final.video=false", "final.evaluate=false",
        "logger=none", "trainer.num_threads=1", f"paths.output_dir={folder}", *arguments,
    )  # fmt: skip


def address_in(process):
    for line in process.stdout:
        found = re.search(r"Watch the training at (http://\S+)", line)
        if found:
            return found[1]
    raise AssertionError("it never said where the page is")


@pytest.mark.minutes
def test_a_watched_training_ends_with_the_same_weights_and_closes_its_page(capture, tmp_path):
    steps = "trainer.max_steps=160"  # Long enough for two users who come and go.
    alone = run(capture, tmp_path / "alone", steps)
    page = ("viewer=on", f"viewer.live_view.port={unused_port()}", "viewer.live_view.max_height=48")
    watched = run(capture, tmp_path / "watched", steps, *page)
    address = address_in(watched)
    client, lazy = ViserClient(address, 64, 48), ViserClient(address, 64, 48, reads=False)
    client.look_from(0)
    lazy.look_from(0)
    client.wait_for(len)
    client.close()
    again = ViserClient(address, 64, 48)
    again.look_from(90)
    again.wait_for(len)
    hostile = ViserClient(address, 64, 48)
    for changed in ({"fov": 0.0}, {"fov": math.inf}, {"image_width": 4e8}, {"image_width": 10**9, "image_height": 10}):
        hostile.look_from(0, **changed)
    for process in (alone, watched):
        output, _ = process.communicate(timeout=300)
        assert process.returncode == 0, output
        assert "Traceback" not in output
    weights = [
        torch.load(tmp_path / name / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]
        for name in ("alone", "watched")
    ]
    assert all(torch.equal(weights[0][key], weights[1][key]) for key in weights[0])
    with socket.socket() as freed:
        freed.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        freed.bind(("127.0.0.1", urlsplit(address).port))
    assert "token" not in (tmp_path / "watched" / "train.log").read_text()


@pytest.fixture
def trainer():
    return Trainer(accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False)


class ClockedQueue(RenderQueue):
    """A clock in place of pictures: each slice takes a given time."""

    def __init__(self, clock, seconds):
        self.clock, self.seconds, self.slices = clock, seconds, 0
        self._refinements = {0: ProgressiveRendering(lambda *_: None)}

    def work(self):
        self.clock.now += self.seconds
        self.slices += 1
        return True

    def refresh(self):
        pass


class Clock:
    now = 0.0

    def perf_counter(self):
        return self.now


class FakeSystem:
    train_step = SimpleNamespace(num_steps=1)

    def eval(self):
        pass

    def train(self):
        pass


@pytest.mark.parametrize("slice_seconds", [0.01, 0.2, 2.0])
def test_pictures_take_no_more_than_their_share_of_the_time(monkeypatch, trainer, slice_seconds):
    clock = Clock()
    monkeypatch.setattr(live_view, "time", clock)
    callback = LiveView(share=0.2)
    queue = ClockedQueue(clock, slice_seconds)
    monkeypatch.setattr(callback, "page", SimpleNamespace(queue=queue))
    spent = 0.0
    for _ in range(2000):
        clock.now += 0.05  # a step
        before = clock.now
        callback.on_train_batch_end(trainer, FakeSystem(), None, None, 0)
        spent += clock.now - before
    assert spent / clock.now < 0.2 + 2 * slice_seconds / clock.now
    assert spent / clock.now > 0.1


def test_nobody_looking_on_costs_nothing(trainer):
    callback = LiveView()
    queue = ClockedQueue(Clock(), 1.0)
    queue._refinements.clear()
    callback.page = SimpleNamespace(queue=queue)
    for _ in range(10):
        callback.on_train_batch_end(trainer, FakeSystem(), None, None, 0)
    assert queue.slices == 0


def test_settings_of_the_page_that_cannot_be_are_refused_at_once():
    for share in (0.0, 1.0, -1.0):
        with pytest.raises(InputError, match="give a share of the time between 0 and 1"):
            LiveView(share=share)
    for port in (0, 65_536):
        with pytest.raises(InputError, match=f"port={port}: give a number"):
            LiveView(port=port)
    with pytest.raises(InputError, match="not the name of a machine"):
        LiveView(hosts=["a b"])


def test_what_cannot_be_drawn_ends_no_training(trainer, caplog):
    renderer = MagicMock(spec=SlicedRenderer)
    renderer.slices.side_effect = ZeroDivisionError("float division by zero")
    renderer.height_while_moving.return_value = 16
    queue, refinement = RenderQueue(renderer), ProgressiveRendering(lambda *_: None)
    queue.add(1, refinement)
    callback = LiveView(share=0.9)
    callback.page = SimpleNamespace(queue=queue)
    for _ in range(5):
        refinement.ask(CameraState(torch.eye(4)[:3], 0.0, 16, 16))
        callback.on_train_batch_end(trainer, FakeSystem(), None, None, 0)
    assert renderer.slices.call_count > 1
    assert caplog.text.count("could not be rendered: ZeroDivisionError") == 1


class Watched:
    """A callback whose page has as many users as `seats`."""

    def __init__(self, trainer, monkeypatch):
        renderer = MagicMock(spec=SlicedRenderer)
        renderer.share = 0.15
        self.page = MagicMock(spec=Page, queue=RenderQueue(renderer), is_empty=False)
        self.callback, self.trainer, self.turns = LiveView(), trainer, 0
        self.callback.page = self.page
        self.at_turn = {}
        """Events by turn of the pause."""
        monkeypatch.setattr(self.page.queue, "work", self.work)

    def work(self):
        self.turns += 1
        assert self.turns < 2000, "it waits for ever"
        self.at_turn.get(self.turns, lambda: None)()
        return True

    def step(self):
        self.callback.on_train_batch_end(self.trainer, FakeSystem(), None, None, 0)


@pytest.fixture
def watched(trainer, monkeypatch):
    return Watched(trainer, monkeypatch)


def test_a_paused_training_waits_until_somebody_lets_it_go_on(watched, caplog):
    caplog.set_level("INFO")
    watched.callback.switch.pause()
    watched.at_turn[5] = watched.callback.switch.go_on
    watched.step()
    assert watched.turns == 5
    assert "training is paused at step 0" in caplog.text
    assert "training continues" in caplog.text
    watched.step()
    assert watched.trainer.should_stop is False


def test_a_pause_costs_no_budget_and_no_speed(watched, monkeypatch):
    budget = TimeBudget(seconds=100.0)
    budget.since = 0.0
    watched.trainer.callbacks.append(budget)
    now = [0.0]
    monkeypatch.setattr(training_switch.time, "monotonic", lambda: now[0])
    watched.callback.switch.pause()

    def an_hour_later():
        now[0] = 3600.0
        watched.callback.switch.go_on()

    watched.at_turn[1] = an_hour_later
    watched.step()
    assert budget.since == 3600.0


def test_a_training_that_nobody_watches_any_more_goes_on(watched, monkeypatch):
    """A browser that is closed, or whose machine sleeps, must not pause a training forever."""
    now = [0.0]
    monkeypatch.setattr(training_switch.time, "monotonic", lambda: now[0])
    watched.callback.switch.pause()

    def leave():
        watched.page.is_empty = True

    def pass_time():
        now[0] += training_switch.AWAY_SECONDS / 2

    watched.at_turn |= {3: leave, 4: pass_time, 6: pass_time, 8: pass_time}
    watched.step()
    assert watched.turns == 8


def test_ctrl_c_ends_a_pause(watched):
    signals = StopSignals()
    watched.trainer.callbacks.append(signals)
    watched.callback.switch.pause()
    watched.at_turn[2] = lambda: signals._handle(2, None)
    watched.step()
    assert watched.turns == 2


def test_a_stop_ends_the_training_and_a_pause_and_several_processes_are_not_paused(watched):
    watched.callback.switch.pause()
    watched.at_turn[2] = watched.callback.switch.stop
    watched.step()
    watched.step()
    assert watched.trainer.should_stop is True
    switch = TrainingSwitch(can_pause=False)
    switch.pause()
    assert not switch.wants_pause


@pytest.mark.slow
def test_a_training_stopped_in_the_page_is_saved_and_evaluated(capture, tmp_path):
    page = ("viewer=on", f"viewer.live_view.port={unused_port()}", "viewer.live_view.max_height=32")
    watched = run(capture, tmp_path / "run", *page, "trainer.max_steps=1000000", "final.evaluate=true")
    client = ViserClient(address_in(watched), 32, 24)
    client.look_from(0)
    client.set("Pause", True)
    client.wait_until(lambda: any("Paused at" in str(each) for each in client.said))
    client.set("Stop training", True)
    client.set("Stop training", True)
    output, _ = watched.communicate(timeout=120)
    assert watched.returncode == 0, output
    assert "training was stopped from the page at step" in output
    assert "Traceback" not in output
    assert (tmp_path / "run" / "metrics.json").is_file()
    content = torch.load(tmp_path / "run" / "checkpoints" / "last.ckpt", weights_only=True)
    assert f"at step {content['global_step']}" in output
