"""How the program ends. A signal that stops a run ends it with 128 + its number, as a shell reports."""

FAILED = 1
"""A job of a sweep, or a check of the selftest, has failed."""
BAD_INPUT = 2
"""Bad input, a full disk or memory, a failing GPU: explained in one paragraph (`explained` in cli/main.py)."""
INTERRUPTED = 130
"""128 + SIGINT."""
READER_LEFT = 141
"""128 + SIGPIPE, as a shell reports for `yes`; a sweep treats it as a stop, not as a failed job."""
OF_SIGNALS = 128
