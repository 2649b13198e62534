"""What a person adds to a run on the command line: flags of Lightning's, and callbacks of their own."""

import pytest
from support.running import done, said

MINE = '''
from pathlib import Path

from lightning.pytorch.callbacks import Callback


class Counter(Callback):
    """Count steps into a file."""

    def __init__(self, path, start=0):
        self.path, self.steps = Path(path), start

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        self.steps += 1
        assert outputs["step"].losses.shape == (2,)

    def on_train_end(self, trainer, pl_module):
        self.path.write_text(str(self.steps))

    def state_dict(self):
        return {"steps": self.steps}

    def load_state_dict(self, state_dict):
        self.steps = state_dict["steps"]


class NoCallback:
    pass
'''
QUICK = ("final.evaluate=false", "final.video=false", "callbacks.validation_pictures.every_steps=1000")


@pytest.fixture
def train(train):
    return lambda *arguments: train(*QUICK, *arguments)


@pytest.fixture
def my_package(tmp_path, monkeypatch):
    (tmp_path / "my_package.py").write_text(MINE)
    monkeypatch.syspath_prepend(tmp_path)


def test_a_callback_of_ones_own_is_named_on_the_command_line_and_goes_on(train, my_package, tmp_path, monkeypatch):
    mine = ("+callbacks.mine._target_=my_package.Counter", f"+callbacks.mine.path={tmp_path}/count")
    done(train(*mine, "+callbacks.mine.start=100"))
    assert (tmp_path / "count").read_text() == "104"
    monkeypatch.syspath_prepend(tmp_path)
    done(train(*mine, "trainer.max_steps=6", "resume=auto"))
    assert (tmp_path / "count").read_text() == "106"


def test_a_class_that_is_no_callback_or_not_there_is_told(train, my_package, tmp_path, monkeypatch):
    said(train("+callbacks.mine._target_=my_package.NoCallback"), "callbacks.mine", "is not a callback")
    monkeypatch.syspath_prepend(tmp_path)
    said(train("+callbacks.mine._target_=my_package.Missing"), "callbacks.mine", "Missing")
    assert not (tmp_path / "run").exists()
