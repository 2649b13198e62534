"""Ports for servers that tests start."""

import socket


def unused_port() -> int:
    """Return a port where nobody listens now; a server that finds it taken after all takes the next."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
