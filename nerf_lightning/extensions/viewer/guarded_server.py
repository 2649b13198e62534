"""viser's server, which answers only requests that `Auth` admits, and forbids browsers to load other sites' content.

viser itself checks neither Origin nor Host, and has no token. It serves through `websockets.serve`, which supports
that, but viser passes no such arguments. So `serve` is replaced while viser starts.
"""

import gzip
import logging
import re
import secrets
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from functools import partial
from http import HTTPStatus
from io import StringIO
from typing import TYPE_CHECKING, Any

from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import for_html

if TYPE_CHECKING:
    from viser import ViserServer
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

LOCAL = ("127.0.0.1", "localhost", "[::1]")
# A machine's name or address, optionally with a port.
HOST = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9_-]+(?:\.[a-z0-9_-]+)*)(?::[0-9]{1,5})?")
LONGEST_PATH = 2000
VISERS_TITLE = b"<title>Viser</title>"
NO_TOKEN = "The access token is missing: open the whole address that nerf printed, with ?token=..."
# viser's page embeds its scripts and styles, unpacks itself with WebAssembly, and makes workers and pictures from
# blobs. Older browsers do not treat the page's own socket as 'self'.
POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; style-src 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src data:; connect-src 'self' ws://{host} wss://{host} data: blob:; "
    "worker-src blob: data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
# websockets logs a traceback for each broken handshake, which any program can send.
unheard = logging.getLogger("nerf_lightning.extensions.viewer.handshakes")
unheard.setLevel(logging.CRITICAL + 1)


class Auth:
    """Check requests: a page is only for holders of its token, under one of its names, and not from other sites.

    A site that a user visits can send requests to this machine through the user's browser, which truthfully reports
    their origin (Origin) and the name it believes to contact (Host). Other programs can lie, so they need the token; it
    is in the address at first, and then in a cookie that scripts cannot read.

    Ports are not compared with the page's own, so tunnels work.

    Args:
        host: the address to listen on: 127.0.0.1 for this machine only, 0.0.0.0 for everyone on the network.
        hosts: names by which browsers find the page, besides 127.0.0.1, localhost and [::1]; their ports do not count.

    Raises:
        InputError: one of the hosts is not a valid name.
    """

    def __init__(self, host: str, hosts: Sequence[str] | str | None = None):
        self.host, self.token = host, secrets.token_urlsafe(32)
        self._extra_hosts = set[str]()
        for each in [hosts] if isinstance(hosts, str | int) else hosts or ():
            match = HOST.fullmatch(str(each).lower())
            if match is None:
                raise InputError(
                    f"viewer.hosts: {each!r} is not the name of a machine: give names such as castle.example or "
                    "192.168.1.5."
                )
            self._extra_hosts.add(match[1])
        self._allowed_hosts = {*LOCAL, f"[{host}]" if ":" in host else host.lower(), *self._extra_hosts}

    def refusal(self, request: "Request") -> tuple[HTTPStatus, str] | None:
        """Return why a request is refused, in one sentence; None: it is admitted."""
        hosts, origins, cookies = map(request.headers.get_all, ("Host", "Origin", "Cookie"))
        if len(request.path) > LONGEST_PATH:
            return HTTPStatus.REQUEST_URI_TOO_LONG, "The page has no address as long as this one."
        if len(hosts) != 1:
            return HTTPStatus.BAD_REQUEST, "A request must have one Host header."
        host, source = hosts[0].lower(), ", ".join(origins).lower().partition("://")[2]
        name, from_name = (match[1] if (match := HOST.fullmatch(each)) else None for each in (host, source))
        if name not in self._allowed_hosts:
            hint = f": if it is yours, start nerf with viewer.hosts=[{name}]" if name else ""
            return HTTPStatus.FORBIDDEN, f"The page is not served under this name{hint}."
        if any(origins) and source != host and from_name not in self._extra_hosts:
            return HTTPStatus.FORBIDDEN, "This request comes from another site, which may not access this page."
        words = re.split("[?&;=]", ";".join([request.path, *cookies]))
        if any(secrets.compare_digest(word.encode(errors="surrogateescape"), self.token.encode()) for word in words):
            return None
        return HTTPStatus.FORBIDDEN, NO_TOKEN

    def cookie(self, port: int) -> str:
        """Return the cookie with the token; browsers share the cookies of one machine between all ports."""
        return f"nerf_lightning_{port}={self.token}; HttpOnly; SameSite=Strict; Path=/"


def guarded_server(auth: Auth, port: int, title: str = "nerf view") -> "ViserServer":
    """Start viser's server behind the guard, its page titled `title`; refuse a version that cannot be guarded."""
    from viser import ViserServer
    from websockets.asyncio import server as websockets_server

    serve, guarded = websockets_server.serve, []

    def guarded_serve(*where: Any, process_request: Callable[..., "Response | None"], **options: Any) -> Any:
        guarded.append(where)
        answer = partial(_answer, auth, process_request, title)
        return serve(*where, process_request=answer, logger=unheard, server_header=None, **options)

    websockets_server.serve = guarded_serve  # type: ignore[misc, assignment]
    try:
        with redirect_stdout(StringIO()):  # viser prints banners
            server = ViserServer(auth.host, port, verbose=False)
    finally:
        websockets_server.serve = serve  # type: ignore[misc]
    if not guarded:
        server.stop()
        raise InputError(
            "This version of viser serves its page in a way that cannot be guarded against strangers. Install one "
            "that can: pip install 'viser==1.1.1'."
        )
    return server


def _entitle(response: "Response", title: str) -> None:
    """Give viser's page a title, for which it has no setting."""
    packed = response.headers.get("Content-Encoding") == "gzip"
    body = response.body
    if not response.headers.get("Content-Type", "").startswith("text/html") or not body:
        return
    page = gzip.decompress(body) if packed else body
    page = page.replace(VISERS_TITLE, f"<title>{for_html(title)}</title>".encode(), 1)
    response.body = gzip.compress(page) if packed else page
    if "Content-Length" in response.headers:
        del response.headers["Content-Length"]
        response.headers["Content-Length"] = str(len(response.body))


def _answer(
    auth: Auth,
    viser: Callable[..., "Response | None"],
    title: str,
    connection: "ServerConnection",
    request: "Request",
) -> "Response | None":
    refusal, host = auth.refusal(request), ""
    try:
        response = connection.respond(refusal[0], f"{refusal[1]}\n") if refusal else viser(connection, request)
    except (OSError, ValueError, LookupError):  # a path that is invalid on any file system, or a duplicate header
        response = connection.respond(HTTPStatus.BAD_REQUEST, "This is not a request for a page.\n")
    if response is not None:
        if refusal is None:
            _entitle(response, title)
            host = request.headers["Host"]
            response.headers["Set-Cookie"] = auth.cookie(connection.local_address[1])
        response.headers.update(HEADERS | {"Content-Security-Policy": POLICY.format(host=host)})
    return response
