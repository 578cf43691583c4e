"""Transport over MQTT. Each message is a chunk, whose source is the topic.

The session is clean: messages published while the connection was lost are not delivered later,
because their arrival would not indicate when they were measured. For the same reason, retained
messages are skipped by default, and if the reader is too slow, the oldest messages of the queue are
dropped first.

After the connection is lost, `read` raises an error until `open` is called again. The network loop
runs in its own thread, which records the arrival times.

Sources: MQTT 3.1.1, OASIS Standard (connect return codes 3.2.2.3, failure in SUBACK 3.9.3, flags
DUP and RETAIN 3.3.1, client identifiers 3.1.3.1); paho-mqtt 2 with CallbackAPIVersion.VERSION2.
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
from mag_tracking.drivers.transports.polled import CLOSE_WAIT_S
from mag_tracking.errors import DeviceError, SettingsError
from mag_tracking.settings import param


@dataclass(frozen=True)
class MqttSettings:
    """Settings of the subscriptions to topics of an MQTT broker."""

    host: str = param('localhost', 'Host name or address of the broker.')
    port: int = param(1883, 'Port of the broker, usually 8883 with TLS.', '', (1, 65535))
    topics: tuple[str, ...] = param(
        ('',), 'Topic filters to subscribe to, such as sensors/+/mag; required.')
    qos: int = param(0, 'Quality of service of the subscriptions.', '', (0, 2))
    username: str = param('', 'User name; empty if the broker requires none.')
    password_file: str = param(
        '', 'File whose first line is the password; empty if the broker requires none.')
    tls: bool = param(
        False, "Whether to encrypt the connection and verify the broker's certificate.")
    ca_file: str = param(
        '', 'PEM file with trusted CA certificates. If it is empty, the system trust store is '
        'used.')
    client_id: str = param(
        '', 'Client identifier, unique for each connection to the broker; empty selects a random '
        'identifier.')
    keepalive_s: int = param(
        10, 'Keep-alive interval. The connection is closed if the broker does not answer for twice '
        'this interval.', 's', (1, 65535))
    connect_timeout_s: float = param(
        5.0, "Timeout for connecting to the broker. The broker must acknowledge the connection "
        'and the subscriptions within the same time again.', 's', (0.1, 600.0))
    queue: int = param(
        10000, 'Maximum number of messages in the queue. If the queue is full, its oldest message '
        'is dropped.', '', (1, 10_000_000))
    max_length: int = param(
        65536, 'Maximum length of a message; longer messages are dropped.', 'bytes', (1, 1 << 28))
    retained: bool = param(
        False, 'Whether to accept retained messages, whose time of publication is unknown.')


class _TlsContext(ssl.SSLContext):
    """TLS context with an immediate handshake; a failed handshake closes the socket."""

    def wrap_socket(self, sock: socket.socket, *args: Any, **kwargs: Any) -> ssl.SSLSocket:
        return super().wrap_socket(sock, *args, **(kwargs | {'do_handshake_on_connect': True}))


class MqttTopics:
    """Messages of MQTT topics as a `reading.Transport`."""

    SETTINGS = MqttSettings
    is_message_oriented = True

    def __init__(self, settings: MqttSettings) -> None:
        s = settings
        if '' in s.topics:
            raise SettingsError('topics: set at least one topic filter, such as sensors/+/mag')
        if s.password_file and not s.username:
            raise SettingsError('password_file: a password requires a username')
        if s.ca_file and not s.tls:
            raise SettingsError('ca_file: certificates have no effect while tls is false')
        self.counts: Counter[str] = Counter()
        self.settings = s
        self._name = f'MQTT broker {s.host}:{s.port}'
        # Guards all attributes below; notifies the reader of messages and of a lost connection.
        self._changed = threading.Condition()
        self._queue: deque[Chunk] = deque()
        self._thread_counts: Counter[str] = Counter()
        self._thread: threading.Thread | None = None
        self._is_ready = self._closing = False
        self._loss = f'{self._name}: not open'

    def open(self) -> None:
        """Connect and subscribe."""
        self.close()
        client = self._client()
        with self._changed:
            self._add_thread_counts()
            self._is_ready = self._closing = False
        self._connect(client)
        with self._changed:
            # A `close` during the connection attempt has priority.
            self._loss = self._loss if self._closing else ''
        self._thread = threading.Thread(target=self._run, args=(client,), daemon=True,
                                        name=f'mqtt {self.settings.host}')
        self._thread.start()
        with self._changed:
            answered = self._changed.wait_for(lambda: self._is_ready or self._loss,
                                              self.settings.connect_timeout_s)
            lost = self._loss
        if not answered or lost:
            self.close()
            raise DeviceError(lost or f'{self._name}: no answer within '
                              f'{self.settings.connect_timeout_s:g} s; is it an MQTT broker?')

    def _client(self) -> paho.Client:
        s = self.settings
        client = paho.Client(
            CallbackAPIVersion.VERSION2, s.client_id or f'mag_tracking_{secrets.token_hex(4)}',
            clean_session=True, protocol=paho.MQTTv311, reconnect_on_failure=False)
        client.connect_timeout = s.connect_timeout_s
        client.on_connect, client.on_subscribe = self._on_connect, self._on_subscribe
        client.on_message, client.on_disconnect = self._on_message, self._on_disconnect
        if s.username:
            client.username_pw_set(s.username, self._password())
        if s.tls:
            client.tls_set_context(self._tls_context())
        return client

    def _tls_context(self) -> ssl.SSLContext:
        path = self.settings.ca_file
        # A context of this type requires a certificate that matches the host name.
        context = _TlsContext(ssl.PROTOCOL_TLS_CLIENT)
        try:
            if path:
                context.load_verify_locations(path)
            else:
                context.load_default_certs()
        except OSError as error:
            raise DeviceError(f'{self._name}: the certificates in ca_file {path} cannot be read: '
                              f'{error.strerror or error}') from error
        return context

    def _password(self) -> str | None:
        path = self.settings.password_file
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
        s = self.settings
        try:
            client.connect(s.host, s.port, s.keepalive_s)
        except ssl.SSLError as error:
            raise DeviceError(f'{self._name}: TLS failed: {error}') from error
        except ConnectionRefusedError as error:
            raise DeviceError(f'{self._name}: connection refused; check that the broker is '
                              'running') from error
        except (OSError, ValueError) as error:
            raise DeviceError(f'{self._name}: cannot connect: {error}') from error

    def _run(self, client: paho.Client) -> None:
        """Run the network loop. After `open`, only this thread uses the client."""
        try:
            status = MQTTErrorCode.MQTT_ERR_SUCCESS
            while status == MQTTErrorCode.MQTT_ERR_SUCCESS and not self._closing:
                status = client.loop(CLOSE_WAIT_S)
            reason = paho.error_string(status)
            client.disconnect()
        # Any error ends the thread and the connection, and must be reported to the reader.
        except Exception as error:
            reason = f'{type(error).__name__}: {error}'
        self._set_lost(reason if self._is_ready else
                       f'{reason} Check that it is an MQTT broker and that it expects tls: '
                       f'{str(self.settings.tls).lower()}')

    def _set_lost(self, reason: str) -> None:
        """Mark the connection as lost and wake the reader; only the first reason is stored."""
        with self._changed:
            self._loss = self._loss or f'{self._name}: {reason}'
            self._changed.notify_all()

    def _on_connect(self, client: paho.Client, _: Any, flags: paho.ConnectFlags,
                    reason_code: ReasonCode, properties: Properties | None) -> None:
        """Subscribe to the topics, or report that the broker has refused the connection."""
        if reason_code.is_failure:
            self._set_lost(f'connection refused: {reason_code}')
            return
        try:
            client.subscribe([(topic, self.settings.qos) for topic in self.settings.topics])
        except ValueError as error:
            self._set_lost(f'topics {self.settings.topics}: {error}')

    def _on_subscribe(self, client: paho.Client, _: Any, mid: int,
                      reason_codes: list[ReasonCode], properties: Properties | None) -> None:
        """Report that the broker has granted all subscriptions, or refused one of them."""
        refused = [topic for topic, code in zip(self.settings.topics, reason_codes, strict=True)
                   if code.is_failure]
        if refused:
            self._set_lost(f'subscription refused: {", ".join(refused)}')
            return
        with self._changed:
            self._is_ready = True
            self._changed.notify_all()

    def _on_message(self, client: paho.Client, _: Any, message: paho.MQTTMessage) -> None:
        arrival_ns = time.monotonic_ns()
        with self._changed:
            if message.dup:
                self._thread_counts['messages with the dup flag'] += 1
            cause, topic = self._rejection_cause(message)
            if cause:
                self._thread_counts[cause] += 1
                return
            if len(self._queue) == self.settings.queue:
                self._queue.popleft()
                self._thread_counts['messages dropped (queue full)'] += 1
            self._queue.append(Chunk(arrival_ns, bytes(message.payload), topic))
            self._changed.notify_all()

    def _rejection_cause(self, message: paho.MQTTMessage) -> tuple[str, str]:
        """Return (cause of rejection, topic); the cause is empty for a valid message."""
        try:
            topic = message.topic
        except UnicodeDecodeError:
            return 'messages whose topic is not UTF-8', ''
        if message.retain and not self.settings.retained:
            return 'retained messages skipped', topic
        if len(message.payload) > self.settings.max_length:
            return 'messages longer than max_length', topic
        return ('' if message.payload else 'empty messages'), topic

    def _on_disconnect(self, client: paho.Client, _: Any, flags: paho.DisconnectFlags,
                       reason_code: ReasonCode, properties: Properties | None) -> None:
        """Report a keep-alive timeout; `_run` reports all other causes in more detail."""
        if reason_code.getName() == 'Keep alive timeout':
            self._set_lost(f'no answer for {2 * self.settings.keepalive_s} s')

    def read(self, timeout_s: float) -> list[Chunk]:
        """Return the queued messages; wait only if the queue is empty.

        A lost connection is raised when all messages have been returned.
        """
        with self._changed:
            if self._loss and not self._queue:
                raise DeviceError(self._loss)
            self._changed.wait_for(lambda: self._queue or self._loss, timeout_s)
            chunks = list(self._queue)
            self._queue.clear()
            # Only the reader's thread changes `counts`, which it may be iterating over.
            self._add_thread_counts()
            if not chunks and self._loss and not self._closing:
                raise DeviceError(self._loss)
            return chunks

    def _add_thread_counts(self) -> None:
        self.counts += self._thread_counts
        self._thread_counts.clear()

    def close(self) -> None:
        """Disconnect and end the thread; a `read` in another thread returns."""
        with self._changed:
            self._closing = True
            self._loss = f'{self._name}: not open'
        # The end of the thread wakes a waiting reader.
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        with self._changed:
            self._queue.clear()
