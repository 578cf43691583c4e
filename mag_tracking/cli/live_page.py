"""The live page of `mag-tracking replay --live`, `ros watch` and `run --web`."""

import argparse
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from mag_tracking.errors import SettingsError
from mag_tracking.interrupts import recorded_signals
from mag_tracking.network import SensorNetwork
from mag_tracking.quantities import quantity
from mag_tracking.recording.reader import Recording
from mag_tracking.web.page_server import DEFAULT_PORT, LOOPBACK, PageServer, check_port

if TYPE_CHECKING:
    from mag_tracking.pipeline import Settings

WATCH_HELP = '''
Shows the tracks of running nodes. Ctrl-C ends the page, not the nodes.

Open the printed address in a browser. The page shows a map with tracks, 90% regions and
hypotheses, the fields of the sensors, and the health of the system. The page is available on this
machine only; --host 0.0.0.0 also serves it to other machines, which need the token in the address.

examples:
  mag-tracking ros watch
  mag-tracking ros watch --ros-args -r __ns:=/robot1
  mag-tracking ros watch --ros-args -r tracker_node/tracks:=/robot1/follower/tracks
'''


def add_page(parser: argparse._ActionsContainer, port: bool = True) -> None:
    """Add --host and --port, or only --host."""
    if port:
        parser.add_argument('--port', type=int, default=DEFAULT_PORT, metavar='PORT',
                            help=f'port of the page (default: {DEFAULT_PORT}; 0 selects a free '
                            'port)')
    parser.add_argument('--host', default=LOOPBACK, metavar='ADDRESS', help='local address of '
                        f'the page (default: {LOOPBACK})')


def show_recording(path: Path, network: SensorNetwork, settings: 'Settings', rate: float,
                   host: str, port: int) -> int:
    """Track a recording in real time on the live page until Ctrl-C; return the exit status."""
    # Imported here because the pipeline is slow to import.
    from mag_tracking.apps.view import view
    from mag_tracking.web.live_scene import LiveScene

    if not 0.0 < rate < float('inf'):
        raise SettingsError(f'--rate: expected a number above 0, got {rate:g}')
    recording, scene = Recording(path), LiveScene(path.name, network)
    scene.subtitle = f'{quantity(len(network), "sensor")}, frame {network.frame}'
    with recorded_signals(signal.SIGINT, signal.SIGTERM) as signals, \
            PageServer(scene, host, port) as server:
        print(f'live page: {server.url}')
        view(recording, network, settings, scene, rate,
             lambda: bool(signals) or not server.is_serving)
        if not signals:
            print('end of the recording; the page remains available until Ctrl-C')
        while not signals and server.is_serving:
            time.sleep(0.1)
        return 0 if server.is_serving else 1


def watch(args: argparse.Namespace) -> int:
    """Run `mag-tracking ros watch`."""
    # Imported here because it needs ROS.
    from mag_tracking.nodes import page_node

    end_of_input = _end_of_input_event() if args.until_eof else None
    return page_node.watch(args.host, args.port, print, args.ros_arguments,
                           end_of_input.is_set if end_of_input is not None
                           else lambda: False)


def _end_of_input_event() -> threading.Event:
    """Return an event that is set at the end of stdin, when the parent process has ended."""
    end_of_input = threading.Event()

    def read() -> None:
        sys.stdin.read()
        end_of_input.set()

    threading.Thread(target=read, daemon=True).start()
    return end_of_input


@contextmanager
def page_process(host: str, port: int, ros_arguments: Sequence[str]) -> Iterator[None]:
    """Run the live page in a separate process, so that it cannot delay the nodes.

    The first of the ROS arguments is `--ros-args`. Raises DeviceError if the port cannot be opened.
    """
    check_port(host, port)
    # The page process ends when its stdin is closed, even if this process is killed.
    process = subprocess.Popen([
        sys.executable, '-m', 'mag_tracking.cli', 'ros', 'watch', '--host', host, '--port',
        str(port), '--until-eof', *ros_arguments], stdin=subprocess.PIPE)
    is_closing = threading.Event()

    def report_end() -> None:
        status = process.wait()
        if not is_closing.is_set():
            print(f'mag-tracking: the live page ended with status {status}', file=sys.stderr)

    threading.Thread(target=report_end, daemon=True).start()
    try:
        yield
    finally:
        is_closing.set()
        process.terminate()
        try:
            process.wait(10.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
