"""Which scripts of viser's page are run, and what is done with a page that is not known."""

import threading
from contextlib import nullcontext

import pytest

pytest.importorskip("viser", reason="viser is not installed: pip install 'nerf-lightning[viewer]'")

from support.served_page import served

from nerf_lightning.messages.errors import InputError
from nerf_lightning.viewer import guarded_server
from nerf_lightning.viewer.page_headers import marked


def test_each_script_of_the_page_carries_the_nonce_and_each_answer_has_another():
    page = b"<html><script data-s='x'>e.type=\"module\";e.src=1</script></html>"
    shown, policy = marked(page)
    nonce = policy.removeprefix("'nonce-").removesuffix("'")
    assert shown.count(f"'{nonce}'".encode()) == 2
    assert marked(page)[1] != policy


def test_an_unknown_page_is_shown_and_it_is_said_what_is_missing(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(guarded_server, "marked", lambda page: None)
    with served(tmp_path) as page:
        for _ in range(2):
            status, headers, _ = page.get(f"/?token={page.token}")
        assert status == 200
        assert "'unsafe-inline'" in headers["Content-Security-Policy"].partition("script-src")[2].partition(";")[0]
    assert caplog.text.count("the page of this version of viser is not known here") == 1


def test_a_viser_that_serves_in_another_way_is_refused(tmp_path, monkeypatch):
    """Its guard is never asked to serve."""
    monkeypatch.setattr(guarded_server.Guard, "in_place", lambda guard: nullcontext())
    before = threading.active_count()
    with pytest.raises(InputError, match="cannot be guarded"), served(tmp_path):
        pass
    assert threading.active_count() == before
