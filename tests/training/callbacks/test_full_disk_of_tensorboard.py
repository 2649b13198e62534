"""A disk that is full while TensorBoard writes: its thread says nothing, and the run ends with one paragraph."""

import pytest
from support.captures import write_npz
from support.running import FAST, start_code

# Fails from the given write, or the given flush, on, as a full disk does.
RUN = """
import errno, os, sys
from nerf_lightning.cli import main as cli
from tensorboard.summary.writer import record_writer

what, first = sys.argv[1], int(sys.argv[2])
real, calls = getattr(record_writer.RecordWriter, what), []

def full(self, *arguments):
    calls.append(1)
    if len(calls) >= first:
        raise OSError(errno.ENOSPC, "No space left on device")
    return real(self, *arguments)

setattr(record_writer.RecordWriter, what, full)
sys.argv = ["nerf", *sys.argv[3:]]
cli.main()
"""


@pytest.mark.parametrize(("what", "first"), [("write", 12), ("flush", 2)])
def test_is_one_paragraph(tmp_path, what, first):
    capture = write_npz(tmp_path / "small.npz")
    short = ("callbacks.monitor.every_steps=1", "trainer.max_steps=10", "final.evaluate=false", "final.video=false")
    arguments = ("train", "scene=npz", f"scene.path={capture}", *FAST, *short, f"paths.output_dir={tmp_path}/run")
    process = start_code(RUN, what, str(first), *arguments)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 2, errors
    assert "Traceback" not in errors
    assert "Exception in thread" not in errors
    (paragraph,) = [line for line in errors.splitlines() if line.startswith("nerf: ")]
    assert "No space left on device. Check that the folder exists, is writable, and has free space." in paragraph
    assert errors.splitlines()[-1] == paragraph
