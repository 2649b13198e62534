"""Access to the page: only its own browser tabs and holders of the token, and no other site."""

import socket
import sys

import pytest
import viser
from support.served_page import served
from support.viser_client import ViserClient
from websockets.asyncio import server as websockets_server
from websockets.exceptions import InvalidStatus

from nerf_lightning.messages.errors import InputError


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    with served(tmp_path_factory.mktemp("page"), hosts=["castle.example", "gate.example:443"]) as page:
        yield page


def refused(call) -> str:
    """Expect 403, and return the message."""
    with pytest.raises(InvalidStatus) as caught:
        call()
    response = caught.value.response
    assert response.status_code == 403
    return response.body.decode()


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://localhost:1", "http://127.0.0.1", "https://evil.example:443", "x"]
)
def test_a_page_of_another_site_gets_no_session(page, origin):
    assert "another site" in refused(lambda: page.client(origin=origin))
    assert page.get(f"/?token={page.token}", Origin=origin)[0] == 403


@pytest.mark.parametrize("host", ["127.0.0.1:9000", "localhost", "[::1]:81", "castle.example", "gate.example:1"])
def test_the_pages_own_origins_get_one_at_any_port(page, host):
    """A tunnel ends at another port of this machine."""
    client = page.as_host(host, origin=f"http://{host}")
    client.look_from(20)
    client.wait_for(len)
    client.close()


def test_a_proxy_that_hides_the_name_is_let_in_by_its_own(page):
    page.client(origin="https://gate.example").close()


def test_another_host_is_refused_although_it_has_the_token(page):
    """DNS rebinding: an attacker's name that resolves to this machine."""
    assert "viewer.hosts=[evil.example]" in refused(lambda: page.as_host(f"evil.example:{page.port}"))
    assert page.get(f"/?token={page.token}", Host=f"evil.example:{page.port}")[0] == 403
    assert page.get(f"/?token={page.token}", Host="127.0.0.1, evil.example")[0] == 403


REQUESTS = [
    ("/", ["Host: localhost", "Host: localhost"], 400),
    ("/", [], 400),
    ("/", ["Host: localhost", "Accept-Encoding: gzip", "Accept-Encoding: br"], 400),
    ("/" + "a" * 7000, ["Host: localhost"], 414),
    ("/" + "a" * 300, ["Host: localhost"], 400 if sys.version_info < (3, 14) else 404),  # no file has such a name
    ("/%00", ["Host: localhost"], 404),
]


@pytest.mark.parametrize(("path", "headers", "status"), REQUESTS)
def test_requests_that_are_none_are_refused_and_not_taken_for_errors_of_the_page(page, path, headers, status):
    with socket.create_connection(("127.0.0.1", page.port), timeout=20) as line:
        lines = [f"GET {path}?token={page.token} HTTP/1.1", *headers, "Connection: close", "", ""]
        line.sendall("\r\n".join(lines).encode())
        assert line.makefile("rb").readline().split()[1] == str(status).encode()


@pytest.mark.parametrize("query", ["", "?token=", "?token=none", "?token=%ff", "?else=1"])
def test_who_has_no_token_is_told_where_it_is(page, query):
    status, headers, text = page.get(f"/{query}")
    assert (status, "Set-Cookie" in headers) == (403, False)
    assert "open the whole address that nerf printed, with ?token=" in text
    address = f"http://127.0.0.1:{page.port}/{query}"
    cookie = {"Cookie": f"nerf_lightning_{page.port}=none"}
    assert "that nerf printed" in refused(lambda: ViserClient(address, additional_headers=cookie))


def test_the_page_keeps_the_token_in_a_cookie_that_no_script_reads(page):
    status, headers, text = page.get(f"/?token={page.token}")
    assert status == 200
    assert 'id="root"' in text
    name, *attributes = headers["Set-Cookie"].split("; ")
    assert name == f"nerf_lightning_{page.port}={page.token}"
    assert set(attributes) == {"HttpOnly", "SameSite=Strict", "Path=/"}
    assert page.get("/", Cookie=f"other=1; {name}")[0] == 200
    ViserClient(f"http://127.0.0.1:{page.port}", additional_headers={"Cookie": name}).close()


def test_each_start_has_a_token_of_its_own(page, tmp_path):
    assert len(page.token) >= 32
    with served(tmp_path) as other:
        assert other.token != page.token


@pytest.mark.parametrize("name", ["http://castle", "castle example", "*", "a:b", ""])
def test_a_host_that_is_none_is_named(tmp_path, name):
    with pytest.raises(InputError, match="give names such as castle"), served(tmp_path, hosts=[name]):
        pass


def test_the_page_loads_nothing_from_elsewhere_and_goes_into_no_frame(page):
    _, headers, _ = page.get(f"/?token={page.token}")
    policy = dict(part.strip().split(" ", 1) for part in headers["Content-Security-Policy"].split(";"))
    assert policy["default-src"] == policy["frame-ancestors"] == "'none'"
    assert policy["connect-src"].startswith("'self'")
    assert "http" not in headers["Content-Security-Policy"]
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert headers["Referrer-Policy"] == "no-referrer"


def test_a_viser_that_serves_in_another_way_is_refused(tmp_path, monkeypatch):
    """Its guard is never asked to serve."""
    plain, start = websockets_server.serve, viser.ViserServer

    def otherwise(*arguments, **options):
        websockets_server.serve = plain
        return start(*arguments, **options)

    monkeypatch.setattr(viser, "ViserServer", otherwise)
    with pytest.raises(InputError, match="cannot be guarded"), served(tmp_path):
        pass
