"""Track a recording from Python without ROS: poses as arrays, errors against the ground truth."""

from pathlib import Path

import mag_tracking as mt

ROOT = Path(__file__).resolve().parents[1]


if __name__ == '__main__':
    network = mt.read_network(ROOT / 'config' / 'network.yaml')
    recording = ROOT / 'test' / 'data' / 'vehicles' / 'straight_car_right.mcap'
    result = mt.track(recording, network)
    for pose in result.poses:
        print(pose['stamp_ns'], pose['track_id'], pose['position'].round(2), pose['arrival'],
              pose['ambiguous'])
    for track_id in result.tracks:
        print(f'track {track_id}, error at the closest point of approach [m]:',
              result.errors(track_id)['closest'])
    print(result)
