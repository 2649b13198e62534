"""viser's server behind a guard: who may enter, what passes, and what is said when something goes wrong.

viser by itself checks neither Origin nor Host, knows no token, has no limits and sends no headers of its own. It
serves through `websockets.serve`, which can do all of that, but no argument of viser's reaches there. So while viser
starts, it finds another `serve` in that place, which adds what is missing.
"""

import asyncio
import logging
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http import HTTPStatus
from typing import Any

from websockets.asyncio import server as websockets_server
from websockets.asyncio.server import ServerConnection, serve
from websockets.http11 import Request, Response

from nerf_lightning.messages.errors import InputError
from nerf_lightning.viewer import limits
from nerf_lightning.viewer.admission import Admission
from nerf_lightning.viewer.complaints import Complaints
from nerf_lightning.viewer.connections import GuardedConnection
from nerf_lightning.viewer.page_headers import FIXED, UNMARKED, headers_for, marked

FULL = "So many look on already that the viewer takes no more connections: close a page of it.\n"

# websockets logs a traceback for each broken handshake, and any program can send one.
unheard = logging.getLogger("nerf_lightning.viewer.handshakes")
unheard.setLevel(logging.CRITICAL + 1)

Handler = Callable[[ServerConnection], Awaitable[None]]
ProcessRequest = Callable[[ServerConnection, Request], Response | None]


class Guard:
    """Stand between websockets and viser.

    Args:
        admission: judges requests.
        complaints: hears of what goes wrong.
    """

    def __init__(self, admission: Admission, complaints: Complaints):
        self.admission, self.complaints = admission, complaints
        self.is_in_place = False

    @contextmanager
    def in_place(self) -> Iterator[None]:
        """Guard the server that viser starts within the block."""
        websockets_server.serve = self._serve  # type: ignore[misc, assignment]
        try:
            yield
        finally:
            websockets_server.serve = serve  # type: ignore[misc]

    def require_in_place(self) -> None:
        """Refuse a viser that serves in another way.

        Raises:
            InputError: it does.
        """
        if not self.is_in_place:
            raise InputError(
                "This version of viser serves its page in a way that cannot be guarded against strangers. Install one "
                "that can: pip install 'viser==1.1.1'."
            )

    def _serve(self, handler: Handler, host: str, port: int, **options: Any) -> serve:
        self.is_in_place = True
        asyncio.get_running_loop().set_exception_handler(self._complain)
        options["process_request"] = partial(self._answer, options["process_request"])
        options["max_size"] = limits.MOST_MESSAGE_BYTES
        return serve(
            partial(self._handle, handler),
            host,
            port,
            create_connection=GuardedConnection,
            logger=unheard,
            server_header=None,
            **options,
        )

    async def _handle(self, handler: Handler, connection: ServerConnection) -> None:
        try:
            await handler(connection)
        except Exception as error:
            self.complaints.say("a connection to the viewer was ended", error)

    def _complain(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        # Without an exception it is a task that did not live to see the end of the server.
        if (error := context.get("exception")) is not None:
            self.complaints.say("the viewer did not do what a message asked for", error)

    def _answer(self, viser: ProcessRequest, connection: ServerConnection, request: Request) -> Response | None:
        headers, port = request.headers, connection.local_address[1]
        hosts = headers.get_all("Host")
        reason = self.admission.refusal(request.path, hosts, headers.get_all("Origin"), headers.get_all("Cookie"), port)
        if reason is not None:
            return _with(connection.respond(HTTPStatus.FORBIDDEN, f"{reason}\n"), FIXED)
        # The page is marked below, which is easier while it is not compressed.
        if "Accept-Encoding" in headers:
            del headers["Accept-Encoding"]
        response = viser(connection, request)
        if response is None:
            full = len(connection.server.connections) >= limits.MOST_CONNECTIONS
            return _with(connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, FULL), FIXED) if full else None
        scripts = self._mark(response) if response.headers.get("Content-Type", "").startswith("text/html") else "'none'"
        if self.admission.brings_token(request.path):
            response = _with(response, {"Set-Cookie": self.admission.cookie(port)})
        return _with(response, headers_for(hosts[0], scripts))

    def _mark(self, response: Response) -> str:
        """Mark the page's scripts; return which scripts its policy lets run."""
        page = marked(response.body or b"")
        if page is None:
            self.complaints.say(
                "the page of this version of viser is not known here: it is shown, but nothing would keep a stranger's "
                "script from being run if one got in. viser 1.1.1 has a page that is known"
            )
            return UNMARKED
        response.body, scripts = page
        _with(response, {"Content-Length": str(len(response.body))})
        return scripts


def _with(response: Response, headers: dict[str, str]) -> Response:
    for name, value in headers.items():
        if name in response.headers:
            del response.headers[name]
        response.headers[name] = value
    return response
