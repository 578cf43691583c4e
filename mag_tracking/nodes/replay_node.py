"""replay_node: plays a recording over topics, with /clock, pause, resume and seek.

A lifecycle node: configuration opens the recording and advertises its topics, activation starts
playback, deactivation stops it. `autostart` (the default) does both at startup.
"""

if __name__ == '__main__':
    # Does not return: a signal during the imports below would end in a traceback.
    from mag_tracking.nodes.start import replay_node

    replay_node()

import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

from builtin_interfaces.msg import Time
from mag_tracking_msgs.srv import Seek
from rclpy.lifecycle import State, TransitionCallbackReturn
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from mag_tracking.errors import RecordingError, SettingsError
from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.nodes import stage_node
from mag_tracking.nodes.convert import message_class
from mag_tracking.nodes.managed_node import ManagedNode
from mag_tracking.nodes.paced_service import paced_service
from mag_tracking.nodes.ros_params import fixed_parameter
from mag_tracking.nodes.stage_node import STREAM
from mag_tracking.recording.reader import Recording

TICK_S = 0.005
"""How often the node looks for messages that are due [s]."""
MAX_STEP_S = 0.02
"""Time on the wall that one look may make good for [s]."""
MAX_AT_ONCE = 200
"""Messages published at one look; the subscribers' queues hold more than that."""


class ReplayNode(ManagedNode):
    """Publishes a recording's messages as they were, at its pace or another."""

    def __init__(self, **node_arguments: Any) -> None:
        """Raises RecordingError or SettingsError where `autostart` finds nothing to play."""
        super().__init__('replay_node', **node_arguments)
        self._path = fixed_parameter(self, 'recording', '', 'Path of the recording.')
        self._rate = fixed_parameter(self, 'rate', 1.0, 'Speed of the replay.')
        self._loop = fixed_parameter(self, 'loop', False, 'Begin again at the end.')
        self._offset = fixed_parameter(self, 'start_offset', 0.0, 'Where to begin [s].')
        self._topics = fixed_parameter(self, 'topics', [''], 'Recorded topics to play; none: all.')
        self._delay = fixed_parameter(self, 'start_delay', 2.0, 'Time for discovery [s].')
        self._paused = fixed_parameter(self, 'paused', False, 'Begin paused.')
        self._patience = fixed_parameter(self, 'wait_for_subscribers', 0.0,
                                         'Longest wait for subscribers to the fields [s].')
        self._recording: Recording | None = None
        self.counts: Counter[str] = Counter()
        self.publishers_by_topic: dict[str, Publisher] = {}
        self._missing: set[str] = set()
        self._clock_publisher = self.create_publisher(Clock, '/clock', STREAM)
        self.finished, self._is_active, self._start = False, False, 0.0
        self._wall: float | None = None
        paced_service(self, Trigger, '~/pause', self._pause)
        paced_service(self, Trigger, '~/resume', self._resume)
        paced_service(self, Seek, '~/seek', self._seek_service)
        self.create_timer(TICK_S, self._tick)
        self.start_by_itself()

    def prepare(self) -> None:
        """Open the recording and advertise its topics."""
        if not self._path:
            raise SettingsError('replay_node: parameter recording: a path is needed')
        if not 0.0 < self._rate < float('inf'):
            raise SettingsError(f'replay_node: parameter rate: {self._rate} is not a number '
                                'above 0')
        recording = Recording(self._path)
        self._begin = _begin_of(recording)
        self._wanted = _wanted(recording, self._topics)
        end = recording.end_ns
        if not self._offset >= 0.0 or (
                end is not None and self._begin + self._offset * 1e9 > end):
            raise SettingsError(f'replay_node: parameter start_offset: {self._offset} s is outside '
                                'the recording')
        self._recording = recording
        for topic, kind in recording.types.items():
            if self._wanted is None or topic in self._wanted:
                self._publisher_for(topic, kind)
        self._seek(self._offset)

    def on_activate(self, state: State) -> TransitionCallbackReturn:
        """Start playback at the current position."""
        # Discovery takes a moment; what is published before it is lost.
        self._start = time.monotonic() + self._delay
        self._is_active, self._wall = True, None
        return super().on_activate(state)

    def on_deactivate(self, state: State) -> TransitionCallbackReturn:
        """Stop playback; the position is kept."""
        self._is_active = False
        return super().on_deactivate(state)

    def on_cleanup(self, state: State) -> TransitionCallbackReturn:
        """Close the recording and withdraw its topics."""
        self._forget()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: State) -> TransitionCallbackReturn:
        """Stop playback and close the recording."""
        self._forget()
        return TransitionCallbackReturn.SUCCESS

    def _forget(self) -> None:
        """Close the recording and withdraw its topics."""
        self._is_active, self._recording, self.finished = False, None, False
        for publisher in self.publishers_by_topic.values():
            self.destroy_publisher(publisher)
        self.publishers_by_topic.clear()
        self._missing.clear()

    def _publisher_for(self, topic: str, kind: str) -> Publisher | None:
        """The publisher of a topic; None where its type is not installed."""
        if topic not in self.publishers_by_topic and topic not in self._missing:
            cls = message_class(kind)
            if cls is None:
                self._missing.add(topic)
                self.get_logger().warning(f'{topic} is not played: {kind} is not installed')
            else:
                self.publishers_by_topic[topic] = self.create_publisher(
                    cls, self._within_namespace(topic), STREAM)
        return self.publishers_by_topic.get(topic)

    def _within_namespace(self, topic: str) -> str:
        """The name under which a recorded topic is played: below the namespace of this node."""
        namespace = self.get_namespace().rstrip('/')
        return topic if topic.startswith(f'{namespace}/') else f'{namespace}{topic}'

    def _seek(self, offset: float) -> None:
        """Go on from `offset` seconds after the first message."""
        assert self._recording is not None, 'a place in no recording'
        self._position = self._begin + int(offset * 1e9)
        self._messages = self._recording.messages(self._wanted, self._position)
        self._next = next(self._messages, None)
        self._wall = None

    def _tick(self) -> None:
        """Publish what is due."""
        now = time.monotonic()
        if not self._is_active or self._paused or self.finished or now < self._start \
                or not self._heard(now):
            return
        # After a stall it goes on at its pace: a burst would overrun the subscribers' queues.
        elapsed = 0.0 if self._wall is None else min(now - self._wall, MAX_STEP_S)
        self._wall = now
        self._position += int(elapsed * self._rate * 1e9)
        self._clock_publisher.publish(Clock(clock=Time(sec=self._position // 10**9,
                                             nanosec=self._position % 10**9)))
        room = MAX_AT_ONCE
        while self._next is not None and self._next.log_time_ns <= self._position:
            if room == 0:
                # Slower than asked for, rather than more than the queues hold.
                self._position = self._next.log_time_ns
                return
            room -= 1
            publisher = self._publisher_for(self._next.topic, self._next.type)
            if publisher is not None and not self._next.data:
                # Damaged, or of a ROS 1 type that is not converted.
                self.counts['rejected: undecodable message'] += 1
            elif publisher is not None:
                publisher.publish(self._next.data)
                self.counts['messages'] += 1
            self._next = next(self._messages, None)
        if self._next is None:
            self._end()

    def _heard(self, now: float) -> bool:
        """Whether somebody listens to every magnetic field, or has been waited for long enough."""
        recording = self._recording
        if recording is not None and now < self._start + self._patience:
            return all(p.get_subscription_count() for topic, p in self.publishers_by_topic.items()
                       if recording.types.get(topic) == MAGNETIC_FIELD)
        return True

    def _end(self) -> None:
        """The recording is over: begin again, or stay."""
        assert self._recording is not None, 'the end of no recording'
        for what, n in self._recording.losses.items():
            self.get_logger().warning(f'{what}: {n}')
        if self._loop:
            self._seek(0.0)
            return
        self.finished = True
        self.get_logger().info(f'{self.counts["messages"]} messages played')

    def _pause(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Stop where it is."""
        self._paused, self._wall = True, None
        response.success, response.message = True, 'paused'
        return response

    def _resume(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Go on."""
        self.resume()
        response.success, response.message = True, 'playing'
        return response

    def resume(self) -> None:
        """Go on from where it was paused, without the rest of `start_delay`."""
        self._paused = False
        self._start = min(self._start, time.monotonic())

    def _seek_service(self, request: Seek.Request, response: Seek.Response) -> Seek.Response:
        """Move to another place; a negative or too large offset is refused."""
        if self._recording is None:
            response.success, response.message = False, 'no recording is open: configure first'
            return response
        last = self._recording.end_ns
        if not request.offset >= 0.0 or (
                last is not None and self._begin + request.offset * 1e9 > last):
            response.success = False
            response.message = f'offset {request.offset} s is outside the recording'
            return response
        self._seek(request.offset)
        self.finished = False
        response.success, response.message = True, f'at {request.offset} s'
        return response


def _begin_of(recording: Recording) -> int:
    """[ns] Time of the first message; raises RecordingError for an empty recording."""
    if recording.start_ns is not None:
        return recording.start_ns
    # A file without an end does not tell: read on until it does.
    first = next(recording.messages(), None)
    if first is None:
        raise RecordingError(f'{recording.path} holds no message')
    return first.log_time_ns


def _wanted(recording: Recording, topics: Sequence[str]) -> set[str] | None:
    """Topics to play, None for all; raises RecordingError for an unknown topic."""
    wanted = [t for t in topics if t]
    unknown = [t for t in wanted if t not in recording.types]
    if unknown and recording.message_counts:
        raise RecordingError(f'{recording.path} has no topic {unknown[0]}; it has '
                             f'{", ".join(sorted(recording.types))}')
    return set(wanted) or None


def main(arguments: list[str] | None = None) -> int:
    """Run the node; returns the exit status."""
    return stage_node.main(ReplayNode, arguments)
