"""Generate config/viewers/: layouts for RViz, Foxglove (and Lichtblick) and PlotJuggler.

The layouts are for the sensors of config/network.yaml. For another network file, run
generate_viewers.py FILE FOLDER.
"""

import json
import sys
from pathlib import Path
from xml.etree import ElementTree

import yaml

from mag_tracking.network.file import read_network
from mag_tracking.network.sensor_network import absolute
from mag_tracking.report.style import AXIS_COLOURS, BLUE, ORANGE, VERMILLION

ROOT = Path(__file__).resolve().parents[1]
TRACKER = '/tracker_node'


def rviz(network):
    """Content of an RViz configuration."""
    def topic(name, durability='Volatile'):
        return {'Value': f'{TRACKER}/{name}', 'Depth': 10, 'History Policy': 'Keep Last',
                'Reliability Policy': 'Reliable', 'Durability Policy': durability}

    def display(kind, name, **more):
        return {'Class': f'rviz_default_plugins/{kind}', 'Name': name, 'Enabled': True, **more}

    displays = [
        display('Grid', 'Grid', **{'Cell Size': 5, 'Plane Cell Count': 12,
                                   'Reference Frame': network.frame}),
        display('TF', 'Frames', **{'Marker Scale': 2, 'Show Names': True}),
        display('MarkerArray', 'Sensors', Topic=topic('sensor_markers', 'Transient Local')),
        display('MarkerArray', 'Track', Topic=topic('markers')),
        display('Path', 'Path', Topic=topic('path'), Color='0; 114; 178'),
        display('Path', 'Smoothed path', Topic=topic('path_smoothed'), Color='213; 94; 0'),
        display('PoseWithCovariance', 'Pose', Topic=topic('pose'))]
    return yaml.safe_dump({
        'Panels': [{'Class': 'rviz_common/Displays', 'Name': 'Displays'},
                   {'Class': 'rviz_common/Time', 'Name': 'Time'}],
        'Visualization Manager': {
            'Class': '', 'Displays': displays, 'Enabled': True, 'Name': 'root',
            'Global Options': {'Fixed Frame': network.frame, 'Frame Rate': 30,
                               'Background Color': '255; 255; 255'},
            'Tools': [{'Class': 'rviz_default_plugins/MoveCamera'},
                      {'Class': 'rviz_default_plugins/Measure'}],
            'Views': {'Current': {'Class': 'rviz_default_plugins/TopDownOrtho', 'Scale': 15,
                                  'X': float(network.centre[0]), 'Y': float(network.centre[1])}}}},
        sort_keys=False)


def foxglove(network, fields):
    """Content of a layout for Foxglove and Lichtblick."""
    def plot(title, *paths):
        return {'paths': [{'value': value, 'enabled': True, 'timestampMethod': 'headerStamp',
                           'color': colour} for value, colour in paths],
                'title': title, 'showLegend': True, 'isSynced': True}

    shown = {f'{TRACKER}/{name}': {'visible': True}
             for name in ('markers', 'sensor_markers', 'path', 'path_smoothed')}
    pose = f'{TRACKER}/odometry.pose.pose.position'
    panels = {
        '3D!map': {'followTf': network.frame, 'followMode': 'follow-none', 'topics': shown,
                   'cameraState': {'perspective': False, 'distance': 60, 'phi': 0,
                                   'thetaOffset': 0, 'targetOffset': network.centre.tolist()}},
        'Plot!fields': plot('Calibrated field [T]', *(
            (f'{topic}.magnetic_field.{axis}', colour) for topic in fields
            for axis, colour in zip('xyz', AXIS_COLOURS, strict=True))),
        'Plot!position': plot('Position [m]', (f'{pose}.x', BLUE), (f'{pose}.y', VERMILLION)),
        'Plot!variance': plot('Variance of x and y [m^2]', *(
            (f'{TRACKER}/pose.pose.covariance[{k}]', colour)
            for k, colour in ((0, BLUE), (7, VERMILLION)))),
        'Plot!innovation': plot('Normalised innovation squared', (
            f'{TRACKER}/tracks.tracks[0].normalised_innovation', ORANGE))}
    names = list(panels)
    layout = names[-1]
    for name in reversed(names[1:-1]):
        layout = {'first': name, 'second': layout, 'direction': 'column'}
    return json.dumps({'configById': panels, 'globalVariables': {}, 'userNodes': {},
                       'playbackConfig': {'speed': 1},
                       'layout': {'first': names[0], 'second': layout, 'direction': 'row'}},
                      indent=1) + '\n'


def plotjuggler(fields):
    """Content of a layout for PlotJuggler."""
    plots = [[(f'{topic}/magnetic_field/{axis}', colour)
              for axis, colour in zip('xyz', AXIS_COLOURS, strict=True)] for topic in fields]
    pose = f'{TRACKER}/odometry/pose/pose/position'
    plots.append([(f'{pose}/x', BLUE), (f'{pose}/y', VERMILLION)])
    plots.append([(f'{TRACKER}/tracks/tracks[0]/normalised_innovation', ORANGE)])
    root = ElementTree.Element('root')
    tab = ElementTree.SubElement(ElementTree.SubElement(
        root, 'tabbed_widget', {'parent': 'main_window', 'name': 'Main Window'}), 'Tab',
        {'containers': '1', 'tab_name': 'mag_tracking'})
    splitter = ElementTree.SubElement(ElementTree.SubElement(tab, 'Container'), 'DockSplitter', {
        'orientation': '-', 'count': str(len(plots)),
        'sizes': ';'.join([f'{1.0 / len(plots):.4f}'] * len(plots))})
    for curves in plots:
        area = ElementTree.SubElement(splitter, 'DockArea', {'name': '...'})
        plot = ElementTree.SubElement(area, 'plot', {'mode': 'TimeSeries', 'style': 'Lines'})
        for name, colour in curves:
            ElementTree.SubElement(plot, 'curve', {'name': name, 'color': colour})
    ElementTree.SubElement(root, 'use_relative_time_offset', {'enabled': '1'})
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding='unicode') + '\n'


def layouts(network):
    """Contents of all layouts: {file name: content}."""
    fields = [f'{absolute(topic)}_calibrated' for topic in network.topics]
    return {'mag_tracking.rviz': rviz(network), 'foxglove.json': foxglove(network, fields),
            'plotjuggler.xml': plotjuggler(fields)}


def main(arguments):
    """Write the files; return the exit status."""
    network_file = Path(arguments[0]) if arguments else ROOT / 'config' / 'network.yaml'
    folder = Path(arguments[1]) if len(arguments) > 1 else ROOT / 'config' / 'viewers'
    for name, text in layouts(read_network(network_file)).items():
        (folder / name).write_text(text)
        print(f'wrote {folder / name}')
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
