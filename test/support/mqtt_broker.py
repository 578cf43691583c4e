"""Real MQTT broker (mosquitto) and scripted MQTT broker for tests."""

import base64
import hashlib
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import threading
import time
from contextlib import closing, suppress

import pytest

CONNECTED = bytes([0x20, 2, 0, 0])
"""CONNACK packet that accepts the connection."""


def free_port(kind=socket.SOCK_STREAM):
    """Find a free port outside the range that the kernel assigns automatically."""
    while True:
        port = random.randrange(20000, 32000)
        with closing(socket.socket(socket.AF_INET, kind)) as probe, suppress(OSError):
            probe.bind(('127.0.0.1', port))
            return port


def executable(name):
    """Path of a program of mosquitto, which `make test` installs; skips the test if missing."""
    path = shutil.which(name, path='/usr/sbin:/usr/bin:/usr/local/sbin:/usr/local/bin')
    if not path:
        pytest.skip(f'{name} is not installed: sudo apt install mosquitto')
    return path


class Broker:
    """Mosquitto on a fixed port; `lines` extend its configuration."""

    def __init__(self, folder, *lines):
        self.port = free_port()
        self._folder, self._process = folder, None
        self._config = folder / 'mosquitto.conf'
        self._config.write_text('\n'.join([
            f'listener {self.port} 127.0.0.1', 'user root', 'persistence false',
            'allow_anonymous true', 'max_queued_messages 0', *lines]) + '\n')

    def __enter__(self):
        return self.start()

    def __exit__(self, *_):
        self.kill()

    def start(self):
        """Start the broker, and wait until it listens."""
        with open(self._folder / 'mosquitto.log', 'ab') as log:
            self._process = subprocess.Popen([executable('mosquitto'), '-c', self._config],
                                             stdout=log, stderr=log)
        end = time.monotonic() + 10.0
        while time.monotonic() < end and self._process.poll() is None:
            with suppress(OSError), closing(socket.create_connection(('127.0.0.1', self.port))):
                return self
            time.sleep(0.01)
        self.kill()
        raise AssertionError(f'mosquitto did not start:\n{self.log()}')

    def log(self):
        """Output of the broker so far."""
        return (self._folder / 'mosquitto.log').read_text()

    def kill(self):
        """Kill the broker without closing its connections; may be called twice."""
        self._process.kill()
        self._process.wait(timeout=10)

    def freeze(self):
        """Suspend the broker: connections remain open, but it does not answer."""
        self._process.send_signal(signal.SIGSTOP)


def password_lines(folder, user, password):
    """Configuration lines of a broker that admits only `user`."""
    path = folder / 'passwords'
    path.touch(mode=0o600)
    subprocess.run([executable('mosquitto_passwd'), '-b', path, user, password], check=True,
                   capture_output=True)
    return [f'password_file {path}', 'allow_anonymous false']


def subscription_lines(folder, user, password, pattern):
    """Configuration lines of a broker that permits `user` to subscribe only to `pattern`."""
    executable('mosquitto')
    salt = b'twelve bytes'
    hashed = hashlib.pbkdf2_hmac('sha512', password.encode(), salt, 101)
    plugin = next((p for p in ('/usr/lib/x86_64-linux-gnu', '/usr/lib/aarch64-linux-gnu',
                               '/usr/lib')
                   if os.path.exists(f'{p}/mosquitto_dynamic_security.so')), None)
    assert plugin, 'mosquitto has no mosquitto_dynamic_security.so, which the tests need'
    path = folder / 'dynamic-security.json'
    path.write_text(json.dumps({
        'defaultACLAccess': {'publishClientSend': True, 'publishClientReceive': True,
                             'subscribe': False, 'unsubscribe': True},
        'clients': [{'username': user, 'password': base64.b64encode(hashed).decode(),
                     'salt': base64.b64encode(salt).decode(), 'iterations': 101,
                     'roles': [{'rolename': 'reader'}]}],
        'groups': [],
        'roles': [{'rolename': 'reader', 'acls': [
            {'acltype': 'subscribePattern', 'topic': pattern, 'priority': 0, 'allow': True}]}]}))
    return [f'plugin {plugin}/mosquitto_dynamic_security.so', f'plugin_opt_config_file {path}',
            'allow_anonymous false']


def certificate(folder):
    """Create a self-signed certificate of localhost; return the paths of certificate and key."""
    cert, key = folder / 'cert.pem', folder / 'key.pem'
    subprocess.run(['openssl', 'req', '-x509', '-newkey', 'rsa:2048', '-nodes', '-days', '2',
                    '-subj', '/CN=localhost', '-addext', 'subjectAltName=DNS:localhost',
                    '-keyout', key, '-out', cert], check=True, capture_output=True)
    return cert, key


class ScriptedBroker:
    """Broker that accepts one connection, and answers each message with the next of `responses`."""

    def __init__(self, *responses):
        self._responses = responses
        self._server = socket.create_server(('127.0.0.1', 0))
        self.port = self._server.getsockname()[1]
        self.received = []
        self._connection = None
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self.hang_up()
        self._thread.join(timeout=10.0)
        assert not self._thread.is_alive()

    def hang_up(self):
        """Close the connection, and accept no further connection."""
        self._server.close()
        if self._connection is not None:
            with suppress(OSError):
                self._connection.shutdown(socket.SHUT_RDWR)

    def _serve(self):
        self._connection = self._server.accept()[0]
        self._server.close()
        with suppress(OSError), closing(self._connection):
            for response in self._responses:
                self.received.append(self._connection.recv(65536))
                self._connection.sendall(
                    response(self.received[-1]) if callable(response) else response)
            while message := self._connection.recv(65536):
                self.received.append(message)


def granted(subscribe, *codes):
    """SUBACK packet for the SUBSCRIBE packet `subscribe`, one code per filter (0x80 refuses)."""
    return bytes([0x90, 2 + len(codes or (0,)), *subscribe[2:4], *(codes or (0,))])


def publish_packet(topic, payload, flags=0):
    """PUBLISH packet with QoS 0; `flags` are the low four bits of the first byte."""
    body = len(topic).to_bytes(2, 'big') + topic + payload
    assert len(body) < 128
    return bytes([0x30 | flags, len(body)]) + body
