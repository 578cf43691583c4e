"""Server of the live page: slow and disconnected viewers, access control and errors."""

import json
import socket
import time
import urllib.error
import urllib.request
from contextlib import contextmanager
from dataclasses import replace

import pytest
from websockets.exceptions import ConnectionClosedError, InvalidStatus
from websockets.sync.client import connect

from mag_tracking.errors import DeviceError
from mag_tracking.records import FieldFrame
from mag_tracking.web.page_server import PageServer
from support.browser import Page as Opened
from support.browser import needs_browser
from support.live_records import feed, poses

MAX_S = 240.0
"""[s] Time limit for any event, even on a slow and busy machine."""


def messages_until(url, until, seconds=MAX_S):
    """Messages received by a viewer up to the first message for which `until(message)` is true."""
    out = []
    with connect(url.replace('http', 'ws') + 'stream', max_size=None) as viewer:
        end = time.monotonic() + seconds
        while not (out and until(out[-1])):
            out.append(json.loads(viewer.recv(max(0.1, end - time.monotonic()))))
    return out


def test_ten_viewers_get_all_poses_although_another_disconnects(scene, server, records):
    urls = [server.url.replace('http', 'ws') + 'stream'] * 10
    viewers = [connect(url, max_size=None) for url in urls]
    disconnected = connect(urls[0], max_size=None)
    feed(scene, records[:len(records) // 2])
    disconnected.socket.close()
    feed(scene, records[len(records) // 2:])
    expected = [p.stamp_ns for p in poses(records)]
    for viewer in viewers:
        n = 0
        while n < len(expected):
            message = json.loads(viewer.recv(MAX_S))
            for track in message.get('tracks', message.get('scene', {}).get('tracks', ())):
                n += len(track['doubts'])
        assert n == len(expected)
        viewer.close()


def test_a_slow_viewer_gets_the_complete_scene_later(scene, server, records, monkeypatch):
    """The buffer is bounded, other viewers are served, and the slow viewer gets all poses."""
    # On a busy machine, the viewer of this test may read late.
    monkeypatch.setattr('mag_tracking.web.page_server.LAG_TIMEOUT_S', 600.0)
    with reading_viewer(server) as quick, unreading_viewer(server) as slow:
        stamp = publish_until(scene, records, lambda: server.n_lagged, quick)
        assert read_until(slow, b'"type": "scene"', 2) == 2
        # The scene with all poses is followed by new rows.
        assert read_until(slow, f'"latest_ns": "{publish(scene, records, stamp)}"'.encode()) == 1


def reading_viewer(server):
    """Connect a viewer that reads its messages."""
    return connect(server.url.replace('http', 'ws') + 'stream', max_size=None)


def read_until(raw, pattern, n=1, seconds=MAX_S):
    """Read from a socket until `pattern` has occurred at least `n` times; return its number of
    occurrences."""
    found, rest = 0, b''
    raw.settimeout(seconds)
    while found < n:
        part = raw.recv(1 << 20)
        assert part, 'the server has closed the connection'
        text = rest + part
        found += text.count(pattern)
        rest = text[-(len(pattern) - 1):]
    return found


def publish(scene, records, stamp, n=1):
    """Publish `n` poses after `stamp` [ns]; return the timestamp of the last pose."""
    template = [r for r in records if isinstance(r, FieldFrame)][-1]
    for _ in range(n):
        stamp += 10_000_000
        scene.add_frame(replace(template, stamp_ns=stamp))
        scene.add_track(replace(poses(records)[30], stamp_ns=stamp))
    return stamp


def publish_until(scene, records, condition, quick, seconds=MAX_S):
    """Publish poses, which `quick` receives, until `condition()`; return the last timestamp."""
    stamp, end = records[-1].stamp_ns, time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        stamp = publish(scene, records, stamp, 400)
        # The fast viewer is served meanwhile.
        quick.recv(MAX_S)
    return stamp


@contextmanager
def unreading_viewer(server):
    """Connect a viewer that completes the handshake and reads only on request."""
    with socket.socket() as raw:
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
        raw.connect(('127.0.0.1', server.port))
        raw.sendall((f'GET /stream HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n'
                     'Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n'
                     'Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n').encode())
        yield raw


def test_a_viewer_that_never_reads_is_disconnected(scene, records, monkeypatch):
    monkeypatch.setattr('mag_tracking.web.page_server.LAG_TIMEOUT_S', 0.5)
    with PageServer(scene, port=0) as server, reading_viewer(server) as quick, \
            unreading_viewer(server):
        stamp = publish_until(scene, records, lambda: server.n_lagged, quick)
        end = time.monotonic() + MAX_S
        while server.n_viewers > 1:
            stamp = publish(scene, records, stamp)
            quick.recv(MAX_S)
            assert time.monotonic() < end


def test_a_scene_larger_than_the_buffer_is_followed_by_rows(scene, server, records):
    """A new viewer of a long session receives the complete scene, several megabytes, only once."""
    with reading_viewer(server) as quick:
        stamp = publish(scene, records, records[-1].stamp_ns, 7_900)
        while f'"latest_ns": "{stamp}"' not in quick.recv(MAX_S):
            pass
    with unreading_viewer(server) as slow:
        received, next_read = b'', time.monotonic()
        slow.settimeout(MAX_S)
        while b'"type": "rows"' not in received[-300_000:]:
            # The viewer reads so slowly that the server sees a full buffer.
            next_read += 0.02
            time.sleep(max(0.0, next_read - time.monotonic()))
            part = slow.recv(100_000)
            assert part
            received += part
            stamp = publish(scene, records, stamp)
        assert received.count(b'"type": "scene"') == 1
        assert server.n_lagged == 0 and len(received) > 1_500_000


def test_the_number_of_viewers_is_limited(scene, monkeypatch):
    monkeypatch.setattr('mag_tracking.web.page_server.MAX_VIEWERS', 2)
    with PageServer(scene, port=0) as server:
        url = server.url.replace('http', 'ws') + 'stream'
        viewers = [connect(url) for _ in range(2)]
        for viewer in viewers:
            viewer.recv(MAX_S)
        third = connect(url)
        with pytest.raises(ConnectionClosedError) as closed:
            third.recv(MAX_S)
        assert closed.value.rcvd.code == 1013
        for viewer in viewers:
            viewer.close()


def test_an_error_of_the_scene_is_reported_and_does_not_stop_the_server(caplog):
    class Broken:
        def snapshot(self):
            return ['{"type": "health", "notes": [], "tables": []}']

        def updates(self):
            raise ValueError('broken')

    with PageServer(Broken(), port=0) as server:
        messages = messages_until(server.url, lambda m: m['type'] == 'fault')
        assert messages[-1]['text'] == 'ValueError: broken'
        messages_until(server.url, lambda m: m['type'] == 'fault')
        assert server.is_serving
    assert len([r for r in caplog.records if 'live page' in r.message]) == 1
    assert not server.is_serving


def test_a_looped_bag_starts_a_new_scene(scene, server, records):
    feed(scene, records)
    messages = messages_until(server.url, lambda m: m['type'] == 'scene')
    assert messages[-1]['type'] == 'scene'
    with connect(server.url.replace('http', 'ws') + 'stream', max_size=None) as viewer:
        feed(scene, records[:50])
        while True:
            message = json.loads(viewer.recv(MAX_S))
            if message['type'] == 'scene' and message['scene']['tracks'] == []:
                break
        begin = [r for r in records[:50] if isinstance(r, FieldFrame)][0].stamp_ns
        assert int(message['scene']['begin_ns']) == begin


def test_an_unusable_address_is_reported(scene, server):
    with pytest.raises(DeviceError, match=f'port {server.port}: '):
        PageServer(scene, port=server.port)
    for port in (-1, 70000):
        with pytest.raises(DeviceError, match=str(port)):
            PageServer(scene, port=port)
    with pytest.raises(DeviceError, match='no.such.host.invalid'):
        PageServer(scene, host='no.such.host.invalid', port=0)


def status_of(url, **headers):
    request = urllib.request.Request(url, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=MAX_S) as response:
            return response.status
    except urllib.error.HTTPError as error:
        return error.code


def test_without_a_token_only_local_requests_are_served(server):
    """Requests with another host name or origin, such as those of a foreign page, are refused."""
    assert 'token' not in server.url
    assert status_of(server.url) == 200
    assert status_of(server.url + 'etc/passwd') == 404
    assert status_of(server.url, Host='evil.example') == 403
    assert status_of(server.url, Host='[::1') == 403
    stream = server.url.replace('http', 'ws') + 'stream'
    with pytest.raises(InvalidStatus) as refused:
        connect(stream, origin='http://evil.example')
    assert refused.value.response.status_code == 403
    assert status_of(server.url, Origin='null') == 403
    connect(stream, origin=server.url.rstrip('/')).close()


def test_remote_requests_require_the_token(scene):
    with PageServer(scene, host='0.0.0.0', port=0) as server:
        address, token = server.url.split('?token=')
        assert socket.gethostname() in address
        address = address.replace(socket.gethostname(), '127.0.0.1')
        assert len(token) > 20
        for wrong in ('', '?token=', '?token=x', f'?token={token}x', '?token=%C3%A9'):
            assert status_of(address + wrong) == 403
            with pytest.raises(InvalidStatus):
                connect(address.replace('http', 'ws') + 'stream' + wrong)
        assert status_of(f'{address}?token={token}') == 200
        connect(f'{address.replace("http", "ws")}stream?token={token}').close()


def response_to(server, path, headers):
    """Response to a GET request with the given header lines."""
    with socket.create_connection(('127.0.0.1', server.port)) as raw:
        raw.sendall('\r\n'.join([f'GET {path} HTTP/1.1', *headers, '', '']).encode('latin-1'))
        raw.settimeout(MAX_S)
        return b''.join(iter(lambda: raw.recv(4096), b'')).decode('latin-1')


@pytest.mark.parametrize('path, headers', [
    ('/', ['Host: 127.0.0.1', 'Host: 127.0.0.1']), ('/', []),
    ('/', ['Host: 127.0.0.1', 'Origin: http://[']),
    ('/', ['Host: 127.0.0.1', 'Origin: http://127.0.0.1', 'Origin: http://evil.example']),
    ('/stream', ['Host: 127.0.0.1', 'Origin: http://[::1']),
    ('/', ['Host: 127.0.0.1', 'Origin: garbage']),
    ('/', ['Host: 127.0.0.1', 'Origin: http://127.0.0.1:port']), ('page', ['Host: 127.0.0.1']),
    ('//[', ['Host: 127.0.0.1']), ('http://[x/', ['Host: 127.0.0.1'])])
def test_malformed_headers_and_addresses_are_bad_requests(server, caplog, path, headers):
    response = response_to(server, path, headers)
    assert response.startswith('HTTP/1.1 400 ')
    assert 'server:' not in response.lower()
    assert caplog.records == []


@pytest.mark.parametrize('path, cookie', [('/?token=\xff', 'x'), ('/', 'mag_tracking_{}=\xe9')])
def test_a_token_outside_ascii_is_wrong(scene, path, cookie):
    with PageServer(scene, host='0.0.0.0', port=0) as server:
        headers = ['Host: x', f'Cookie: {cookie.format(server.port)}']
        assert response_to(server, path, headers).startswith('HTTP/1.1 403 ')


@needs_browser
def test_the_token_leaves_the_address_bar(chromium, scene, records):
    """The page is connected, and can be reloaded, although its address has no token."""
    with PageServer(scene, host='0.0.0.0', port=0) as server:
        feed(scene, records)
        address, token = server.url.replace(socket.gethostname(), '127.0.0.1').split('?')
        page = Opened(chromium, f'{address}?{token}')
        for _ in range(2):
            page.wait('magTracking.connected && magTracking.drawn > 0')
            assert page.page.url == address
            page.page.reload()
        assert page.page_errors == []
        page.page.close()


def test_responses_name_no_software_versions(server):
    with urllib.request.urlopen(server.url, timeout=MAX_S) as response:
        assert 'Server' not in response.headers


def test_invalid_requests_do_not_stop_the_server(server):
    for text in (b'\x16\x03\x01garbage\r\n\r\n', b'POST / HTTP/1.1\r\n\r\n', b'', b'A' * 100_000):
        with socket.create_connection(('127.0.0.1', server.port)) as raw:
            try:
                raw.sendall(text)
                raw.shutdown(socket.SHUT_WR)
                raw.recv(1000)
            except OSError:
                continue
    assert status_of(server.url) == 200
