"""replay_node: plays a recording on topics, with /clock, pause, resume and seek.

A lifecycle node: configuration opens the recording, activation starts playback, deactivation stops
it. By default (`autostart`), the node configures and activates itself.
"""

if __name__ == '__main__':
    from mag_tracking.nodes.start import replay_node

    replay_node()

import time
from collections import Counter
from collections.abc import Sequence
from functools import partial
from typing import Any

from builtin_interfaces.msg import Time
from mag_tracking_msgs.srv import Seek
from rclpy.lifecycle import State, TransitionCallbackReturn
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from mag_tracking.errors import RecordingError, SettingsError
from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.nodes import middleware
from mag_tracking.nodes.convert import message_class
from mag_tracking.nodes.middleware import ManagedNode
from mag_tracking.nodes.ros_params import fixed_parameter
from mag_tracking.nodes.scheduling import paced_service
from mag_tracking.nodes.stage_node import STREAM_QOS
from mag_tracking.quantities import quantity
from mag_tracking.recording.reader import Recording

UPDATE_INTERVAL_S = 0.005
"""[s] Interval between checks for due messages."""
MAX_STEP_S = 0.02
"""[s] Maximum advance of one tick (at rate 1); playback does not catch up after a longer stall."""
MAX_MESSAGES_PER_TICK = 200
"""Maximum number of messages published per tick; at most the queue length of the nodes."""


class ReplayNode(ManagedNode):
    """Publishes the messages of a recording until `finished`; `counts` played and rejected ones."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__('replay_node', **node_arguments)
        self._path = fixed_parameter(self, 'recording', '', 'Path of the recording.')
        self._rate = fixed_parameter(self, 'rate', 1.0,
                                     'Playback rate relative to the recorded rate.')
        self._loop = fixed_parameter(self, 'loop', False, 'Restart playback at the end.')
        self._start_offset_s = fixed_parameter(self, 'start_offset', 0.0,
                                               'Start position after the first message [s].')
        self._topics = fixed_parameter(self, 'topics', [''], 'Recorded topics to play. If empty, '
                                       'all topics are played.')
        self._start_delay_s = fixed_parameter(self, 'start_delay', 2.0, 'Delay of playback after '
                                              'activation, for discovery of the subscribers [s].')
        self._paused = fixed_parameter(self, 'paused', False, 'Start paused.')
        self._subscriber_timeout_s = fixed_parameter(
            self, 'wait_for_subscribers', 0.0, 'Maximum additional delay until all magnetic field '
            'topics have a subscriber [s].')
        self._recording: Recording | None = None
        self.counts: Counter[str] = Counter()
        self.publishers_by_topic: dict[str, Publisher] = {}
        self._not_installed: set[str] = set()
        self._clock_publisher = self.create_publisher(Clock, '/clock', STREAM_QOS)
        self.finished, self._is_active, self._start_time = False, False, 0.0
        self._last_tick: float | None = None
        paced_service(self, Trigger, '~/pause', partial(self._pause_or_resume, True))
        paced_service(self, Trigger, '~/resume', partial(self._pause_or_resume, False))
        paced_service(self, Seek, '~/seek', self._seek_service)
        self.create_timer(UPDATE_INTERVAL_S, self._tick)
        self.start_automatically()

    def prepare(self) -> None:
        """Open the recording and advertise its topics; raises SettingsError or RecordingError."""
        if not self._path:
            raise SettingsError('replay_node: parameter recording is empty; set it to the path of '
                                'a recording')
        if not 0.0 < self._rate < float('inf'):
            raise SettingsError(f'replay_node: parameter rate: {self._rate} is not a finite '
                                'number above 0')
        recording = Recording(self._path)
        self._begin_ns = _first_time_ns(recording)
        self._selected_topics = _selected_topics(recording, self._topics)
        if not self._is_inside(recording, self._start_offset_s):
            raise SettingsError(f'replay_node: parameter start_offset: {self._start_offset_s} s '
                                'is outside the recording')
        self._recording = recording
        for topic, kind in recording.types.items():
            if self._selected_topics is None or topic in self._selected_topics:
                self._publisher_for(topic, kind)
        self._seek(self._start_offset_s)

    def _is_inside(self, recording: Recording, offset: float) -> bool:
        """Whether a recording contains the time of `offset` seconds after the first message."""
        return offset >= 0.0 and (recording.end_ns is None
                                  or self._begin_ns + offset * 1e9 <= recording.end_ns)

    def on_activate(self, state: State) -> TransitionCallbackReturn:
        """Start playback at the current position."""
        # Messages published before discovery is complete are lost.
        self._start_time = time.monotonic() + self._start_delay_s
        self._is_active, self._last_tick = True, None
        return super().on_activate(state)

    def on_deactivate(self, state: State) -> TransitionCallbackReturn:
        """Stop playback; the position is kept."""
        self._is_active = False
        return super().on_deactivate(state)

    def release(self) -> None:
        """Stop playback, close the recording and withdraw its topics."""
        self._is_active, self._recording, self.finished = False, None, False
        for publisher in self.publishers_by_topic.values():
            self.destroy_publisher(publisher)
        self.publishers_by_topic.clear()
        self._not_installed.clear()

    def _publisher_for(self, topic: str, kind: str) -> Publisher | None:
        """Publisher of a topic, within the namespace of this node; None if its type is missing."""
        if topic not in self.publishers_by_topic and topic not in self._not_installed:
            cls = message_class(kind)
            if cls is None:
                self._not_installed.add(topic)
                self.get_logger().warning(f'{topic} is not played: message type {kind} is not '
                                          'installed')
            else:
                namespace = self.get_namespace().rstrip('/')
                self.publishers_by_topic[topic] = self.create_publisher(
                    cls, topic if topic.startswith(f'{namespace}/') else f'{namespace}{topic}',
                    STREAM_QOS)
        return self.publishers_by_topic.get(topic)

    def _seek(self, offset: float) -> None:
        """Set the position to `offset` seconds after the first message."""
        assert self._recording is not None, 'seek without a recording'
        self._position_ns = self._begin_ns + int(offset * 1e9)
        self._messages = self._recording.messages(self._selected_topics, self._position_ns)
        self._next_message = next(self._messages, None)
        self._last_tick = None

    def _tick(self) -> None:
        """Publish the messages that are due."""
        now = time.monotonic()
        if not self._is_active or self._paused or self.finished or now < self._start_time \
                or not self._has_subscribers(now):
            return
        # After a stall, playback continues at its rate: a burst would overflow subscriber queues.
        elapsed = 0.0 if self._last_tick is None else min(now - self._last_tick, MAX_STEP_S)
        self._last_tick = now
        self._position_ns += int(elapsed * self._rate * 1e9)
        self._clock_publisher.publish(Clock(clock=Time(sec=self._position_ns // 10**9,
                                                       nanosec=self._position_ns % 10**9)))
        n_remaining = MAX_MESSAGES_PER_TICK
        while self._next_message is not None \
                and self._next_message.log_time_ns <= self._position_ns:
            if n_remaining == 0:
                # Slow down rather than overflow the queues.
                self._position_ns = self._next_message.log_time_ns
                return
            n_remaining -= 1
            publisher = self._publisher_for(self._next_message.topic, self._next_message.type)
            if publisher is not None and not self._next_message.data:
                # The message is damaged, or its ROS 1 type cannot be converted.
                self.counts['rejected: undecodable message'] += 1
            elif publisher is not None:
                publisher.publish(self._next_message.data)
                self.counts['messages'] += 1
            self._next_message = next(self._messages, None)
        if self._next_message is None:
            self._end()

    def _has_subscribers(self, now: float) -> bool:
        """Whether each magnetic field topic has a subscriber, or `wait_for_subscribers` elapsed."""
        recording = self._recording
        if recording is not None and now < self._start_time + self._subscriber_timeout_s:
            return all(p.get_subscription_count() for topic, p in self.publishers_by_topic.items()
                       if recording.types.get(topic) == MAGNETIC_FIELD)
        return True

    def _end(self) -> None:
        """Handle the end of the recording: restart if `loop` is set, otherwise stop."""
        assert self._recording is not None, 'end without a recording'
        for cause, n in self._recording.losses.items():
            self.get_logger().warning(f'{cause}: {n}')
        if self._loop:
            self._seek(0.0)
            return
        self.finished = True
        self.get_logger().info(
            f'end of the recording: {quantity(self.counts["messages"], "message")} played')

    def _pause_or_resume(self, paused: bool, _request: Trigger.Request,
                         response: Trigger.Response) -> Trigger.Response:
        """Handle ~/pause and ~/resume."""
        if paused:
            self._paused, self._last_tick = True, None
        else:
            self.resume()
        response.success, response.message = True, 'paused' if paused else 'playing'
        return response

    def resume(self) -> None:
        """Continue playback at the current position; the remaining `start_delay` is skipped."""
        self._paused = False
        self._start_time = min(self._start_time, time.monotonic())

    def _seek_service(self, request: Seek.Request, response: Seek.Response) -> Seek.Response:
        """Handle ~/seek; reject an offset outside the recording."""
        if self._recording is None:
            response.message = 'no recording is open: configure the node first'
        elif not self._is_inside(self._recording, request.offset):
            response.message = f'offset: {request.offset} s is outside the recording'
        else:
            self._seek(request.offset)
            self.finished = False
            response.success, response.message = True, f'position: {request.offset} s'
        return response


def _first_time_ns(recording: Recording) -> int:
    """Time of the first message [ns]; raises RecordingError for an empty recording."""
    if recording.start_ns is not None:
        return recording.start_ns
    # A file that was not closed has no index: read the first message.
    first = next(recording.messages(), None)
    if first is None:
        raise RecordingError(f'{recording.path} contains no messages')
    return first.log_time_ns


def _selected_topics(recording: Recording, topics: Sequence[str]) -> set[str] | None:
    """Topics to play, None for all; raises RecordingError for an unknown topic."""
    selected = [t for t in topics if t]
    unknown_topics = [t for t in selected if t not in recording.types]
    if unknown_topics and recording.message_counts:
        raise RecordingError(f'{recording.path} does not contain topic {unknown_topics[0]}; '
                             f'it contains {", ".join(sorted(recording.types))}')
    return set(selected) or None


main = partial(middleware.main, ReplayNode)
