"""What a browser is told about the page: it loads nothing from elsewhere, runs no other script, stands in no frame."""

import secrets

# viser's page unpacks itself with WebAssembly, makes its workers and pictures from blobs, and styles its elements one
# by one; it needs neither eval nor anything from another machine. Its socket goes where the page came from: older
# browsers do not count that as 'self'.
POLICY = (
    "default-src 'none'",
    "script-src {scripts} 'wasm-unsafe-eval'",
    "style-src 'unsafe-inline'",
    "img-src 'self' data: blob:",
    "font-src data:",
    "connect-src 'self' ws://{host} wss://{host} data: blob:",
    "worker-src blob: data:",
    "object-src 'none'",
    "base-uri 'none'",
    "form-action 'none'",
    "frame-src 'none'",
    "frame-ancestors 'none'",
)
FIXED = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
# What runs in a page whose scripts could not be marked.
UNMARKED = "'self' 'unsafe-inline'"
# The page's two scripts: the one that unpacks, and the one that it unpacks and adds.
SCRIPTS = ((b"<script ", b"<script nonce='%s' "), (b'e.type="module";', b"e.type=\"module\";e.nonce='%s';"))


def headers_for(host: str, scripts: str) -> dict[str, str]:
    """Return the headers of every answer.

    Args:
        host: the name and port by which the browser found the page.
        scripts: which scripts are run, in the policy's words.
    """
    return {"Content-Security-Policy": "; ".join(POLICY).format(host=host, scripts=scripts)} | FIXED


def marked(page: bytes | bytearray) -> tuple[bytes, str] | None:
    """Return viser's page with its own scripts marked, and the policy under which no other script is run.

    None: this is another page than the one that we know.
    """
    nonce, shown = secrets.token_urlsafe(16), bytes(page)
    for plain, with_mark in SCRIPTS:
        if plain not in shown:
            return None
        shown = shown.replace(plain, with_mark % nonce.encode(), 1)
    return shown, f"'nonce-{nonce}'"
