"""Who may speak to the page: whoever has its token, under one of its names, and from no other site."""

import hmac
import re
import secrets
from collections.abc import Callable, Sequence
from http import HTTPStatus

from nerf_lightning.messages.errors import InputError

LOCAL = ("127.0.0.1", "localhost", "[::1]")
# A machine's name or address, and perhaps a port.
HOST = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9_-]+(?:\.[a-z0-9_-]+)*)(?::[0-9]{1,5})?")
LONGEST_PATH = 2000
NO_TOKEN = "The access token is missing: open the whole address that nerf printed, with ?token=..."
FOREIGN = "This request comes from another site, which may not access this page."


class Auth:
    """Judge requests by their address and their headers.

    A site that somebody visits can send requests to this machine with that person's browser, which says truthfully
    where they come from (Origin) and which name it believes to speak to (Host). Other programs lie as they please, so
    they need the token; it comes in the address at first, and then in a cookie that no script reads.

    Ports are not compared with the page's own, so tunnels work.

    Args:
        host: the address that is listened on.
        hosts: further names by which browsers find the page.
    """

    def __init__(self, host: str, hosts: Sequence[str] | str | None = None):
        self.token = secrets.token_urlsafe(32)
        self._given = names_of(hosts)
        self._known = {*LOCAL, f"[{host}]" if ":" in host else host.lower(), *self._given}

    def refusal(self, path: str, values: Callable[[str], list[str]], port: int) -> tuple[HTTPStatus, str] | None:
        """Return why a request is refused, in one sentence; None: it may pass.

        `path` has the query, `values` returns those of a header, and the page listens at `port`.
        """
        if len(path) > LONGEST_PATH:
            return HTTPStatus.REQUEST_URI_TOO_LONG, "The page has no address as long as this one."
        if len(values("Host")) != 1:
            return HTTPStatus.BAD_REQUEST, "A request must have one Host header."
        host, origin = (", ".join(values(name)).lower() for name in ("Host", "Origin"))
        source = origin.partition("://")[2]
        name, from_name = (match[1] if (match := HOST.fullmatch(each)) else None for each in (host, source))
        if name not in self._known:
            hint = f": if it is yours, start nerf with viewer.hosts=[{name}]" if name else ""
            return HTTPStatus.FORBIDDEN, f"The page is not served under this name{hint}."
        if origin and source != host and from_name not in self._given:
            return HTTPStatus.FORBIDDEN, FOREIGN
        cookies = [pair.strip() for header in values("Cookie") for pair in header.split(";")]
        in_query = _holds(path.partition("?")[2].split("&"), f"token={self.token}")
        return None if in_query or _holds(cookies, self.cookie(port)) else (HTTPStatus.FORBIDDEN, NO_TOKEN)

    def cookie(self, port: int) -> str:
        """Return what keeps the token in the browser, which has the cookies of one machine together for all ports."""
        return f"nerf_lightning_{port}={self.token}"


def names_of(hosts: Sequence[str] | str | None) -> set[str]:
    """Return the names in `viewer.hosts`, without their ports; what is no name is refused."""
    found = {
        each: HOST.fullmatch(str(each).lower()) for each in ([hosts] if isinstance(hosts, str | int) else hosts or ())
    }
    for each in (each for each, match in found.items() if match is None):
        raise InputError(
            f"viewer.hosts: {each!r} is not the name of a machine: give names such as castle.example or 192.168.1.5."
        )
    return {match[1] for match in found.values() if match}


def _holds(given: list[str], secret: str) -> bool:
    return any(hmac.compare_digest(each.encode("utf-8", "surrogateescape"), secret.encode()) for each in given)
