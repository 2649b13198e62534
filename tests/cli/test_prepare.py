"""What is done without a scene that the checkpoint names and conf/ does not know."""

import pytest

from nerf_lightning.cli import prepare
from nerf_lightning.config.scene_overrides import UnknownScene


@pytest.fixture(autouse=True)
def _unknown(monkeypatch):
    def unknown(arguments):
        raise UnknownScene("nobody knows it")

    monkeypatch.setattr(prepare, "_eval", unknown)


def test_a_page_goes_without_photographs_and_says_so(caplog):
    typed = ["ckpt=a", "what=page"]
    assert prepare._export(typed) == ["photographs=false", *typed]
    assert caplog.messages == ["what=page goes without photographs: nobody knows it"]


def test_the_scene_is_named_only_for_exporters_that_need_photographs():
    assert prepare._export(["ckpt=a", "what=volume"]) == ["ckpt=a", "what=volume"]
    assert prepare._export(["ckpt=a"]) == ["ckpt=a"]
    assert prepare._export(["ckpt=a", "what=my_own"])[0] == "photographs=false"


@pytest.mark.parametrize(("wish", "said"), [([], 1), (["photographs=false"], 0)])
def test_so_does_the_viewer_and_says_so_unless_they_were_not_wished_for(caplog, wish, said):
    assert prepare._view(["ckpt=a", *wish]) == ["photographs=false", "ckpt=a", *wish]
    assert len(caplog.messages) == said


def test_photographs_that_were_wished_for_are_missed():
    with pytest.raises(UnknownScene):
        prepare._view(["ckpt=a", "photographs=True"])
