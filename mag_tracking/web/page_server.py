"""Serves the live page and its WebSocket, in a thread of its own."""

import asyncio
import gzip
import ipaddress
import secrets
import socket
import threading
from http import HTTPStatus
from logging import ERROR, getLogger
from typing import Protocol
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import ServerConnection, broadcast, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from mag_tracking.errors import DeviceError
from mag_tracking.report.page import live_html

LOOPBACK = '127.0.0.1'
DEFAULT_PORT = 8765
TICK_S = 0.05
"""[s] Between two messages: a target at 50 km/h gets on by 0.7 m."""
MOST_BUFFERED = 1_000_000
"""Bytes that wait for a viewer; beyond, it gets nothing more until it has read them."""
GIVE_UP_S = 20.0
"""[s] A viewer that has not caught up by then is disconnected."""
MOST_VIEWERS = 100
MOST_PORT = 65535
START_S = 10.0
PAGE, STREAM = '/', '/stream'


class Source(Protocol):
    """What is shown, such as a `LiveScene`."""

    def whole(self) -> list[str]:
        """Messages for a viewer that has nothing."""

    def news(self) -> list[str]:
        """Messages for all viewers."""


class PageServer:
    """A live page that any number of browsers may look at.

    Parameters
    ----------
    source : LiveScene
    host : str
        An address of this machine. From others than this the page is seen where it is not of the
        loopback, and then only with a token.
    port : int
        0: any that is free.

    Attributes
    ----------
    url : str
        What a browser opens, with the token where one is needed.
    n_viewers : int
    n_behind : int
        Viewers that could not follow and got no news for a while, in all.

    Raises DeviceError where the port cannot be opened.
    """

    def __init__(self, source: Source, host: str = LOOPBACK, port: int = DEFAULT_PORT) -> None:
        self._source, self._host = source, host
        self._token = '' if is_loopback(host) else secrets.token_urlsafe(16)
        self._page = gzip.compress(live_html().encode('utf-8'), 6)
        self._viewers: set[ServerConnection] = set()
        self._behind: dict[ServerConnection, float] = {}
        self.n_behind = 0
        self._socket = _listening(host, port)
        self.port = int(self._socket.getsockname()[1])
        shown = f'[{host}]' if ':' in host else host
        self.url = f'http://{shown}:{self.port}/' + (
            f'?token={self._token}' if self._token else '')
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name='page server', daemon=True)
        self._thread.start()

    @property
    def n_viewers(self) -> int:
        """Browsers that look at the page now."""
        return len(self._viewers)

    def close(self) -> None:
        """Disconnect all viewers and free the port."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join(START_S)

    def __enter__(self) -> 'PageServer':
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self) -> None:
        """The thread."""
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._loop.close()

    async def _serve(self) -> None:
        """Serve until told to stop."""
        log = getLogger('mag_tracking.web')
        log.setLevel(ERROR)
        # Everybody can send ill-formed requests: they are no news.
        log.addFilter(lambda record: record.msg != 'opening handshake failed')
        # Compression would be done once a viewer.
        async with serve(self._look, sock=self._socket, process_request=self._answer,
                         compression=None, max_size=1024, max_queue=4, logger=log,
                         open_timeout=10.0, close_timeout=1.0, ping_interval=10.0,
                         ping_timeout=20.0):
            while not self._stop.is_set():
                self._tell()
                try:
                    await asyncio.wait_for(self._stop.wait(), TICK_S)
                except asyncio.TimeoutError:
                    continue

    def _tell(self) -> None:
        """Send what is new to all who can follow; a whole scene to those who have caught up."""
        if not self._viewers and not self._behind:
            return
        now = self._loop.time()
        for viewer in list(self._viewers):
            if _waiting(viewer) > MOST_BUFFERED:
                self._viewers.discard(viewer)
                self._behind[viewer] = now
                self.n_behind += 1
        for message in self._source.news():
            broadcast(self._viewers, message)
        for viewer, since in list(self._behind.items()):
            if not _waiting(viewer):
                del self._behind[viewer]
                self._welcome(viewer)
            elif now - since > GIVE_UP_S:
                del self._behind[viewer]
                viewer.transport.abort()

    def _welcome(self, viewer: ServerConnection) -> None:
        """Send all that there is, after which the news follow."""
        # What is new goes out first: it is part of the whole, and must not come again.
        for message in self._source.news():
            broadcast(self._viewers, message)
        for message in self._source.whole():
            broadcast([viewer], message)
        self._viewers.add(viewer)

    async def _look(self, viewer: ServerConnection) -> None:
        """One viewer, until it goes; what it says is not heard."""
        if len(self._viewers) + len(self._behind) >= MOST_VIEWERS:
            await viewer.close(1013, 'too many viewers')
            return
        self._welcome(viewer)
        try:
            async for _ in viewer:
                pass
        except ConnectionClosed:
            pass
        finally:
            self._viewers.discard(viewer)
            self._behind.pop(viewer, None)

    def _answer(self, _: ServerConnection, request: Request) -> Response | None:
        """The page, a refusal, or None for a WebSocket that may go on."""
        address = urlsplit(request.path)
        refusal = self._refusal(request, parse_qs(address.query).get('token', [''])[0])
        if refusal:
            return _response(HTTPStatus.FORBIDDEN, refusal.encode('utf-8'), 'text/plain')
        if address.path == STREAM:
            return None
        if address.path != PAGE:
            return _response(HTTPStatus.NOT_FOUND, b'There is only the page / here.\n',
                             'text/plain')
        return _response(HTTPStatus.OK, self._page, 'text/html', 'gzip')

    def _refusal(self, request: Request, token: str) -> str:
        """Why a request is refused, or nothing."""
        host = request.headers.get('Host', '')
        if self._token:
            if not secrets.compare_digest(token.encode('utf-8'), self._token.encode('utf-8')):
                return 'The address of this page needs the token that was printed at the start.\n'
        # A page of elsewhere could name this address under a name of its own.
        elif not is_loopback(_host_name(host)):
            return 'Without a token this page is for this machine only.\n'
        origin = request.headers.get('Origin')
        if origin is not None and urlsplit(origin).netloc != host:
            return 'Pages of other servers may not look at this stream.\n'
        return ''


def check_port(host: str, port: int) -> None:
    """Raise DeviceError where a page could not be served."""
    _listening(host, port).close()


def is_loopback(host: str) -> bool:
    """Whether a host name or address is that of this machine alone."""
    if host == 'localhost':
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _host_name(host: str) -> str:
    """The name or address in a Host header, without the port."""
    try:
        return urlsplit(f'//{host}').hostname or ''
    except ValueError:
        return ''


def _waiting(viewer: ServerConnection) -> int:
    """Bytes that a viewer has not yet read."""
    return viewer.transport.get_write_buffer_size()


def _listening(host: str, port: int) -> socket.socket:
    """A socket that listens; raises DeviceError where it cannot be had."""
    if not 0 <= port <= MOST_PORT:
        raise DeviceError(f'the live page cannot be served on port {port}: expected a number up '
                          f'to {MOST_PORT}')
    try:
        family, _, _, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        return socket.create_server(address[:2], family=family, backlog=64)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, 'strerror', None) or str(error)
        raise DeviceError(f'the live page cannot be served on {host} port {port}: {reason}; '
                          'choose another port') from error


def _response(status: HTTPStatus, body: bytes, kind: str, encoding: str = '') -> Response:
    """A response with the headers that keep a page to itself."""
    headers = Headers({
        'Content-Type': f'{kind}; charset=utf-8', 'Content-Length': str(len(body)),
        'Cache-Control': 'no-store', 'Referrer-Policy': 'no-referrer', 'Connection': 'close',
        'X-Content-Type-Options': 'nosniff', 'X-Frame-Options': 'DENY'})
    if encoding:
        headers['Content-Encoding'] = encoding
    return Response(status.value, status.phrase, headers, body)
