"""Pages that a command serves to a browser: viser's server behind a check of every request.

viser draws 3-D scenes, images and controls in the browser. Of itself it listens on all interfaces,
accepts every request, and lets every visitor open a tunnel through a public server. Here it listens
on the loopback interface; on any other address each request needs a token. Requests that another
website makes from the visitor's browser are refused, too.
"""

from __future__ import annotations

import contextlib
import functools
import hmac
import http.client
import io
import ipaddress
import logging
import os
import re
import secrets
import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from importlib.util import find_spec
from typing import TYPE_CHECKING, Annotated, Any
from unittest import mock
from urllib.parse import parse_qs, urlsplit

from annotated_types import Interval

from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.extras import install_command

if TYPE_CHECKING:
    import viser

TOKEN_VARIABLE = "RMB_TOKEN"
"""Environment variable with the token: other users of a machine can read command lines."""

TOKEN_BYTES = 16
"""Random bytes of a suggested token: 128 bits cannot be guessed."""

PATIENCE = 30.0
"""s to wait for the own server's answer."""

Port = Annotated[int, Interval(ge=0, le=65535)]

_TOKEN = re.compile(r"[A-Za-z0-9_-]{16,}")


@dataclass(frozen=True)
class PageOptions:
    """Address of a page.

    Attributes:
        host: Address to listen on. Only this machine can connect to 127.0.0.1; any other address
            needs a token.
        port: Port to listen on; 0 for a free one.
        token: Secret that visitors need; that of the environment variable RMB_TOKEN if not given.

    Raises:
        RequestError: the address needs a token, or the token is too short.
    """

    host: str = "127.0.0.1"
    port: Port = 8080
    token: str | None = None

    def __post_init__(self) -> None:
        if self.secret is None and not is_loopback(self.host):
            raise RequestError(
                f"--host {self.host}: other machines could connect; give a token, too, for example "
                f"--token {secrets.token_hex(TOKEN_BYTES)}"
            )
        if self.secret is not None and not _TOKEN.fullmatch(self.secret):
            raise RequestError(
                "--token: must be 16 or more letters, digits, - and _, for example "
                f"{secrets.token_hex(TOKEN_BYTES)}"
            )

    @property
    def secret(self) -> str | None:
        """The token, wherever it was given; None without one."""
        return self.token or os.environ.get(TOKEN_VARIABLE) or None


def is_loopback(host: str) -> bool:
    """Return True if only this machine can connect to an address."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True)
class Gate:
    """Decision which requests a page answers.

    Attributes:
        host: address that the page listens on.
        token: that visitors need; None on the loopback interface.
    """

    host: str
    token: str | None

    def refusal(self, target: str, headers: Any) -> tuple[int, dict[str, str], str] | None:
        """Return status, headers and text of the answer to a request; None if it may pass.

        The token comes with the first request, in the address; a cookie holds it from then on, so
        that it stays in no history of addresses.

        Args:
            target: path and query.
            headers: mapping of names, in any case, to values.
        """
        try:
            return self._refusal(target, headers)
        except ValueError:  # an address that is none, or bytes that are no text
            return HTTPStatus.BAD_REQUEST, {}, "This request is malformed.\n"

    def _refusal(self, target: str, headers: Any) -> tuple[int, dict[str, str], str] | None:
        given, origin = headers.get("Host", ""), headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc.lower() != given.lower():
            return HTTPStatus.FORBIDDEN, {}, "This request comes from another website.\n"
        if self.token is None:
            names = {"localhost", "127.0.0.1", "::1", self.host}
            if urlsplit(f"//{given}").hostname not in names:
                return HTTPStatus.FORBIDDEN, {}, f"This page is not at '{given}'.\n"
            return None
        cookie = f"rmb_token_{given.rpartition(':')[2] or 'page'}"  # cookies ignore ports
        cookie = re.sub(r"[^A-Za-z0-9_]", "", cookie)
        with contextlib.suppress(CookieError):
            found = SimpleCookie(headers.get("Cookie", "")).get(cookie)
            value = "" if found is None else found.value
            if hmac.compare_digest(value.encode(), self.token.encode()):
                return None
        shown = parse_qs(urlsplit(target).query).get("token", [""])[-1]
        if hmac.compare_digest(shown.encode(), self.token.encode()):
            keep = f"{cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"
            return HTTPStatus.SEE_OTHER, {"Location": "/", "Set-Cookie": keep}, ""
        return HTTPStatus.FORBIDDEN, {}, "Open the address that the command printed.\n"


def require_viser(extra: str) -> None:
    """Require the library that draws pages.

    Args:
        extra: of this package that installs it.

    Raises:
        RequestError: it is not installed.
    """
    if find_spec("viser") is None:
        raise RequestError(
            f"the page needs viser, which is not installed: {install_command(extra)}"
        )


@contextlib.contextmanager
def serve_page(options: PageOptions, label: str) -> Iterator[tuple[viser.ViserServer, str]]:
    """Yield viser's server and the address to open, token included; stop the server at the end.

    Args:
        options: address.
        label: title of the page.

    Raises:
        RequestError: nothing can listen at the address.
        RuntimeError: this release of viser lets requests past the `Gate`.
    """
    import viser

    class Server(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> str | None:
            """Refuse what a visitor may ask for: a public address of this page."""

    # It tells of every connection, and of the request that `_require_guarded` makes.
    logging.getLogger("websockets").setLevel(logging.WARNING)
    _require_free(options)
    gate = Gate(options.host, options.secret)
    with _guarded(gate), contextlib.redirect_stdout(io.StringIO()):  # viser prints its address
        server = Server(options.host, options.port, label, verbose=False)
    try:
        port = server.get_port()
        _require_guarded(options.host, port)
        server.gui.configure_theme(show_share_button=False, show_logo=False)
        name = f"[{options.host}]" if ":" in options.host else options.host
        name = socket.gethostname() if name in ("0.0.0.0", "[::]") else name
        query = f"/?token={gate.token}" if gate.token else "/"
        yield server, f"http://{name}:{port}{query}"
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def _require_free(options: PageOptions) -> None:
    """Raise RequestError unless a server can listen at an address; viser tries other ports."""
    try:
        found = socket.getaddrinfo(options.host, options.port, type=socket.SOCK_STREAM)
        with socket.socket(found[0][0], socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(found[0][4])
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RequestError(
            f"--host {options.host} --port {options.port}: {reason}; choose another port (0 for "
            "any that is free) or address"
        ) from error


@contextlib.contextmanager
def _guarded(gate: Gate) -> Iterator[None]:
    """Ask a gate about each request of the servers that the library websockets makes meanwhile."""
    from websockets.asyncio import server as library
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    serve = library.serve

    @functools.wraps(serve)
    def guarded(*arguments: Any, process_request: Callable[..., Any], **settings: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            refused = gate.refusal(request.path, request.headers)
            if refused is None:
                return process_request(connection, request)
            status, headers, text = refused
            body = text.encode()
            kind = {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))}
            given = Headers({**kind, **headers, "Connection": "close"})
            return Response(status, HTTPStatus(status).phrase, given, body)

        return serve(*arguments, process_request=check, **settings)

    with mock.patch.object(library, "serve", guarded):
        yield


def _require_guarded(host: str, port: int) -> None:
    """Raise RuntimeError if a running server answers a request that its gate refuses."""
    address = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    connection = http.client.HTTPConnection(address, port, timeout=PATIENCE)
    with contextlib.closing(connection):
        connection.request("GET", "/", headers={"Host": "refuse.invalid"})
        status = connection.getresponse().status
    if status != HTTPStatus.FORBIDDEN:
        raise RuntimeError(f"viser answered a request from elsewhere with {status}, not with 403")
