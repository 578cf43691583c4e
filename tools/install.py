"""Install into .venv in stages: `install.py run`, `install.py test docs`, `install.py colcon`.

uv installs; pip does where uv cannot run, or with INSTALLER=pip. Exact versions come from
constraints.txt. What was compiled is kept in the user's cache and used again while its sources,
the Python and the compiler are the same.
"""

import fcntl
import hashlib
import os
import shutil
import stat
import subprocess
import sys
import sysconfig
import time
from importlib.metadata import requires
from pathlib import Path

from pins import build_requires, colcon_requires

ROOT = Path(__file__).resolve().parents[1]
MESSAGES = ROOT / 'msg_defs'
PINS = ROOT / 'constraints.txt'
BIN = Path(sys.prefix) / 'bin'
KEPT_DAYS = 60
"""Days without use after which a file is removed from the cache."""


def say(text):
    print(f'Setting up: {text}', flush=True)


def run(*command, **variables):
    """Run a command; if it fails, end with its status."""
    process = subprocess.run([str(c) for c in command], cwd=ROOT, env=os.environ | variables)
    if process.returncode:
        sys.exit(f'Setting up failed with status {process.returncode}.')


def find_uv():
    """Path of uv in this environment, where it is installed if necessary; None to use pip."""
    if os.environ.get('INSTALLER', 'uv') == 'pip':
        return None
    uv = BIN / 'uv'
    wanted = next(line for line in PINS.read_text().splitlines() if line.startswith('uv=='))
    pip = sys.executable, '-m', 'pip', '--quiet', '--disable-pip-version-check', '--no-input'
    for attempt in range(2):
        try:
            version = subprocess.run([uv, '--version'], capture_output=True, text=True, check=True)
            if version.stdout.split()[1] == wanted.removeprefix('uv=='):
                return uv
        except (OSError, subprocess.CalledProcessError) as error:
            if attempt:
                say(f'uv cannot run here ({error}); pip installs instead, which takes longer')
        if not attempt:
            say('uv, which installs the rest')
            subprocess.run([*pip, 'install', wanted])
    return None


def cache_folder():
    """Folder of the user's cache for compiled files; None if others could write to it."""
    cache = Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache') / 'mag_tracking'
    try:
        cache.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = cache.stat()
    except (OSError, RuntimeError) as error:
        say(f'without a cache of compiled files: {error}')
        return None
    if status.st_uid != os.getuid() or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        say(f'without a cache of compiled files: others may write to {cache}')
        return None
    for old in cache.glob('*/*'):
        newest = max(path.stat().st_mtime for path in (old, *old.glob('*')))
        if time.time() - newest > KEPT_DAYS * 86400:
            if old.is_dir():
                shutil.rmtree(old, ignore_errors=True)
            else:
                old.unlink(missing_ok=True)
    return cache


def settings_of_pip():
    """Variables with which uv uses the index, folders and certificates of pip."""
    lines = subprocess.run([sys.executable, '-m', 'pip', 'config', 'list'], capture_output=True,
                           text=True).stdout.splitlines()
    found = {}
    for line in lines:
        # Variables of the environment (":env:.") are listed first, and take precedence.
        name, _, value = line.partition('=')
        found.setdefault(name.rpartition('.')[2], value.strip('\'"'))
    names = {'index-url': 'UV_DEFAULT_INDEX', 'extra-index-url': 'UV_INDEX',
             'find-links': 'UV_FIND_LINKS', 'trusted-host': 'UV_INSECURE_HOST',
             'no-index': 'UV_NO_INDEX', 'cert': 'SSL_CERT_FILE'}
    # pip separates several values by spaces, uv by commas where it does not accept spaces.
    return {uv: found[pip].replace(' ', ',') if pip == 'find-links' else found[pip]
            for pip, uv in names.items() if pip in found and uv not in os.environ}


class Installer:
    """uv, or pip if uv cannot run or fails, for example behind a proxy that only pip knows."""

    def __init__(self):
        self.uv = find_uv()
        self.settings = settings_of_pip() if self.uv else {}
        if not self.uv:
            self.use_pip()

    def use_pip(self):
        self.uv = None
        run(sys.executable, '-m', 'pip', '--quiet', 'install', '-c', PINS, '--upgrade', 'pip')

    def succeeds(self, *arguments, **variables):
        """Whether uv can be used and a command of it succeeds; from then on, pip is used if not."""
        if not self.uv:
            return False
        if not subprocess.run([self.uv, *map(str, arguments)], cwd=ROOT,
                              env=os.environ | self.settings | variables).returncode:
            return True
        say('uv failed; pip installs instead, which takes longer')
        self.use_pip()
        return False

    def install(self, *arguments, again=(), **variables):
        """Install what `arguments` name, and the packages `again` even if they are installed."""
        pins = '-c', PINS, '--build-constraint', PINS
        if self.succeeds('pip', 'install', '--python', sys.executable, *pins, *arguments,
                         *(f'--reinstall-package={name}' for name in again), **variables):
            return
        run(sys.executable, '-m', 'pip', '--disable-pip-version-check', '--no-input', 'install',
            *pins, *arguments, *(['--force-reinstall', '--no-deps'] if again else []), **variables)

    def build_wheel(self, project, folder):
        """Build the wheel of a project in a folder."""
        if not self.succeeds('build', '--quiet', '--wheel', '--python', sys.executable,
                             '--build-constraint', PINS, '--out-dir', folder, project):
            run(sys.executable, '-m', 'pip', '--quiet', '--disable-pip-version-check', 'wheel',
                '--no-deps', '--build-constraint', PINS, '--wheel-dir', folder, project)


def messages_key():
    """Hash of everything that the wheel of the messages depends on."""
    digest = hashlib.sha256()
    compiler = subprocess.run([*sysconfig.get_config_var('CC').split(), '--version'],
                              capture_output=True).stdout
    for text in (PINS.read_bytes(), compiler, sysconfig.get_platform().encode(),
                 str(sysconfig.get_config_var('SOABI')).encode()):
        digest.update(hashlib.sha256(text).digest())
    for path in sorted(f for pattern in ('*.*', 'msg/*', 'srv/*', 'standard/*/*.xml',
                                         'standard/*/*/*') for f in MESSAGES.glob(pattern)):
        if path.is_file():
            digest.update(str(path.relative_to(MESSAGES)).encode())
            digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:32]


def messages_wheel(installer, cache):
    """Path of the wheel of the messages: from the cache, or built."""
    folder = ROOT / 'build' / 'messages'
    kept = cache / 'messages' / messages_key() if cache else None
    if kept and kept.is_dir() and (wheels := [*kept.glob('*.whl')]):
        say('ROS messages, as compiled earlier')
        os.utime(wheels[0])
        return wheels[0]
    say('ROS messages (generated and compiled here, about 20 s)')
    shutil.rmtree(folder, ignore_errors=True)
    installer.build_wheel(MESSAGES, folder)
    wheel, = folder.glob('*.whl')
    if kept:
        kept.mkdir(parents=True, exist_ok=True)
        shutil.copy2(wheel, kept / f'.{os.getpid()}')
        (kept / f'.{os.getpid()}').replace(kept / wheel.name)
    return wheel


def install_run(installer):
    """What running needs, with the nodes, and mag_tracking itself, editable."""
    cache = cache_folder()
    wheel = messages_wheel(installer, cache)
    say('mag_tracking and what it needs to run (compiled in part, minutes the first time)')
    variables = {'MAG_TRACKING_CACHE': str(cache / 'cores')} if cache else {}
    installer.install(wheel, again=['mag-tracking-msgs'])
    # setuptools warns about every editable package outside src/.
    installer.install('-e', '.[ros]', PYTHONWARNINGS='ignore', **variables)


def install_extras(installer, *extras):
    """The requirements of extras of the installed mag_tracking, which is not built again."""
    marks = {f'extra == {quote}{extra}{quote}' for extra in extras for quote in '\'"'}
    installer.install(*sorted({r.partition(';')[0].strip() for r in requires('mag_tracking')
                               if r.partition(';')[2].strip() in marks}))


EXTRAS = {
    'docs': ('archive', 'classes', 'docs'),
    'bench': ('archive', 'classes', 'test'),
    'test': ('archive', 'classes', 'docs', 'test'),
}


def main(stages):
    begin = time.monotonic()
    # `make -j` starts several stages at once; each waits for the one before. (uv locks .lock.)
    lock = open(Path(sys.prefix) / '.installing', 'w')
    fcntl.flock(lock, fcntl.LOCK_EX)
    installer = Installer()
    for stage in stages:
        if stage == 'run':
            install_run(installer)
        elif stage == 'colcon':
            say('colcon and the message generators')
            installer.install(*build_requires(), *colcon_requires())
        else:
            say(f'what `make {stage}` needs')
            install_extras(installer, *EXTRAS[stage])
    say(f'done in {time.monotonic() - begin:.0f} s')


if __name__ == '__main__':
    main(sys.argv[1:])
