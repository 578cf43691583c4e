"""MQTT transport with real and scripted brokers: delivery, losses, failures, TLS, closing."""

import os
import threading
import time
from dataclasses import replace

import pytest
from paho.mqtt import publish
from paho.mqtt.client import Client

from mag_tracking.drivers.transports import mqtt as mqtt_topics
from mag_tracking.drivers.transports.mqtt import MqttSettings, MqttTopics
from mag_tracking.errors import DeviceError, SettingsError
from support.counters import assert_counts
from support.mqtt_broker import (
    CONNECTED,
    Broker,
    ScriptedBroker,
    certificate,
    free_port,
    granted,
    password_lines,
    publish_packet,
    subscription_lines,
)

SETTINGS = MqttSettings(host='127.0.0.1', topics=('mag/#',))


@pytest.fixture(scope='module')
def broker(tmp_path_factory):
    with Broker(tmp_path_factory.mktemp('broker'), 'log_type all') as running:
        yield running


@pytest.fixture
def topics(monkeypatch):
    """Factory of `MqttTopics`, which are closed at the end of the test."""
    monkeypatch.setattr(mqtt_topics, 'CLOSE_WAIT_S', 0.01)
    transports = []

    def make(port, **changes):
        transports.append(MqttTopics(replace(SETTINGS, port=port, **changes)))
        return transports[-1]

    yield make
    for transport in transports:
        transport.close()
    assert not connection_threads()


def connection_threads():
    """Network threads of all connections."""
    return {t for t in threading.enumerate() if t.name.startswith('mqtt ')}


def send(port, messages, **kwargs):
    publish.multiple([{'topic': topic, 'payload': payload, **kwargs}
                      for topic, payload in messages], '127.0.0.1', port)


def read_chunks(transport, n, seconds=60.0):
    """Read until `n` chunks have arrived or the time limit is reached."""
    chunks, end = [], time.monotonic() + seconds
    while len(chunks) < n and time.monotonic() < end:
        chunks += transport.read(0.2)
    return chunks


def wait_until(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.005)
    assert condition()


def wait_for_messages(broker, client_id, n):
    """Wait until the broker has received `n` acknowledgements (QoS 1) from a client."""
    wait_until(lambda: broker.log().count(f'Received PUBACK from {client_id} ') == n)


def open_error(transport):
    """Return the error message of `open`, which must fail in time and leave no thread."""
    before, start = connection_threads(), time.monotonic()
    with pytest.raises(DeviceError) as caught:
        transport.open()
    assert time.monotonic() - start < 2.0 * transport.settings.connect_timeout_s + 20.0
    assert connection_threads() <= before
    with pytest.raises(DeviceError, match='not open'):
        transport.read(0.0)
    assert str(caught.value).startswith(
        f'MQTT broker {transport.settings.host}:{transport.settings.port}: ')
    return str(caught.value)


@pytest.mark.parametrize('qos', [0, 1, 2])
def test_messages_arrive_complete_and_in_order_with_their_topic(broker, topics, qos):
    mqtt = topics(broker.port, qos=qos)
    mqtt.open()
    sent = [(f'mag/{i % 7}', bytes([i % 256]) * (1 + i % 90)) for i in range(1000)]
    before = time.monotonic_ns()
    send(broker.port, sent, qos=qos)
    chunks = read_chunks(mqtt, len(sent))
    assert [(c.source, c.data) for c in chunks] == sent
    arrivals = [c.arrival_ns for c in chunks]
    assert arrivals == sorted(arrivals)
    assert before < arrivals[0] and arrivals[-1] < time.monotonic_ns()
    assert not mqtt.counts
    assert mqtt.is_message_oriented


def test_only_subscribed_topics_are_received(broker, topics):
    mqtt = topics(broker.port, topics=('mag/a', 'mag/+/b'))
    mqtt.open()
    send(broker.port, [('mag/c', b'1'), ('mag/a', b'2'), ('other', b'3'), ('mag/x/b', b'4')])
    assert [(c.source, c.data) for c in read_chunks(mqtt, 2)] == [
        ('mag/a', b'2'), ('mag/x/b', b'4')]
    assert mqtt.read(0.1) == []


def test_read_returns_at_a_message_or_at_its_timeout(broker, topics):
    mqtt = topics(broker.port)
    mqtt.open()
    start = time.monotonic()
    assert mqtt.read(0.2) == []
    assert 0.2 <= time.monotonic() - start < 20.0
    timer = threading.Timer(0.2, send, (broker.port, [('mag/a', b'x')]))
    timer.start()
    start = time.monotonic()
    chunk, = mqtt.read(60.0)
    assert 0.15 < time.monotonic() - start < 20.0
    timer.join()
    # The chunk contains the time of reception, not the time of the read.
    send(broker.port, [('mag/a', b'y')])
    time.sleep(0.2)
    chunk, = mqtt.read(0.0)
    assert time.monotonic_ns() - chunk.arrival_ns > 150e6


def test_a_slow_reader_loses_the_oldest_messages_which_are_counted(broker, topics):
    mqtt = topics(broker.port, client_id='slow', queue=50, qos=1)
    mqtt.open()
    send(broker.port, [('mag/a', str(i).encode()) for i in range(300)] + [('mag/end', b'end')],
         qos=1)
    wait_for_messages(broker, 'slow', 301)
    assert not mqtt.counts
    chunks = mqtt.read(1.0)
    assert [c.data for c in chunks] == [str(i).encode() for i in range(251, 300)] + [b'end']
    assert mqtt.counts == {'messages dropped (queue full)': 251}
    mqtt.read(0.0)
    assert mqtt.counts == {'messages dropped (queue full)': 251}


def test_a_queue_that_is_exactly_full_loses_nothing(broker, topics):
    mqtt = topics(broker.port, client_id='full', queue=50, qos=1)
    mqtt.open()
    send(broker.port, [('mag/a', str(i).encode()) for i in range(50)], qos=1)
    wait_for_messages(broker, 'full', 50)
    assert [c.data for c in mqtt.read(1.0)] == [str(i).encode() for i in range(50)]
    assert not mqtt.counts


def test_long_and_empty_messages_are_counted(broker, topics):
    mqtt = topics(broker.port, max_length=1000)
    mqtt.open()
    send(broker.port, [('mag/a', b'x' * 1000), ('mag/a', b'x' * 1001), ('mag/a', b'x' * 500_000),
                       ('mag/a', b''), ('mag/a', b'z')])
    assert [len(c.data) for c in read_chunks(mqtt, 2)] == [1000, 1]
    assert_counts(mqtt.counts, {'max_length': 2, 'empty': 1})


def test_a_message_of_500_000_bytes_is_received_if_allowed(broker, topics):
    mqtt = topics(broker.port, max_length=1_000_000)
    mqtt.open()
    payload = os.urandom(500_000)
    send(broker.port, [('mag/a', payload)])
    assert [c.data for c in read_chunks(mqtt, 1)] == [payload]


@pytest.mark.parametrize('enabled', [False, True])
def test_retained_messages_are_skipped_unless_enabled(broker, topics, enabled):
    send(broker.port, [('mag/kept', b'old')], retain=True)
    try:
        mqtt = topics(broker.port, retained=enabled)
        mqtt.open()
        send(broker.port, [('mag/kept', b'new')], retain=True)
        sent = [b'old', b'new'] if enabled else [b'new']
        assert [c.data for c in read_chunks(mqtt, len(sent))] == sent
        assert_counts(mqtt.counts, {} if enabled else {'retained': 1})
    finally:
        send(broker.port, [('mag/kept', b'')], retain=True)


def test_messages_sent_while_closed_are_not_received_later(broker, topics):
    mqtt = topics(broker.port, client_id='reader', qos=1)
    mqtt.open()
    mqtt.close()
    send(broker.port, [('mag/a', b'meanwhile')], qos=1)
    mqtt.open()
    send(broker.port, [('mag/a', b'now')], qos=1)
    assert [c.data for c in read_chunks(mqtt, 1)] == [b'now']


def test_messages_unread_at_closing_are_not_received_later(broker, topics):
    mqtt = topics(broker.port, client_id='leaving', qos=1)
    mqtt.open()
    send(broker.port, [('mag/a', b'meanwhile')], qos=1)
    wait_for_messages(broker, 'leaving', 1)
    mqtt.close()
    with pytest.raises(DeviceError, match='not open'):
        mqtt.read(1.0)
    mqtt.open()
    assert mqtt.read(0.1) == []


def test_two_clients_without_identifier_coexist(broker, topics):
    both = [topics(broker.port), topics(broker.port)]
    for mqtt in both:
        mqtt.open()
    send(broker.port, [('mag/a', b'x')])
    assert [[c.data for c in read_chunks(mqtt, 1)] for mqtt in both] == [[b'x'], [b'x']]


def test_a_second_client_with_the_same_identifier_replaces_the_first(broker, topics):
    first, second = topics(broker.port, client_id='same'), topics(broker.port, client_id='same')
    first.open()
    second.open()
    with pytest.raises(DeviceError, match='lost'):
        first.read(60.0)
    assert second.read(0.1) == []


def test_a_killed_broker_is_reported_after_its_last_messages(tmp_path, topics):
    with Broker(tmp_path, 'log_type all') as broker:
        mqtt = topics(broker.port, client_id='reader', qos=1)
        mqtt.open()
        send(broker.port, [('mag/a', b'1'), ('mag/a', b'2')], qos=1)
        wait_for_messages(broker, 'reader', 2)
        broker.kill()
        killed = time.monotonic()
        wait_until(lambda: not connection_threads())
        assert [c.data for c in mqtt.read(60.0)] == [b'1', b'2']
        for _ in range(2):
            with pytest.raises(DeviceError, match=f'127.0.0.1:{broker.port}: .*lost'):
                mqtt.read(60.0)
        assert time.monotonic() - killed < 20.0
        assert 'connection refused' in open_error(mqtt)
        broker.start()
        mqtt.open()
        send(broker.port, [('mag/a', b'3')])
        assert [c.data for c in read_chunks(mqtt, 1)] == [b'3']


def test_a_killed_broker_ends_a_waiting_read_at_once(tmp_path, topics):
    with Broker(tmp_path) as broker:
        mqtt = topics(broker.port)
        mqtt.open()
        killer = threading.Timer(0.2, broker.kill)
        killer.start()
        start = time.monotonic()
        with pytest.raises(DeviceError, match='lost'):
            mqtt.read(20.0)
        killer.join()
        assert time.monotonic() - start < 20.0


def test_a_silent_broker_is_reported_after_the_keepalive_time(tmp_path, topics):
    with Broker(tmp_path) as broker:
        mqtt = topics(broker.port, keepalive_s=1)
        mqtt.open()
        # A healthy connection lasts even if nothing is published.
        assert mqtt.read(1.5) == []
        broker.freeze()
        start = time.monotonic()
        with pytest.raises(DeviceError, match='2 s'):
            mqtt.read(10.0)
        assert time.monotonic() - start < 10.0


def test_the_password_file_authenticates_the_client(tmp_path, topics):
    file = tmp_path / 'secret'
    with Broker(tmp_path, *password_lines(tmp_path, 'reader', 'pass word ')) as broker:
        for content, username in (('pass word \nsecond line\n', 'reader'),
                                  ('pass word ', 'reader')):
            file.write_text(content)
            mqtt = topics(broker.port, username=username, password_file=str(file))
            mqtt.open()
            mqtt.close()
        file.write_text('wrong\n')
        for changes in ({}, {'username': 'reader'},
                        {'username': 'reader', 'password_file': str(file)}):
            assert 'connection refused: Not authorized' in open_error(
                topics(broker.port, **changes))


def test_an_unusable_password_file_is_reported(tmp_path, topics):
    file = tmp_path / 'secret'
    mqtt = topics(free_port(), username='reader', password_file=str(file))
    assert f'password_file {file}' in open_error(mqtt)
    file.write_text('\nsecond line\n')
    assert f'password_file {file} is empty' in open_error(mqtt)
    file.write_bytes(b'\xff\xfe')
    assert f'password_file {file} ' in open_error(mqtt)


def test_a_refused_subscription_is_reported(tmp_path, topics):
    lines = subscription_lines(tmp_path, 'reader', 'x', 'mag/open/#')
    (tmp_path / 'secret').write_text('x')
    user = {'username': 'reader', 'password_file': str(tmp_path / 'secret')}
    with Broker(tmp_path, *lines) as broker:
        topics(broker.port, topics=('mag/open/1',), **user).open()
        mqtt = topics(broker.port, topics=('mag/open/1', 'mag/closed', 'all'), **user)
        assert open_error(mqtt).endswith('subscription refused: mag/closed, all')


def test_an_invalid_topic_filter_is_reported(broker, topics):
    assert "('mag/a', 'mag/#/b'): Invalid" in open_error(
        topics(broker.port, topics=('mag/a', 'mag/#/b')))


def test_a_missing_broker_is_reported(topics):
    assert 'broker is running' in open_error(topics(free_port()))


def test_an_unknown_host_is_reported(topics):
    assert 'cannot connect' in open_error(topics(1883, host='no-such-host.invalid'))


def test_a_server_other_than_mqtt_is_reported(topics):
    with ScriptedBroker(b'HTTP/1.1 400 Bad Request\r\n\r\n' + b'x' * 200) as server:
        threading.Timer(0.2, server.hang_up).start()
        assert 'tls: false' in open_error(
            topics(server.port))


@pytest.mark.parametrize('tls', [False, True])
def test_a_silent_server_is_reported(topics, tls):
    with ScriptedBroker(b'') as server:
        message = open_error(topics(server.port, connect_timeout_s=0.3, tls=tls))
    assert ('timed out' if tls else '0.3 s') in message


@pytest.mark.parametrize('code, text', [
    # paho reports the refusal of the protocol version as a protocol error.
    (1, 'MQTT broker'),
    (2, 'identifier'), (3, 'unavailable'), (4, 'password'), (5, 'authorized')])
def test_the_reason_of_a_refusal_is_reported_without_a_retry(topics, code, text):
    with ScriptedBroker(bytes([0x20, 2, 0, code])) as server:
        message = open_error(topics(server.port))
    assert f'127.0.0.1:{server.port}: ' in message and text in message
    assert len(server.received) == 1


@pytest.mark.parametrize('qos', [0, 1, 2])
def test_the_configured_quality_of_service_is_requested(topics, qos):
    with ScriptedBroker(CONNECTED, granted) as server:
        topics(server.port, qos=qos).open()
    assert server.received[1].endswith(b'mag/#' + bytes([qos]))


def test_a_broker_that_does_not_answer_a_subscription_is_reported(topics):
    with ScriptedBroker(CONNECTED, b'') as server:
        message = open_error(topics(server.port, connect_timeout_s=0.3))
        assert '0.3 s' in message
    assert b'mag/#' in server.received[1]


@pytest.mark.parametrize('garbage', [
    bytes([0x90, 5, 0, 1, 77, 88, 99]), bytes([0x90, 4, 0, 1, 0, 0]), bytes([0x90, 1, 0]),
    bytes([0x20, 0]), bytes([0xF0, 0]), bytes([0x30, 1, 0]), bytes([0x32, 2, 0, 0]),
    bytes([0x00, 0]), b'\x30\xff\xff\xff\xff\xff'])
def test_invalid_packets_end_the_connection_and_are_reported(topics, garbage):
    with ScriptedBroker(CONNECTED, lambda request: granted(request) + garbage) as server:
        mqtt = topics(server.port, connect_timeout_s=2.0)
        try:
            mqtt.open()
        except DeviceError as error:
            assert f'127.0.0.1:{server.port}: ' in str(error)
        else:
            with pytest.raises(DeviceError, match=f'127.0.0.1:{server.port}: '):
                mqtt.read(60.0)


def test_duplicates_are_counted_and_passed_on(topics):
    packets = publish_packet(b'mag/a', b'1') + publish_packet(b'mag/a', b'1', 0x08)
    with ScriptedBroker(CONNECTED, lambda request: granted(request) + packets) as server:
        mqtt = topics(server.port)
        mqtt.open()
        assert [c.data for c in read_chunks(mqtt, 2)] == [b'1', b'1']
        assert_counts(mqtt.counts, {'dup': 1})


def test_a_topic_that_is_not_utf_8_is_counted(topics):
    packets = publish_packet(b'mag/\xff', b'1') + publish_packet(b'mag/a', b'2')
    with ScriptedBroker(CONNECTED, lambda request: granted(request) + packets) as server:
        mqtt = topics(server.port)
        mqtt.open()
        assert [c.data for c in read_chunks(mqtt, 1)] == [b'2']
        assert_counts(mqtt.counts, {'UTF-8': 1})


def test_counts_survive_a_lost_connection(topics):
    packets = publish_packet(b'mag/\xff', b'1')
    with ScriptedBroker(CONNECTED, lambda request: granted(request) + packets) as server:
        mqtt = topics(server.port)
        mqtt.open()
        server.hang_up()
        wait_until(lambda: not connection_threads())
        assert not mqtt.counts
        assert 'connection refused' in open_error(mqtt)
        assert_counts(mqtt.counts, {'UTF-8': 1})


def test_tls_verifies_the_certificate_and_the_host(tmp_path, topics):
    cert, key = certificate(tmp_path)
    with Broker(tmp_path, f'certfile {cert}', f'keyfile {key}') as broker:
        mqtt = topics(broker.port, host='localhost', tls=True, ca_file=str(cert))
        mqtt.open()
        other = topics(broker.port, host='localhost', tls=True)
        assert ('TLS failed' in open_error(other)
                and 'certificate verify' in open_error(other))
        # The certificate is valid only for localhost.
        other = topics(broker.port, tls=True, ca_file=str(cert))
        assert 'TLS failed' in open_error(other) and 'mismatch' in open_error(other)
        assert 'tls: false' in open_error(topics(broker.port))
        assert mqtt.read(0.0) == []


def test_a_broker_without_tls_is_reported(broker, topics):
    message = open_error(topics(broker.port, tls=True))
    assert 'cannot connect: [Errno 104]' in message or 'TLS failed' in message


def test_an_unusable_ca_file_is_reported(tmp_path, topics):
    path = tmp_path / 'ca.pem'
    mqtt = topics(free_port(), tls=True, ca_file=str(path))
    assert f'ca_file {path} ' in open_error(mqtt)
    path.write_text('no certificate')
    assert f'ca_file {path} ' in open_error(mqtt)


def test_close_ends_a_waiting_read_and_may_be_repeated(broker, topics):
    mqtt = topics(broker.port)
    mqtt.close()
    with pytest.raises(DeviceError, match='not open'):
        mqtt.read(0.0)
    mqtt.open()
    closer = threading.Timer(0.2, mqtt.close)
    closer.start()
    start = time.monotonic()
    assert mqtt.read(20.0) == []
    assert 0.15 < time.monotonic() - start < 20.0
    closer.join()
    mqtt.close()
    mqtt.close()
    with pytest.raises(DeviceError, match='not open'):
        mqtt.read(20.0)


def test_reopening_closes_the_previous_connection(topics):
    with ScriptedBroker(CONNECTED, granted) as first:
        mqtt = topics(first.port)
        mqtt.open()
        assert 'connection refused' in open_error(mqtt)
        wait_until(lambda: first.received[-1] == b'\xe0\x00')


def test_close_sends_a_disconnect_packet(topics):
    with ScriptedBroker(CONNECTED, granted) as server:
        mqtt = topics(server.port)
        mqtt.open()
        mqtt.close()
        wait_until(lambda: server.received[-1] == b'\xe0\x00')
    # CONNECT, SUBSCRIBE and a single DISCONNECT.
    assert [packet[0] >> 4 for packet in server.received] == [1, 8, 14]


def test_close_during_connecting_ends_open(topics, monkeypatch):
    """`close` is called after the broker has been reached, and before it has answered."""
    with ScriptedBroker() as server:
        mqtt = topics(server.port)
        real = Client.connect

        def connect(*args):
            real(*args)
            mqtt.close()

        monkeypatch.setattr(Client, 'connect', connect)
        assert open_error(mqtt).endswith('not open')


def test_close_while_waiting_for_the_broker_ends_open(topics):
    with ScriptedBroker(b'') as server:
        mqtt = topics(server.port)
        closer = threading.Timer(0.1, mqtt.close)
        closer.start()
        start = time.monotonic()
        assert open_error(mqtt).endswith('not open')
        assert time.monotonic() - start < 20.0
        closer.join()


@pytest.mark.parametrize('changes, text', [
    ({'topics': ('',)}, 'topics: '), ({'topics': ('mag', '')}, 'topics: '),
    ({'password_file': 'x'}, 'password_file: '), ({'ca_file': 'x'}, 'ca_file: ')])
def test_invalid_settings_are_refused(changes, text):
    with pytest.raises(SettingsError, match=text):
        MqttTopics(replace(SETTINGS, **changes))
