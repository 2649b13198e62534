"""viser's server, which answers those alone whom `Auth` lets in, and tells browsers to load nothing from elsewhere.

viser by itself checks neither Origin nor Host, and knows no token. It serves through `websockets.serve`, which can do
that, but no argument of viser's reaches there. So while viser starts, it finds another `serve` in that place.
"""

import logging
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import partial
from http import HTTPStatus
from io import StringIO
from typing import Any

from viser import ViserServer
from websockets.asyncio import server as websockets_server
from websockets.asyncio.server import ServerConnection, serve
from websockets.http11 import Request, Response

from nerf_lightning.messages.errors import InputError
from nerf_lightning.viewer.auth import Auth

# viser's page has its scripts and styles within it, unpacks itself with WebAssembly, and makes workers and pictures
# from blobs. Older browsers do not count the page's own socket as 'self'.
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
# websockets logs a traceback for each broken handshake, and any program can send one.
unheard = logging.getLogger("nerf_lightning.viewer.handshakes")
unheard.setLevel(logging.CRITICAL + 1)


def guarded_server(auth: Auth, host: str, port: int) -> ViserServer:
    """Start viser's server behind the guard, unless this version of it serves in a way that cannot be guarded."""
    guarded = []

    def guarded_serve(*where: Any, process_request: Callable[..., Response | None], **options: Any) -> serve:
        guarded.append(where)
        answer = partial(_answer, auth, process_request)
        return serve(*where, process_request=answer, logger=unheard, server_header=None, **options)

    websockets_server.serve = guarded_serve  # type: ignore[misc, assignment]
    try:
        with redirect_stdout(StringIO()):  # viser prints boxes
            server = ViserServer(host, port, label="nerf_lightning", verbose=False)
    finally:
        websockets_server.serve = serve  # type: ignore[misc]
    if not guarded:
        server.stop()
        raise InputError(
            "This version of viser serves its page in a way that cannot be guarded against strangers. Install one "
            "that can: pip install 'viser==1.1.1'."
        )
    return server


def _answer(
    auth: Auth, viser: Callable[..., Response | None], connection: ServerConnection, request: Request
) -> Response | None:
    port, host = connection.local_address[1], ""
    refusal = auth.refusal(request.path, request.headers.get_all, port)
    try:
        response = connection.respond(refusal[0], f"{refusal[1]}\n") if refusal else viser(connection, request)
    except (OSError, ValueError, LookupError):  # a path that no file system takes, or a header that comes twice
        response = connection.respond(HTTPStatus.BAD_REQUEST, "This is not a request for a page.\n")
    if response is not None:
        if refusal is None:
            host = request.headers["Host"]
            response.headers["Set-Cookie"] = f"{auth.cookie(port)}; HttpOnly; SameSite=Strict; Path=/"
        response.headers.update(HEADERS | {"Content-Security-Policy": POLICY.format(host=host)})
    return response
