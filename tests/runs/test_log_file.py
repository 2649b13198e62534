"""train.log: every start adds to it, and a disk without room for it stops nothing."""

import logging

from support.running import start_code

from nerf_lightning.runs.log_file import log_file


def test_every_start_adds_its_lines(tmp_path):
    for word in ("first", "second\x1b[2J\nERROR"):
        with log_file(tmp_path):
            logging.getLogger("a.b").warning("the %s start", word)
    logging.getLogger("a.b").warning("after it")
    first, second = (tmp_path / "train.log").read_text(encoding="utf-8").splitlines()
    assert first.endswith(" WARNING a.b: the first start")
    assert second.endswith(r" WARNING a.b: the second\x1b[2J\nERROR start")


FULL = """
import logging, pathlib, resource, signal, sys
from nerf_lightning.runs.log_file import log_file
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (60, 60))
with log_file(pathlib.Path(sys.argv[1])):
    for number in range(5):
        logging.warning("line %d", number)
print("went on")
"""


def test_a_full_disk_costs_lines_alone(tmp_path):
    process = start_code(FULL, str(tmp_path))
    output, errors = process.communicate(timeout=300)
    assert (process.returncode, output, errors) == (0, "went on\n", "")
    assert (tmp_path / "train.log").stat().st_size == 60
