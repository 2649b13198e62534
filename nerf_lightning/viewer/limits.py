"""What one browser, or all of them, may cost the viewer: everything that a stranger's message could make large."""

import math

MOST_CLIENTS = 8
"""How many people are drawn for at once: each costs a picture in memory and a share of the time."""
MOST_CONNECTIONS = 2 * MOST_CLIENTS
"""Open websockets: more than people who are drawn for, since the others are told through theirs that it is full."""
MOST_SOCKETS = 64
"""TCP connections of any kind, half-open ones too: far below the file descriptors that a process has."""
MOST_MESSAGES_PER_SECOND = 200
"""Messages of one client beyond this are dropped unread; the page itself sends 20 to 50."""
MOST_BYTES_PER_SECOND, MOST_BYTES_AT_ONCE = 100 * 1024, 1024 * 1024
"""The connection of a client that sends more is closed; the page sends some 15 kB a second."""
MOST_MESSAGE_BYTES = 64 * 1024
"""A larger message closes its connection; the page's own have some hundred bytes."""
SEND_SECONDS = 20.0
"""A client that has not taken a picture after this time (seconds) is disconnected: what it is sent lies in memory."""

MOST_SIDE = 4096
"""A window counts as no wider and no higher than this (pixels)."""
MOST_PIXELS = 3840 * 2160
"""A window counts as no larger than this (pixels), at its own shape."""
MOST_SQUARES = 4
"""A picture has at most this many times max_height x max_height pixels; windows wider than 4:1 get a coarser one."""
LEAST_FOV, MOST_FOV = math.radians(0.1), math.radians(170.0)
"""Vertical field of view (radians)."""
MOST_COORDINATE = 1e6
"""Cameras stand no farther from the origin along any axis (the model's frame, where a scene measures some units)."""
MOST_VALUE = 1e9
"""Numbers of the panel, before each control's own range."""
MOST_LETTERS = 200
"""Texts of a message, and names that the page shows."""

MOST_SNAPSHOTS = 1000
"""Files of snapshots in one folder."""
MOST_PATHS = 200
"""Files of camera paths in one folder."""
MOST_FILMS = 50
"""Folders of films in one folder; one film is made at a time."""
LEAST_FILM_WIDTH, MOST_FILM_WIDTH = 32, 1920
"""Pixels across a film."""
MOST_FILM_RATE = 60
"""Frames per second of a film."""
MOST_DOWNLOAD_BYTES = 64 * 1024 * 1024
"""A larger film is not sent to a browser: what waits for a browser lies in memory."""
MOST_KEYFRAMES = 1000
"""Keyframes of one path; each is drawn in the page."""
MOST_SECONDS_BETWEEN = 3600.0
"""Time between two keyframes (seconds)."""
MOST_COMPLAINTS = 20
"""Lines in the log about what went wrong for those who look on; then the viewer is silent."""
