"""What asks a run to save and stop: signals, and the file of a sweep where there are none."""

import signal
from types import SimpleNamespace

from nerf_lightning.training.callbacks.stop_signals import StopSignals


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
