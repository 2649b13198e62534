"""The page's address and port: the requested port, or the next free one.

The port requested by default: `conf/view.yaml`, during training `conf/viewer/on.yaml`.
"""

import logging
import os
import re
import socket

from nerf_lightning.messages.errors import InputError

TRIED = 50

log = logging.getLogger(__name__)


def free_port(host: str, port: int) -> int:
    """Return the port, or, if another program uses it, the next free one, and log that."""
    require_address(host, port)
    for candidate in range(port, min(port + TRIED, 65_536)):
        try:
            _try(host, candidate)
        except PermissionError as error:
            raise InputError(
                f"port={candidate}: this user may not use it ({error.strerror}). Give a port from 1024 on."
            ) from error
        except OSError:
            continue
        if candidate != port:
            log.warning("port %d is in use by another program; %d is taken instead.", port, candidate)
        return candidate
    raise InputError(f"Ports {port} to {candidate} are all in use on {host}. Give a free one, or stop what has them.")


def require_address(host: str, port: int) -> None:
    """Refuse an address that is not this machine's, and an invalid port number, whether in use or not."""
    if not 1 <= port <= 65_535:
        raise InputError(f"port={port}: give a number from 1 to 65535; 1024 and more need no special rights.")
    try:
        _try(host, 0)
    except OSError as error:
        raise InputError(
            f"host={host}: this machine cannot listen there ({error}). Use 127.0.0.1 (this machine only), 0.0.0.0 "
            "(everybody who can reach it), or one of its own addresses."
        ) from error


def address_of(host: str, port: int) -> str:
    """Return the URL for a browser on this machine.

    >>> address_of("0.0.0.0", 80), address_of("::", 80), address_of("fd00::2", 80)
    ('http://127.0.0.1:80', 'http://[::1]:80', 'http://[fd00::2]:80')
    """
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def tunnel(address: str) -> list[str]:
    """Return the command that a user connected over SSH must run first, as a line; nothing for other users."""
    found = re.match(r"http://127\.0\.0\.1:(\d+)", address)
    if found is None or "SSH_CONNECTION" not in os.environ:
        return []
    return [f"Over SSH, first run on your own computer: ssh -L {found[1]}:127.0.0.1:{found[1]} MACHINE"]


def _try(host: str, port: int) -> None:
    family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    with socket.socket(family, kind, protocol) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind(address)
