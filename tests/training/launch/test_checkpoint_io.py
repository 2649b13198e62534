"""Training waits for a copy only; what the writer could not write is never lost."""

import threading

import pytest
import torch

from nerf_lightning.messages.errors import InputError
from nerf_lightning.training.launch import checkpoint_io
from nerf_lightning.training.launch.checkpoint_io import AtomicCheckpointIO


@pytest.fixture
def gate(monkeypatch):
    """Holds the writer back until it is opened."""
    opened, real = threading.Event(), checkpoint_io.write_checkpoint

    def write(checkpoint, target):
        opened.wait(timeout=30)
        real(checkpoint, target)

    monkeypatch.setattr(checkpoint_io, "write_checkpoint", write)
    yield opened
    opened.set()


def fail(checkpoint, target):
    raise InputError(f"no space for {target.name}")


def test_what_is_saved_is_the_state_at_the_call(tmp_path, gate):
    writer = AtomicCheckpointIO()
    weights, curve = torch.zeros(4), [1.0]
    whole = torch.arange(8.0)
    content = {"weights": weights, "nested": [{"view": whole[2:4]}], "curve": curve, "step": 1}
    writer.save_checkpoint(content, tmp_path / "last.ckpt")
    weights.add_(1)
    whole.mul_(-1)
    curve.append(2.0)
    assert not (tmp_path / "last.ckpt").exists()
    gate.set()
    writer.wait()
    saved = torch.load(tmp_path / "last.ckpt", weights_only=True)
    assert saved["weights"].tolist() == [0.0] * 4
    assert saved["nested"][0]["view"].tolist() == [2.0, 3.0]
    assert saved["curve"] == [1.0]
    writer.teardown()


@pytest.mark.parametrize("ask", [AtomicCheckpointIO.wait, AtomicCheckpointIO.raise_failure])
def test_a_failure_is_raised_once_somebody_asks(tmp_path, monkeypatch, ask):
    monkeypatch.setattr(checkpoint_io, "write_checkpoint", fail)
    writer = AtomicCheckpointIO()
    writer.save_checkpoint({}, tmp_path / "last.ckpt")
    writer.writer.shutdown()
    with pytest.raises(InputError, match=r"no space for last\.ckpt"):
        ask(writer)
    ask(writer)


def test_a_failure_is_raised_at_the_next_save_or_told_at_the_very_end(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(checkpoint_io, "write_checkpoint", fail)
    writer = AtomicCheckpointIO()
    writer.save_checkpoint({}, tmp_path / "last.ckpt")
    writer.writes[0].exception()
    with pytest.raises(InputError, match=r"no space for last\.ckpt"):
        writer.save_checkpoint({}, tmp_path / "best.ckpt")
    writer.teardown()
    writer = AtomicCheckpointIO()
    writer.save_checkpoint({}, tmp_path / "last.ckpt")
    writer.teardown()
    assert "no space for last.ckpt" in caplog.text
    writer.teardown()


def test_the_writer_is_waited_for_and_can_be_used_again(tmp_path):
    writer = AtomicCheckpointIO()
    for step in (1, 2):
        writer.save_checkpoint({"step": step}, tmp_path / "last.ckpt")
        writer.teardown()
        assert torch.load(tmp_path / "last.ckpt", weights_only=True)["step"] == step
        assert not [thread for thread in threading.enumerate() if thread.name.startswith("checkpoint")]
