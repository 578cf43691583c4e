"""Generate the Python classes of ROS messages and the code that they need, without CMake.

A CMake build makes the code of all languages and middlewares. Python and Fast DDS, the one
middleware on PyPI, need about half of it. Here it becomes one extension module per package,
compiled from few large files: most of the time goes into reading the same headers.
"""

import json
import sys
from pathlib import Path

import rosidl_parser.parser

PREFIX = next((p for entry in sys.path for p in Path(entry).resolve().parents
               if (p / 'share' / 'rosidl_generator_py').is_dir()), None)
"""Where pip has put the generators."""
if PREFIX is None:
    raise RuntimeError('rosidl_generator_py is not in the build environment: use `pip install`')

SOURCE = Path(__file__).resolve().parent
DISPATCH = 'rosidl_typesupport_c'
MIDDLEWARE = 'rosidl_typesupport_fastrtps_c'
# Fast DDS describes the types of its topics to other participants with it.
INTROSPECTION = 'rosidl_typesupport_introspection_c'
KINDS = 'rosidl_generator_c', 'rosidl_generator_py', MIDDLEWARE, INTROSPECTION
LIBRARIES = ['fastcdr', 'rcutils', 'rosidl_runtime_c', DISPATCH, MIDDLEWARE, INTROSPECTION,
             'rosidl_typesupport_fastrtps_cpp']


def parse_once(parse):
    """Make `parse`, which every generator calls for every file, remember its results."""
    results = {}

    def parsed(locator, png_file=None):
        path = locator.get_absolute_path()
        if path not in results:
            results[path] = parse(locator, png_file)
        return results[path]
    return parsed


# The generators bind this function when they are imported, so they are imported below.
rosidl_parser.parser.parse_idl_file = parse_once(rosidl_parser.parser.parse_idl_file)

import rosidl_adapter  # noqa: E402
import rosidl_generator_c  # noqa: E402
import rosidl_generator_py  # noqa: E402
import rosidl_generator_type_description  # noqa: E402
import rosidl_typesupport_fastrtps_c  # noqa: E402
import rosidl_typesupport_introspection_c  # noqa: E402

GENERATORS = {
    'rosidl_generator_type_description': rosidl_generator_type_description.generate_type_hash,
    'rosidl_generator_c': rosidl_generator_c.generate_c,
    MIDDLEWARE: rosidl_typesupport_fastrtps_c.generate_typesupport_fastrtps_c,
    INTROSPECTION: rosidl_typesupport_introspection_c.generate_c,
    'rosidl_generator_py': lambda arguments: rosidl_generator_py.generate_py(
        arguments, [DISPATCH]),
}


def interface_files(source):
    """Paths, relative to `source`, of the message and service definitions."""
    return sorted(f.relative_to(source) for f in (*source.glob('msg/*.msg'),
                                                  *source.glob('srv/*.srv')))


def generate(name, source, work):
    """Generate all files of package `name`, whose definitions are in `source`, below `work`."""
    idl = work / 'idl' / name
    stems = [str(rosidl_adapter.convert_to_idl(source, name, f, idl).relative_to(idl)
                 .with_suffix('')) for f in interface_files(source)]
    descriptions = work / 'rosidl_generator_type_description' / name
    for generator, run in GENERATORS.items():
        output = work / generator / name
        templates = PREFIX / 'share' / generator / 'resource'
        output.mkdir(parents=True)
        arguments = work / f'{generator}.json'
        arguments.write_text(json.dumps({
            'package_name': name,
            'idl_tuples': [f'{idl}:{stem}.idl' for stem in stems],
            'include_paths': [f'{folder.name}:{folder}' for folder in
                              sorted((PREFIX / 'share').iterdir())],
            'output_dir': str(output),
            'ros_interface_files': [str(source / f) for f in interface_files(source)],
            'target_dependencies': [],
            'template_dir': str(templates),
            'type_description_tuples': [f'{stem}.idl:{descriptions / stem}.json' for stem in stems]
            if generator == 'rosidl_generator_c' else [],
        }))
        run(str(arguments))
        for template in templates.glob('*visibility_control.h.in'):
            text = template.read_text().replace('@PROJECT_NAME_UPPER@', name.upper())
            (output / 'msg' / template.stem).write_text(text.replace('@PROJECT_NAME@', name))


def joined(path, sources):
    """Write a file that includes all of `sources`, and return its path."""
    path.write_text(''.join(f'#include "{f.resolve()}"\n' for f in sorted(sources)))
    return str(path)


def dispatch(name, source, path):
    """Write the code that leads to the type supports of all messages and services."""
    lines = [f'#include "{SOURCE / "dispatch.h"}"']
    for f in interface_files(source):
        kind = {'.msg': 'MESSAGE', '.srv': 'SERVICE'}[f.suffix]
        lines.append(f'DISPATCH_{kind}({name}__{f.parent}__{f.stem})')
    path.write_text('\n'.join(lines) + '\n')
    return path


def extension_options(name, source, work):
    """Sources and options of the extension module of package `name`, of which `generate` has
    written the code: {parameter of `Extension`: its value}.
    """
    import numpy as np
    folders = {kind: work / kind / name for kind in KINDS}
    code = folders['rosidl_generator_c']
    # The descriptions define the same names, so they cannot be compiled together.
    descriptions = [*code.glob('*/detail/*__description.c')]
    dependencies = sorted(f.parent.parent.name for f in (PREFIX / 'share').glob(
        '*/cmake/export_*__rosidl_generator_pyExport.cmake'))
    return {
        'sources': [
            joined(work / f'{name}.c', [
                *(f for f in code.glob('*/detail/*.c') if f not in descriptions),
                *folders['rosidl_generator_py'].rglob('*.c'),
                *folders[INTROSPECTION].rglob('*.c'),
                dispatch(name, source, work / f'{name}_dispatch.c')]),
            joined(work / f'{name}_middleware.cpp', folders[MIDDLEWARE].rglob('*.cpp')),
            *map(str, sorted(descriptions))],
        'include_dirs': [
            *(str(folder.parent) for folder in folders.values()), np.get_include(),
            str(PREFIX / 'include'), *map(str, sorted((PREFIX / 'include').iterdir()))],
        'library_dirs': [str(PREFIX / 'lib')],
        'libraries': [*LIBRARIES, *(f'{package}__{kind}' for package in dependencies
                                    for kind in KINDS)],
    }


def shared_files(name, source, work):
    """Files of package `name` for tools, as CMake installs them: {folder: files}.

    These are its definitions, and its entries in the index of ROS packages.
    """
    index = work / 'index' / name
    interfaces = [work / 'idl' / name / f.with_suffix('.idl') for f in interface_files(source)]
    entries = {'packages': [], 'rosidl_interfaces': sorted(
        str(f) for stem in interface_files(source) for f in (stem, stem.with_suffix('.idl')))}
    files = {f'share/{name}': [str(source / 'package.xml')]}
    for kind, lines in entries.items():
        (index / kind).mkdir(parents=True)
        (index / kind / name).write_text('\n'.join(lines))
        files[f'share/ament_index/resource_index/{kind}'] = [str(index / kind / name)]
    for kind in ('msg', 'srv'):
        files[f'share/{name}/{kind}'] = [
            str(path) for f, idl in zip(interface_files(source), interfaces, strict=True)
            if f.parent.name == kind
            for path in (source / f, idl, work / 'rosidl_generator_type_description' / name
                         / f.with_suffix('.json'))]
    return {folder: paths for folder, paths in files.items() if paths}
