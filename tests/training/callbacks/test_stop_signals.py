"""What asks a run to save and stop: signals, and the file of a sweep where there are none."""

import signal
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
from lightning.pytorch import Trainer
from lightning.pytorch.demos.boring_classes import BoringModel

from nerf_lightning.training.callbacks.stop_signals import StopSignals
from nerf_lightning.training.launch.preemption import stop_signals


def stopped(signals):
    """Return whether it stops after a step."""
    trainer = SimpleNamespace(should_stop=False)
    signals.on_train_batch_end(trainer, None, None, None, 0)
    return trainer.should_stop


def test_the_stop_file_of_a_sweep_stops_a_job_without_any_signal(tmp_path):
    signals = StopSignals()
    signals.stop_file = tmp_path / "stop"
    assert not stopped(signals)
    signals.stop_file.touch()
    assert stopped(signals)
    assert signals.received == signal.SIGTERM


def test_the_first_ctrl_c_after_the_stop_file_lets_the_job_save(tmp_path, monkeypatch):
    """A terminal sends it to the sweep and to its jobs; whichever comes first."""
    ended = []
    monkeypatch.setattr("os._exit", ended.append)
    signals = StopSignals()
    signals.stop_file = tmp_path / "stop"
    signals.stop_file.touch()
    assert stopped(signals)
    signals._handle(signal.SIGINT, None)
    assert not ended
    signals._handle(signal.SIGINT, None)
    assert ended == [130]


class ToldToStopAsItStarts(BoringModel):
    def zero_grad(self, set_to_none=True):
        """Be asked to stop when Lightning listens, and no step was taken."""
        signal.raise_signal(signal.SIGTERM)


@pytest.mark.parametrize(("model", "code", "steps"), [(BoringModel, None, 2), (ToldToStopAsItStarts, 143, 0)])
def test_a_signal_before_the_first_step_ends_it_at_once_and_afterwards_each_does_what_it_did_before(
    tmp_path, model, code, steps
):
    before = {number: signal.getsignal(number) for number in stop_signals()}
    trainer = Trainer(
        default_root_dir=tmp_path, max_steps=2, accelerator="cpu", logger=False, callbacks=[StopSignals()],
        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False, limit_val_batches=0,
    )  # fmt: skip
    with pytest.raises(SystemExit) if code else nullcontext() as left:
        trainer.fit(model())
    assert (left and left.value.code, trainer.global_step) == (code, steps)
    assert {number: signal.getsignal(number) for number in stop_signals()} == before
