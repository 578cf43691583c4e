"""HTTP and WebSocket server of the live page, in its own thread."""

import asyncio
import gzip
import ipaddress
import secrets
import socket
import threading
from collections.abc import Callable, Sequence
from http import HTTPStatus
from logging import getLogger
from typing import TYPE_CHECKING
from urllib.parse import SplitResult, parse_qs, urlsplit

from websockets.asyncio.server import ServerConnection, broadcast, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from mag_tracking.errors import DeviceError
from mag_tracking.files import json_text
from mag_tracking.report.page import live_html
from mag_tracking.web import DEFAULT_PORT, LOOPBACK

if TYPE_CHECKING:
    # Loads scipy.
    from mag_tracking.web.live_scene import LiveScene

UPDATE_INTERVAL_S = 0.05
"""[s] Interval between messages. A target at 50 km/h moves 0.7 m in this time."""
MAX_BUFFERED = 1_000_000
"""[bytes] Maximum size of a viewer's send buffer. A viewer that exceeds it receives no messages
until the buffer is empty."""
LAG_TIMEOUT_S = 20.0
"""[s] Time after which a lagging viewer is disconnected if its buffer does not shrink."""
MAX_VIEWERS = 100
MAX_PORT = 65535
STOP_TIMEOUT_S = 10.0
PAGE, STREAM = '/', '/stream'
LOG = getLogger('mag_tracking.web')


class PageServer:
    """Server of the live page, for up to `MAX_VIEWERS` browsers; port 0 selects a free port.

    `url` contains a token, which browsers need, unless `host` is a loopback address. `n_lagged`
    counts suspensions of messages to a lagging viewer. Raises DeviceError if the port cannot be
    opened.
    """

    def __init__(self, source: 'LiveScene', host: str = LOOPBACK, port: int = DEFAULT_PORT) -> None:
        self._source, self._host = source, host
        self._token = '' if is_loopback(host) else secrets.token_urlsafe(16)
        self._page = gzip.compress(live_html().encode('utf-8'), 6)
        # {viewer: permitted size of its send buffer [bytes]}
        self._viewers: dict[ServerConnection, int] = {}
        # {viewer: (time of the latest progress [s], size of its buffer at that time [bytes])}
        self._lagging: dict[ServerConnection, tuple[float, int]] = {}
        self._logged_errors: set[str] = set()
        self.n_lagged = 0
        self._socket = _open_socket(host, port)
        self.port = int(self._socket.getsockname()[1])
        host_name = socket.gethostname() if host in ('0.0.0.0', '::') else \
            f'[{host}]' if ':' in host else host
        self.url = f'http://{host_name}:{self.port}/' + (
            f'?token={self._token}' if self._token else '')
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name='page server', daemon=True)
        self._thread.start()

    @property
    def is_serving(self) -> bool:
        """Whether the server is running; false after `close` or a failure."""
        return self._thread.is_alive()

    @property
    def n_viewers(self) -> int:
        """Number of connected viewers."""
        return len(self._viewers) + len(self._lagging)

    def close(self) -> None:
        """Disconnect all viewers and release the port."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join(STOP_TIMEOUT_S)

    def __enter__(self) -> 'PageServer':
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._loop.close()

    async def _serve(self) -> None:
        # Malformed requests must not fill the log.
        LOG.addFilter(lambda record: record.msg != 'opening handshake failed')
        # Compression would be repeated for every viewer.
        async with serve(self._handle_viewer, sock=self._socket,
                         process_request=self._process_request, compression=None, max_size=1024,
                         max_queue=4, logger=LOG, server_header=None, open_timeout=10.0,
                         close_timeout=1.0, ping_interval=10.0, ping_timeout=60.0):
            while not self._stop.is_set():
                self._send_updates()
                try:
                    await asyncio.wait_for(self._stop.wait(), UPDATE_INTERVAL_S)
                except TimeoutError:
                    continue

    def _messages(self, get_messages: Callable[[], list[str]]) -> list[str]:
        """Get messages from the source; log each error once, and show it on the page."""
        try:
            return get_messages()
        except Exception as error:
            # The page is optional: its errors must stop neither the server nor the nodes.
            description = f'{type(error).__name__}: {error}'
            if description not in self._logged_errors:
                self._logged_errors.add(description)
                LOG.exception('error in the live page')
            return [json_text({'type': 'fault', 'text': description})]

    def _send_updates(self) -> None:
        """Send new messages to all viewers; a lagging one receives the complete scene when its
        buffer is empty, and is disconnected if that has not shrunk for `LAG_TIMEOUT_S`."""
        if not self._viewers and not self._lagging:
            return
        now = self._loop.time()
        for viewer, allowed in list(self._viewers.items()):
            n_buffered = _buffered_bytes(viewer)
            if n_buffered > allowed:
                del self._viewers[viewer]
                self._lagging[viewer] = now, n_buffered
                self.n_lagged += 1
            else:
                # A complete scene may exceed MAX_BUFFERED; the excess is allowed until it is sent.
                self._viewers[viewer] = max(MAX_BUFFERED, min(allowed, n_buffered + MAX_BUFFERED))
        for message in self._messages(self._source.updates):
            broadcast(self._viewers, message)
        for viewer, (progress_time, buffered_before) in list(self._lagging.items()):
            n_buffered = _buffered_bytes(viewer)
            if not n_buffered:
                del self._lagging[viewer]
                self._send_snapshot(viewer)
            elif n_buffered < buffered_before:
                self._lagging[viewer] = now, n_buffered
            elif now - progress_time > LAG_TIMEOUT_S:
                del self._lagging[viewer]
                viewer.transport.abort()

    def _send_snapshot(self, viewer: ServerConnection) -> None:
        """Send the complete scene to a viewer, and include the viewer in later updates."""
        # Pending messages are sent first: the scene contains them, so they must not follow the
        # scene.
        for message in self._messages(self._source.updates):
            broadcast(self._viewers, message)
        for message in self._messages(self._source.snapshot):
            broadcast([viewer], message)
        self._viewers[viewer] = _buffered_bytes(viewer) + MAX_BUFFERED

    async def _handle_viewer(self, viewer: ServerConnection) -> None:
        if self.n_viewers >= MAX_VIEWERS:
            await viewer.close(1013, 'too many viewers')
            return
        self._send_snapshot(viewer)
        try:
            async for _ in viewer:
                pass
        except ConnectionClosed:
            pass
        finally:
            self._viewers.pop(viewer, None)
            self._lagging.pop(viewer, None)

    def _process_request(self, _: ServerConnection, request: Request) -> Response | None:
        """Return the response to an HTTP request, or None to accept a WebSocket connection."""
        address, hosts = _parsed_address(request.path), request.headers.get_all('Host')
        origins = [_parsed_address(text) for text in request.headers.get_all('Origin')]
        if address is None or not address.path.startswith('/') or len(hosts) != 1 \
                or len(origins) > 1 or not all(map(_is_origin, origins)):
            return _response(HTTPStatus.BAD_REQUEST, b'Malformed address, Host or Origin.\n')
        refusal = self._refusal(hosts[0], [origin.netloc for origin in origins if origin],
                                self._tokens_of(request, address.query))
        if refusal:
            return _response(HTTPStatus.FORBIDDEN, refusal.encode('utf-8'))
        if address.path == STREAM:
            return None
        if address.path != PAGE:
            return _response(HTTPStatus.NOT_FOUND, b'Not found.\n')
        response = _response(HTTPStatus.OK, self._page, 'text/html', 'gzip')
        if self._token:
            # The page removes the token from its address; reloads and the stream use the cookie.
            response.headers['Set-Cookie'] = \
                f'{self._cookie}={self._token}; HttpOnly; SameSite=Strict'
        return response

    @property
    def _cookie(self) -> str:
        """Name of the cookie with the token. Servers on other ports receive it too."""
        return f'mag_tracking_{self.port}'

    def _tokens_of(self, request: Request, query: str) -> list[str]:
        """Tokens in the query and in the cookies of a request."""
        pairs = [part.strip().partition('=')
                 for line in request.headers.get_all('Cookie') for part in line.split(';')]
        return [*parse_qs(query).get('token', []),
                *(value for name, _, value in pairs if name == self._cookie)]

    def _refusal(self, host: str, origins: Sequence[str], tokens: Sequence[str]) -> str:
        """Reason for refusing a request; empty if the request is permitted."""
        if self._token:
            # Bytes outside ASCII are surrogates.
            if not any(secrets.compare_digest(token.encode('utf-8', 'surrogatepass'),
                                              self._token.encode('utf-8')) for token in tokens):
                return 'Missing or wrong token. Open the address that was printed at startup.\n'
        # DNS rebinding: a foreign page can make its own host name resolve to this address.
        elif not is_loopback(_host_name(host)):
            return 'This page is available on the local machine only.\n'
        if any(origin != host for origin in origins):
            return 'Connections from pages of other origins are refused.\n'
        return ''


def check_port(host: str, port: int) -> None:
    """Check that the page can be served on a port; raises DeviceError if it cannot be opened."""
    _open_socket(host, port).close()


def is_loopback(host: str) -> bool:
    """Whether a host name or address is a loopback address."""
    if host == 'localhost':
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _host_name(host: str) -> str:
    """Host name or address of a Host header, without the port; empty if the header is invalid."""
    try:
        return urlsplit(f'//{host}').hostname or ''
    except ValueError:
        return ''


def _parsed_address(text: str) -> SplitResult | None:
    """Parts of an address; None if it is malformed."""
    try:
        parts = urlsplit(text)
        # The port is parsed on access.
        _ = parts.port
    except ValueError:
        return None
    return parts


def _is_origin(parts: SplitResult | None) -> bool:
    """Whether the value of an Origin header is an origin, or "null", which a page without has."""
    return parts is not None and (bool(parts.scheme and parts.netloc) or parts.geturl() == 'null')


def _buffered_bytes(viewer: ServerConnection) -> int:
    return viewer.transport.get_write_buffer_size()


def _open_socket(host: str, port: int) -> socket.socket:
    """Open a listening socket; raise DeviceError if this fails."""
    if not 0 <= port <= MAX_PORT:
        raise DeviceError(f'the live page cannot be served on port {port}: expected a number from '
                          f'0 to {MAX_PORT}')
    try:
        family, _, _, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        return socket.create_server(address[:2], family=family, backlog=64)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, 'strerror', None) or str(error)
        raise DeviceError(f'the live page cannot be served on {host} port {port}: {reason}; '
                          'check the address or choose another port') from error


def _response(status: HTTPStatus, body: bytes, media_type: str = 'text/plain',
              encoding: str = '') -> Response:
    headers = Headers({
        'Content-Type': f'{media_type}; charset=utf-8', 'Content-Length': str(len(body)),
        'Cache-Control': 'no-store', 'Referrer-Policy': 'no-referrer', 'Connection': 'close',
        'X-Content-Type-Options': 'nosniff', 'X-Frame-Options': 'DENY'})
    if encoding:
        headers['Content-Encoding'] = encoding
    return Response(status.value, status.phrase, headers, body)
