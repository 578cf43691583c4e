"""MQTT: subscriptions at a broker; each message is a chunk whose source is its topic.

The session is a clean one: what was published while nobody was connected is not
delivered later, as its time of arrival would say nothing. For the same reason
retained messages are skipped unless they are asked for, and the oldest of the queue
go first where the reader is too slow.

A lost connection is an error and stays one until `open` is called again; the network
loop runs in a thread of its own, which takes the time of arrival.

Sources: MQTT 3.1.1, OASIS Standard (connect return codes 3.2.2.3, failure in SUBACK
3.9.3, flags DUP and RETAIN 3.3.1, client identifiers 3.1.3.1); paho-mqtt 2 with
CallbackAPIVersion.VERSION2.
"""

import secrets
import socket
import ssl
import threading
import time
from collections import Counter, deque
from dataclasses import dataclass
from typing import Any

from paho.mqtt import client as paho
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

from mag_tracking.drivers.reading import Chunk
from mag_tracking.errors import DeviceError, SettingsError
from mag_tracking.settings import param

CLOSE_WAIT_S = 0.1
"""How long the thread may sleep before it sees that it is to end."""


@dataclass(frozen=True)
class MqttSettings:
    """Settings of the subscriptions at an MQTT broker."""

    host: str = param('localhost', 'Name or address of the broker.')
    port: int = param(1883, 'Port of the broker; with TLS it is usually 8883.', '', (1, 65535))
    topics: tuple[str, ...] = param(
        ('',), 'Topic filters to subscribe to, such as sensors/+/mag; they must be set.')
    qos: int = param(0, 'Quality of service of the subscriptions.', '', (0, 2))
    username: str = param('', 'User name; empty = none.')
    password_file: str = param('', 'File whose first line is the password; empty = none.')
    tls: bool = param(False, 'The connection is encrypted and the broker proves who it is.')
    ca_file: str = param('', 'Certificates (PEM) of who may vouch for the broker; empty = those '
                         'of the system.')
    client_id: str = param('', 'Client identifier, one for each connection to the broker; '
                           'empty = a random one.')
    keepalive_s: int = param(
        10, 'A connection on which nothing comes is tried after this time, and given up after '
        'twice this time.', 's', (1, 65535))
    connect_timeout_s: float = param(
        5.0, 'Longest time for the connection, and again for the broker\'s answers.',
        's', (0.1, 600.0))
    queue: int = param(
        10000, 'Messages held at most for the reader; with more the oldest are dropped.',
        '', (1, 10_000_000))
    max_length: int = param(65536, 'A longer message is dropped.', 'bytes', (1, 1 << 28))
    retained: bool = param(
        False, 'Retained messages, which were published at some time before, are handed on too.')


class _Certificates(ssl.SSLContext):
    """Shakes hands at once: then the socket of a failure is closed, which paho leaves open."""

    def wrap_socket(self, sock: socket.socket, *args: Any, **kwargs: Any) -> ssl.SSLSocket:
        """As in the base class."""
        return super().wrap_socket(sock, *args, **(kwargs | {'do_handshake_on_connect': True}))


class MqttTopics:
    """Transport over MQTT; see `reading.Transport`.

    `counts` also has the messages that the broker delivered again ('messages with the dup
    flag'), which are handed on.

    Raises SettingsError where no topic is named, a password has no user, or there are
    certificates but no TLS.
    """

    SETTINGS = MqttSettings
    whole = True

    def __init__(self, settings: MqttSettings) -> None:
        s = settings
        if '' in s.topics:
            raise SettingsError('topics: the topic filters to subscribe to are needed')
        if s.password_file and not s.username:
            raise SettingsError('password_file: a password needs a username')
        if s.ca_file and not s.tls:
            raise SettingsError('ca_file: certificates are of no use while tls is false')
        self.counts: Counter[str] = Counter()
        self._settings = s
        self._name = f'MQTT broker {s.host}:{s.port}'
        # Guards all below; tells the reader of messages and of the end.
        self._news = threading.Condition()
        self._queue: deque[Chunk] = deque()
        self._came: Counter[str] = Counter()
        self._thread: threading.Thread | None = None
        self._ready = self._closing = False
        self._lost = f'{self._name}: is not open'

    @property
    def settings(self) -> MqttSettings:
        """As they were given."""
        return self._settings

    def open(self) -> None:
        """Connect and subscribe; raises DeviceError that names the broker and what it said."""
        self.close()
        client = self._client()
        with self._news:
            self._count()
            self._ready = self._closing = False
        self._connect(client)
        with self._news:
            # If it was closed meanwhile, it stays so.
            self._lost = self._lost if self._closing else ''
        self._thread = threading.Thread(target=self._run, args=(client,), daemon=True,
                                        name=f'mqtt {self._settings.host}')
        self._thread.start()
        with self._news:
            answered = self._news.wait_for(lambda: self._ready or self._lost,
                                           self._settings.connect_timeout_s)
            lost = self._lost
        if not answered or lost:
            self.close()
            raise DeviceError(lost or f'{self._name}: no answer within '
                              f'{self._settings.connect_timeout_s:g} s; is that a broker?')

    def _client(self) -> paho.Client:
        """A client that is ready to connect; raises DeviceError where a file is missing."""
        s = self._settings
        client = paho.Client(
            CallbackAPIVersion.VERSION2, s.client_id or f'mag_tracking_{secrets.token_hex(4)}',
            clean_session=True, protocol=paho.MQTTv311, reconnect_on_failure=False)
        client.connect_timeout = s.connect_timeout_s
        client.on_connect, client.on_subscribe = self._on_connect, self._on_subscribe
        client.on_message, client.on_disconnect = self._on_message, self._on_disconnect
        if s.username:
            client.username_pw_set(s.username, self._password())
        if s.tls:
            client.tls_set_context(self._certificates())
        return client

    def _certificates(self) -> ssl.SSLContext:
        """Who may vouch for the broker."""
        path = self._settings.ca_file
        # Such a context demands a certificate, and that it is of the host.
        certificates = _Certificates(ssl.PROTOCOL_TLS_CLIENT)
        try:
            if path:
                certificates.load_verify_locations(path)
            else:
                certificates.load_default_certs()
        except OSError as error:
            raise DeviceError(f'{self._name}: the certificates in ca_file {path} cannot be read: '
                              f'{error.strerror or error}') from error
        return certificates

    def _password(self) -> str | None:
        """First line of the password file; None where there is no file."""
        path = self._settings.password_file
        if not path:
            return None
        try:
            with open(path, encoding='utf-8') as file:
                password = file.readline().rstrip('\n')
        except (OSError, UnicodeDecodeError) as error:
            raise DeviceError(f'{self._name}: password_file {path} cannot be read: '
                              f'{getattr(error, "strerror", error)}') from error
        if not password:
            raise DeviceError(f'{self._name}: the first line of password_file {path} is empty')
        return password

    def _connect(self, client: paho.Client) -> None:
        """Connect, and shake hands where there is TLS."""
        s = self._settings
        try:
            client.connect(s.host, s.port, s.keepalive_s)
        except ssl.SSLError as error:
            raise DeviceError(f'{self._name}: TLS failed: {error}') from error
        except ConnectionRefusedError as error:
            raise DeviceError(f'{self._name}: nobody listens there') from error
        except (OSError, ValueError) as error:
            raise DeviceError(f'{self._name}: cannot connect: {error}') from error

    def _run(self, client: paho.Client) -> None:
        """The network loop; all that is done with the client from here on, is done here."""
        try:
            said = MQTTErrorCode.MQTT_ERR_SUCCESS
            while said == MQTTErrorCode.MQTT_ERR_SUCCESS and not self._closing:
                said = client.loop(CLOSE_WAIT_S)
            reason = paho.error_string(said)
            client.disconnect()
        # Whatever ends the thread ends the connection, and must not do so in silence.
        except Exception as error:
            reason = f'{type(error).__name__}: {error}'
        self._lose(reason if self._ready else f'{reason} Is that a broker, and does it expect tls '
                   f'to be {str(self._settings.tls).lower()}?')

    def _lose(self, reason: str) -> None:
        """The connection has ended; the first reason is the one that counts."""
        with self._news:
            self._lost = self._lost or f'{self._name}: {reason}'
            self._news.notify_all()

    def _on_connect(self, client: paho.Client, _: Any, flags: paho.ConnectFlags,
                    reason_code: ReasonCode, properties: Properties | None) -> None:
        """The broker has answered."""
        if reason_code.is_failure:
            self._lose(f'refused the connection: {reason_code}')
            return
        try:
            client.subscribe([(topic, self._settings.qos) for topic in self._settings.topics])
        except ValueError as error:
            self._lose(f'topics {self._settings.topics}: {error}')

    def _on_subscribe(self, client: paho.Client, _: Any, mid: int,
                      reason_codes: list[ReasonCode], properties: Properties | None) -> None:
        """The broker has said which subscriptions it grants."""
        refused = [topic for topic, code in zip(self._settings.topics, reason_codes, strict=True)
                   if code.is_failure]
        if refused:
            self._lose(f'refused the subscription to {", ".join(refused)}')
            return
        with self._news:
            self._ready = True
            self._news.notify_all()

    def _on_message(self, client: paho.Client, _: Any, message: paho.MQTTMessage) -> None:
        """Put a message into the queue, or count it."""
        arrival_ns = time.monotonic_ns()
        with self._news:
            if message.dup:
                self._came['messages with the dup flag'] += 1
            cause, topic = self._objection(message)
            if cause:
                self._came[cause] += 1
                return
            if len(self._queue) == self._settings.queue:
                self._queue.popleft()
                self._came['messages dropped, queue full'] += 1
            self._queue.append(Chunk(arrival_ns, bytes(message.payload), topic))
            self._news.notify_all()

    def _objection(self, message: paho.MQTTMessage) -> tuple[str, str]:
        """(why a message is not handed on, or '', and its topic)."""
        try:
            topic = message.topic
        except UnicodeDecodeError:
            return 'messages whose topic is no text', ''
        if message.retain and not self._settings.retained:
            return 'retained messages skipped', topic
        if len(message.payload) > self._settings.max_length:
            return 'messages that were too long', topic
        return ('' if message.payload else 'empty messages'), topic

    def _on_disconnect(self, client: paho.Client, _: Any, flags: paho.DisconnectFlags,
                       reason_code: ReasonCode, properties: Properties | None) -> None:
        """Only the keep-alive is known here alone; `_run` knows better of all else."""
        if reason_code.getName() == 'Keep alive timeout':
            self._lose(f'has not answered for {2 * self._settings.keepalive_s} s')

    def read(self, timeout_s: float) -> list[Chunk]:
        """All messages that have come, as soon as there is one.

        Returns [] where nothing comes in time, or where `close` is called meanwhile.
        Raises DeviceError where the connection is lost and all messages were handed out.
        """
        with self._news:
            if self._lost and not self._queue:
                raise DeviceError(self._lost)
            self._news.wait_for(lambda: self._queue or self._lost, timeout_s)
            chunks = list(self._queue)
            self._queue.clear()
            # Counted in the reader's thread, as nobody may change what it looks at.
            self._count()
            if not chunks and self._lost and not self._closing:
                raise DeviceError(self._lost)
            return chunks

    def _count(self) -> None:
        """Add what was counted since last time."""
        self.counts += self._came
        self._came.clear()

    def close(self) -> None:
        """Leave the broker and end the thread; a `read` in another thread returns."""
        with self._news:
            self._closing = True
            self._lost = f'{self._name}: is not open'
        # The end of the thread wakes whoever waits.
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        with self._news:
            self._queue.clear()
