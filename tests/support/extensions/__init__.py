"""Parts that somebody adds: each one file, and one yaml under conf/."""
