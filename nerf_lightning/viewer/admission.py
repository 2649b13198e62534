"""Who may speak to the page: its own addresses, and of those who call there, whoever has the token."""

import hmac
import re
import secrets
from collections.abc import Sequence
from urllib.parse import parse_qs

from nerf_lightning.messages.errors import InputError

# A machine's name or address, and perhaps a port.
PLACE = re.compile(r"(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9_-]+(?:\.[A-Za-z0-9_-]+)*)(?::([0-9]{1,5}))?")
OURS = ("127.0.0.1", "localhost", "[::1]")
EVERYWHERE = ("0.0.0.0", "::", "")
PORTS = {"http": 80, "https": 443}

NO_TOKEN = "This page is for whoever has its token: open the address with ?token= that nerf printed when it started."
FOREIGN = "This request comes from another site, which may not speak to this page."


class Admission:
    """Judge requests by their headers and their address.

    A site that somebody visits can send requests to this machine, with that person's browser as its hand. The browser
    says truthfully where such a request comes from (Origin) and which name it believes to speak to (Host); it keeps the
    token's cookie from other sites. Programs that are no browsers lie as they please, so they need the token.

    Args:
        host: the address that is listened on.
        hosts: further names by which browsers find the page, each at the page's port unless it has its own.

    Raises:
        InputError: a name that is none.
    """

    def __init__(self, host: str, hosts: Sequence[str] | str | None = None):
        self.token = secrets.token_urlsafe(32)
        listening = () if host in EVERYWHERE else (f"[{host}]" if ":" in host else host,)
        ours: list[tuple[str, int | None]] = [(name.lower(), None) for name in (*OURS, *listening)]
        self._places = ours + named_places(hosts)

    def refusal(self, path: str, hosts: list[str], origins: list[str], cookies: list[str], port: int) -> str | None:
        """Return why a request is refused, in one sentence; None: it may pass.

        Args:
            path: what is asked for, with the query.
            hosts: the values of the header Host.
            origins: those of Origin.
            cookies: those of Cookie.
            port: where the page listens.
        """
        place = place_of(hosts[0]) if len(hosts) == 1 else None
        if place is None:
            return "This request does not name one host."
        if not self._is_ours((place[0], place[1] or 80), port):
            name = hosts[0] if place[1] not in (None, port) else place[0]
            return f"The page is not served under this name: if it is yours, start nerf with viewer.hosts=[{name}]."
        if origins and not (len(origins) == 1 and self._is_our_origin(origins[0], port)):
            return FOREIGN
        if not any(map(self._is_token, (*given_in_query(path), *given_in_cookie(cookies, cookie_name(port))))):
            return NO_TOKEN
        return None

    def brings_token(self, path: str) -> bool:
        """Tell whether the address that is asked for holds the token."""
        return any(map(self._is_token, given_in_query(path)))

    def cookie(self, port: int) -> str:
        """Return what keeps the token in the page: no script reads it, and no other site's request carries it."""
        return f"{cookie_name(port)}={self.token}; HttpOnly; SameSite=Strict; Path=/"

    def _is_token(self, given: str) -> bool:
        return hmac.compare_digest(given.encode("utf-8", "surrogateescape"), self.token.encode())

    def _is_ours(self, place: tuple[str, int], port: int) -> bool:
        return any(place == (name, at or port) for name, at in self._places)

    def _is_our_origin(self, origin: str, port: int) -> bool:
        scheme, _, rest = origin.partition("://")
        place = place_of(rest)
        return place is not None and scheme in PORTS and self._is_ours((place[0], place[1] or PORTS[scheme]), port)


def named_places(hosts: Sequence[str] | str | None) -> list[tuple[str, int | None]]:
    """Return the names and ports of `viewer.hosts`.

    Raises:
        InputError: a name that is none.
    """
    given = [hosts] if isinstance(hosts, str | int) else hosts or ()
    places = {str(each): place_of(str(each)) for each in given}
    for each, place in places.items():
        if place is None:
            raise InputError(
                f"viewer.hosts: {each!r} is no name of a machine: give names of machines like castle.example or "
                "192.168.1.5, with a port where browsers find the page at another one than it listens on, like "
                "gate.example:443."
            )
    return [place for place in places.values() if place is not None]


def place_of(text: str) -> tuple[str, int | None] | None:
    """Return the name and the port of a place, or None where it is neither.

    >>> place_of("Localhost:80"), place_of("[::1]"), place_of("a b"), place_of("a:99999")
    (('localhost', 80), ('[::1]', None), None, None)
    """
    found = PLACE.fullmatch(text)
    if found is None or not 1 <= int(found[2] or 1) <= 65_535:
        return None
    return found[1].lower(), int(found[2]) if found[2] else None


def cookie_name(port: int) -> str:
    """Return the cookie's name: browsers keep cookies of one machine together, whatever the port."""
    return f"nerf_lightning_{port}"


def given_in_query(path: str) -> list[str]:
    """Return the tokens in an address's query."""
    return parse_qs(path.partition("?")[2], errors="surrogateescape").get("token", [])


def given_in_cookie(headers: list[str], name: str) -> list[str]:
    """Return the values of one cookie.

    >>> given_in_cookie(["a=1; b=2", "a=3"], "a")
    ['1', '3']
    """
    pairs = (pair.strip().partition("=") for header in headers for pair in header.split(";"))
    return [value for key, _, value in pairs if key == name]
