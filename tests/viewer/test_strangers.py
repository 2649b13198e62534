"""Who may speak to the page: its own browser tabs and whoever has the token; nobody else, and no other site."""

import pytest
from support.served_page import served
from websockets.exceptions import InvalidStatus

from nerf_lightning.messages.errors import InputError


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    with served(tmp_path_factory.mktemp("page")) as page:
        yield page


def refused(call) -> str:
    """Expect 403, and return what is said."""
    with pytest.raises(InvalidStatus) as caught:
        call()
    response = caught.value.response
    assert response.status_code == 403
    return response.body.decode()


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "null",
        "http://localhost:1",
        "http://127.0.0.1",
        "https://evil.example:443",
        "http://[",
        "",
    ],
)
def test_a_page_of_another_site_gets_no_session(page, origin):
    assert "another site" in refused(lambda: page.client(origin=origin))
    assert page.get(f"/?token={page.token}", Origin=origin)[0] == 403


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost", "[::1]"])
def test_the_pages_own_origins_get_one(page, name):
    client = page.client(origin=f"http://{name}:{page.port}")
    client.look_from(20)
    client.wait_for(len)
    client.close()


def test_another_host_is_refused_although_it_has_the_token(page):
    """DNS rebinding: a stranger's name that means this machine."""
    said = refused(lambda: page.as_host(f"evil.example:{page.port}"))
    assert "viewer.hosts=[evil.example]" in said
    assert page.get(f"/?token={page.token}", Host=f"evil.example:{page.port}")[0] == 403
    assert page.get(f"/?token={page.token}", Host="127.0.0.1:1")[0] == 403


@pytest.mark.parametrize("query", ["", "?token=", "?token=none", "?token=%ff", "?else=1"])
def test_who_has_no_token_is_told_where_it_is(page, query):
    status, headers, text = page.get(f"/{query}")
    assert status == 403
    assert "Set-Cookie" not in headers
    assert text.count(".") <= 2
    assert "the address with ?token= that nerf printed when it started" in text


@pytest.mark.parametrize("token", ["", "none"])
def test_a_program_without_the_token_gets_no_session(page, token):
    from support.viser_client import ViserClient

    address = f"http://127.0.0.1:{page.port}/?token={token}"
    assert "that nerf printed" in refused(lambda: ViserClient(address))
    cookie = {"Cookie": f"nerf_lightning_{page.port}={token}"}
    assert "that nerf printed" in refused(lambda: ViserClient(address, additional_headers=cookie))


def test_the_page_keeps_the_token_in_a_cookie_that_no_script_reads(page):
    from support.viser_client import ViserClient

    status, headers, text = page.get(f"/?token={page.token}")
    assert status == 200
    assert 'id="root"' in text
    name, *attributes = headers["Set-Cookie"].split("; ")
    assert name == f"nerf_lightning_{page.port}={page.token}"
    assert set(attributes) == {"HttpOnly", "SameSite=Strict", "Path=/"}
    assert page.get("/", Cookie=name)[0] == 200
    origin = f"http://127.0.0.1:{page.port}"
    client = ViserClient(origin, origin=origin, additional_headers={"Cookie": f"other=1; {name}"})
    client.look_from(20)
    client.wait_for(len)
    client.close()


def test_each_start_has_a_token_of_its_own(page, tmp_path):
    assert len(page.token) >= 32
    with served(tmp_path) as other:
        assert other.token != page.token


def test_hosts_that_are_named_are_served(tmp_path):
    with served(tmp_path, hosts=["castle.example", "gate.example:443"]) as page:
        page.as_host(f"castle.example:{page.port}", origin=f"http://castle.example:{page.port}").close()
        page.client(origin="https://gate.example").close()
        refused(lambda: page.as_host("castle.example:1"))
        refused(lambda: page.client(origin="http://castle.example"))


@pytest.mark.parametrize("name", ["http://castle", "castle example", "*", "a:b", "a:99999", ""])
def test_a_host_that_is_none_is_named(tmp_path, name):
    with pytest.raises(InputError, match="give names of machines like castle"), served(tmp_path, hosts=[name]):
        pass


def test_the_page_loads_nothing_from_elsewhere_and_goes_into_no_frame(page):
    _, headers, _ = page.get(f"/?token={page.token}")
    policy = dict(part.strip().split(" ", 1) for part in headers["Content-Security-Policy"].split(";"))
    assert policy["default-src"] == policy["frame-ancestors"] == policy["object-src"] == "'none'"
    assert "unsafe-inline" not in policy["script-src"]
    assert "unsafe-eval" not in policy["script-src"].replace("wasm-unsafe-eval", "")
    assert policy["connect-src"].startswith("'self'")
    assert "https:" not in headers["Content-Security-Policy"]
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert headers["Referrer-Policy"] == "no-referrer"
    assert page.get(f"/?token={page.token}")[1]["Content-Security-Policy"] != headers["Content-Security-Policy"]
