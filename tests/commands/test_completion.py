"""What the shells complete: asked in each shell itself, where it is installed."""

import os
import select
import shutil
import subprocess
import sys
import time

import pytest
from support.running import REPOSITORY, said
from support.systems import POSIX

from nerf_lightning.cli.main import OF_ITSELF, find_commands
from nerf_lightning.config.help.candidates import candidates

NAMES = [*find_commands(), *OF_ITSELF]
PATIENCE = 30.0


def completed(*words):
    return candidates(list(words), NAMES)


def test_commands_groups_options_keys_and_values():
    assert completed("tr") == ["train"]
    assert completed("train", "mod") == ["model.", "model="]
    assert completed("train", "model=nerf_") == ["model=nerf_occupancy", "model=nerf_small", "model=nerf_tiny"]
    assert completed("train", "trainer.max") == ["trainer.max_epochs=", "trainer.max_steps="]
    assert completed("train", "trainer.precision=b") == ["trainer.precision=bf16-mixed"]
    assert completed("train", "callbacks.nan") == ["callbacks.nan_guard."]
    assert completed("export", "what=i") == ["what=images"]
    assert completed("export", "optimizer") == []
    assert completed("help", "optimizer.l") == ["optimizer.lr"]
    assert completed("completion", "") == ["bash", "fish", "zsh"]
    assert "--multirun" in completed("train", "--m")
    assert completed("no_command", "x") == []
    assert completed() == sorted(NAMES)
    assert completed("train", "-m", "model=nerf,fast_d") == ["model=nerf,fast_dense"]
    assert completed("train", "scene=colmap", "scene.f") == ["scene.far=", "scene.frames="]
    assert "scene.file=" in completed("train", "scene=transforms", "scene.f")


def test_paths(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run" / "checkpoints").mkdir(parents=True)
    (tmp_path / "run" / ".hydra").mkdir()
    (tmp_path / "notes").write_text("")
    assert completed("eval", "ckpt=ru") == ["ckpt=run/"]
    assert completed("eval", "ckpt=run/") == ["ckpt=run/checkpoints/"]
    assert completed("train", "scene.root=no") == ["scene.root=notes"]
    assert completed("train", "trainer.val_every_steps=") == []


@pytest.fixture
def path(tmp_path):
    """A PATH on which `nerf` is this program."""
    program = tmp_path / "bin" / "nerf"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nPYTHONPATH="{REPOSITORY}" exec "{sys.executable}" -m nerf_lightning "$@"\n')
    program.chmod(0o755)
    return f"{program.parent}{os.pathsep}{os.environ['PATH']}"


def shell(name):
    return pytest.param(name, marks=pytest.mark.skipif(shutil.which(name) is None, reason=f"{name} is not installed"))


# As a person's terminal runs it, without that person's own settings.
INTERACTIVE = {"bash": ["bash", "--norc", "--noprofile", "-i"], "zsh": ["zsh", "-f", "-i"]}
LOAD = 'eval "$(nerf completion {0})"; echo RE"A"DY\n'


@pytest.mark.slow
@pytest.mark.parametrize("name", [shell("bash"), shell("zsh")])
@POSIX
def test_a_key_press_completes_what_was_typed(name, path, tmp_path):
    import pty  # not on Windows

    pid, terminal = pty.fork()
    if pid == 0:
        os.chdir(tmp_path)
        environment = {"PATH": path, "HOME": str(tmp_path), "TERM": "dumb", "PS1": "> "}
        os.execvpe(INTERACTIVE[name][0], INTERACTIVE[name], environment)
    try:
        os.write(terminal, LOAD.format(name).encode())
        read_until(terminal, "READY")
        os.write(terminal, b"nerf trai\tmodel=nerf_s\ttrainer.max_s\t7")
        assert "nerf train model=nerf_small trainer.max_steps=7" in read_until(terminal, "steps=7")
    finally:
        os.kill(pid, 9)
        os.waitpid(pid, 0)
        os.close(terminal)


def read_until(terminal, expected):
    """Return what a terminal shows, up to some words, without bells and what was drawn for a moment."""
    shown, end = b"", time.monotonic() + PATIENCE
    while expected not in (plain := shown.replace(b"\a", b"").replace(b" \b", b"").decode(errors="replace")):
        assert select.select([terminal], [], [], max(0.0, end - time.monotonic()))[0], plain
        shown += os.read(terminal, 4096)
    return plain


@pytest.mark.parametrize("name", [shell("fish")])
def test_fish_lists_what_was_begun(name, path, tmp_path):
    asked = 'nerf completion fish | source; complete -C "nerf train model=nerf_s"; complete -C "nerf rend"'
    environment = {"PATH": path, "HOME": str(tmp_path), "TERM": "dumb"}
    done = subprocess.run([name, "--no-config", "-c", asked], capture_output=True, text=True, env=environment)
    assert done.stdout.splitlines() == ["model=nerf_small", "render"], done.stderr


def test_a_script_of_no_shell_is_one_paragraph(nerf):
    said(nerf("completion", "bsh"), "There is no completion for 'bsh'.", "Did you mean bash?")
    said(nerf("completion"), "Completion of which shell?")
