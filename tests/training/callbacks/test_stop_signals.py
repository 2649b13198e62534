"""The handlers of signals are given back as they were before the training."""

import signal

import torch
from lightning.pytorch import LightningModule, Trainer

from nerf_lightning.training.callbacks.stop_signals import StopSignals
from nerf_lightning.training.launch.preemption import stop_signals


class Line(LightningModule):
    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(1, 1)

    def training_step(self, batch, index):
        return self.layer(batch).sum()

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


class Batches:
    def __len__(self):
        return 3

    def __iter__(self):
        return iter([torch.ones(1)] * 3)


def test_after_a_training_every_signal_does_what_it_did_before(tmp_path):
    before = {number: signal.getsignal(number) for number in stop_signals()}
    trainer = Trainer(
        default_root_dir=tmp_path, max_steps=2, accelerator="cpu", logger=False, callbacks=[StopSignals()],
        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(Line(), Batches())
    assert trainer.global_step == 2
    assert {number: signal.getsignal(number) for number in stop_signals()} == before
