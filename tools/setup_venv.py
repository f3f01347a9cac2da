"""Set up .venv: ROS 2 Jazzy, the requirements, rtest_msgs and the packages of this repository.

Run by `make setup`, with the Python that .venv is to be made from. Where a ROS 2 Jazzy is
sourced it is used; elsewhere ROS comes as wheels (requirements-ros.txt), and tf2_msgs, which is
no wheel, from tools/tf2_msgs. Each step leaves a stamp in .venv that holds a hash of what the step
depends on: a second run does only what has changed, and a run after an interruption continues
where the stamps end.
"""

# Whoever has too old a Python must get to read so: no syntax newer than Python 3.6 here.
import fcntl
import glob
import hashlib
import importlib.util
import os
import platform
import re
import shutil
import subprocess
import sys
import sysconfig
import time
from contextlib import contextmanager

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
VENV = os.path.join(ROOT, '.venv')
PYTHON = os.path.join(VENV, 'bin', 'python')
LOG = os.path.join(VENV, 'setup.log')
MESSAGES, TRANSFORMS = 'src/rtest_msgs', 'tools/tf2_msgs'
PACKAGES = ['rtest_estimation', 'rtest_identification', 'rtest_drivers']

# The Python outside of a virtual environment that may be active.
BASE = getattr(sys, '_base_executable', sys.executable)


class SetupError(Exception):
    """What is wrong and what to do about it, in one line."""


def check(ros):
    """Raise unless this machine has what the setup needs and cannot install itself."""
    python = f'{BASE} is {platform.python_implementation()} {platform.python_version()}'
    choose = 'name another one: make PYTHON=python3.12'
    machine = f'{platform.system()} {platform.machine()}'
    if sys.version_info < (3, 10):
        raise SetupError(f'Python >= 3.10 is needed, {python}; {choose}')
    if not ros and machine != 'Linux x86_64':
        raise SetupError(f'no ROS 2 wheels for {machine}: install ROS 2 Jazzy and source it')
    if not ros and (sys.version_info >= (3, 15) or platform.python_implementation() != 'CPython'):
        raise SetupError(f'the ROS 2 wheels are for CPython 3.10 to 3.14, {python}; {choose}')

    compilers = {'CC': ['cc', 'gcc', 'clang'], 'CXX': ['c++', 'g++', 'clang++']}
    header = os.path.join(sysconfig.get_path('include'), 'Python.h')
    needs = [
        ('cmake', 'cmake', shutil.which('cmake')),
        ('make', 'make', shutil.which('make') or shutil.which('gmake')),
        ('a C compiler', 'gcc', 'CC' in os.environ or any(map(shutil.which, compilers['CC']))),
        ('a C++ compiler', 'g++', 'CXX' in os.environ or any(map(shutil.which, compilers['CXX']))),
        ('the C headers of ' + BASE, 'python3-dev', os.path.isfile(header)),
        ('the module venv of ' + BASE, 'python3-venv', importlib.util.find_spec('ensurepip')),
    ]
    missing = [need for need in needs if not need[2]]
    if missing:
        what, debian = ', '.join(n[0] for n in missing), ' '.join(n[1] for n in missing)
        raise SetupError(f'missing: {what}; on Debian or Ubuntu: sudo apt-get install {debian}')


def find_ros(env):
    """Return whether a ROS 2 Jazzy is sourced that this Python can use.

    If not, whatever else is sourced is taken out of `env`, so that it cannot mix with the wheels.
    """
    if env.get('ROS_DISTRO') == 'jazzy':
        quiet = {'stdout': subprocess.DEVNULL, 'stderr': subprocess.DEVNULL}
        if subprocess.run([BASE, '-c', 'import rclpy'], env=env, **quiet).returncode == 0:
            return True
        print(f'setup: the sourced ROS 2 Jazzy is not for {BASE}: using wheels instead')
    elif env.get('ROS_DISTRO'):
        print(f'setup: ROS {env["ROS_DISTRO"]} is sourced, not jazzy: using wheels instead')
    for name in ('AMENT', 'CMAKE', 'COLCON'):
        env.pop(f'{name}_PREFIX_PATH', None)
    for name in ('PYTHONPATH', 'LD_LIBRARY_PATH', '_ROS_WHEELS_BOOTSTRAP_COMPLETE'):
        env.pop(name, None)
    return False


def digest(*patterns, also=''):
    """Return a hash of the names and contents of the files that match, and of a text."""
    total = hashlib.sha256(also.encode())
    for pattern in patterns:
        for name in sorted(glob.glob(os.path.join(ROOT, pattern))):
            with open(name, 'rb') as file:
                total.update(f'\n{name}\n'.encode() + hashlib.sha256(file.read()).digest())
    return total.hexdigest()


def stamp_of(name):
    """Return the path of a step's stamp."""
    return os.path.join(VENV, f'.stamp-{name}')


def read_stamp(name):
    """Return what a stamp holds; nothing where the step was not finished."""
    try:
        with open(stamp_of(name)) as file:
            return file.read()
    except OSError:
        return ''


@contextmanager
def step(name, key, what):
    """Show a step; there is no stamp while it runs, and a new one only if it succeeds."""
    if os.path.exists(stamp_of(name)):
        os.remove(stamp_of(name))
    print(f'setup: {what} ...', end='', flush=True)
    start = time.monotonic()
    try:
        yield
    except BaseException:
        print(' failed', flush=True)
        raise
    with open(stamp_of(name), 'w') as file:
        file.write(key)
    print(f' {time.monotonic() - start:.0f} s', flush=True)


def run(env, *command):
    """Run a command with its output in the log; raise, showing the end of it, if it fails."""
    with open(LOG, 'a') as log:
        print('\n$', *command, file=log, flush=True)
        done = subprocess.run(command, env=env, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    if done.returncode:
        with open(LOG, errors='replace') as log:
            print(*log.read().splitlines()[-25:], sep='\n', file=sys.stderr)
        raise SetupError(f'{command[0]} failed, its whole output is in {LOG}')


def pip_install(env, *words):
    """Install into .venv."""
    run(env, PYTHON, '-m', 'pip', '--disable-pip-version-check', 'install', *words)


def ask(env, code):
    """Return the lines that the Python of .venv prints."""
    done = subprocess.run([PYTHON, '-c', code], env=env, stdout=subprocess.PIPE, check=True)
    return done.stdout.decode().splitlines()


def site_packages(env):
    """Return the folder of .venv that holds the Python packages."""
    return ask(env, 'import sysconfig; print(sysconfig.get_path("purelib"))')[0]


def make_venv(env, ros):
    """Start .venv from nothing."""
    shutil.rmtree(VENV, ignore_errors=True)
    os.makedirs(VENV)
    run(env, BASE, '-m', 'venv', *(['--system-site-packages'] if ros else []), VENV)


def install_requirements(env, ros):
    """Install what others made, and make it work from anywhere without sourcing."""
    kinds = ['', '-dev'] if ros else ['', '-dev', '-ros']
    pip_install(env, *(f'-r{ROOT}/requirements{kind}.txt' for kind in kinds))
    packages = site_packages(env)
    shutil.copy(os.path.join(ROOT, 'tools', 'rtest_environment.py'), packages)
    # Python reads .pth files in the order of their names: the underscore puts this one before
    # that of the wheels, which does the same but with the folders in random order.
    with open(os.path.join(packages, '_rtest_environment.pth'), 'w') as file:
        file.write('import rtest_environment\n')
    if not ros:
        repair_wheels(env)


def repair_wheels(env):
    """Put this machine's include folders where the wheels name those of their build machine."""
    code = 'import {0}; print({0}.{1})'
    (python_include,) = ask(env, code.format('sysconfig', 'get_path("include")'))
    (numpy_include,) = ask(env, code.format('numpy', 'get_include()'))
    for name in glob.glob(os.path.join(VENV, 'share', '**', '*.cmake'), recursive=True):
        with open(name) as file:
            old = file.read()
        new = re.sub(r'/opt/python/[^;"]*/numpy/_core/include', numpy_include, old)
        new = re.sub(r'/opt/python/[^;"/]*/include/python[^;"/]*', python_include, new)
        if new != old:
            with open(name, 'w') as file:
                file.write(new)


def build_messages(env, folder):
    """Build a package of messages into .venv, the prefix that is found without sourcing."""
    name = os.path.basename(folder)
    build = os.path.join(VENV, 'build', name)
    packages = site_packages(env)
    # From nothing: a message that was renamed must not live on.
    for parent in (packages, os.path.join(VENV, 'share'), os.path.join(VENV, 'include')):
        shutil.rmtree(os.path.join(parent, name), ignore_errors=True)
    shutil.rmtree(build, ignore_errors=True)
    prefixes = [VENV, *env.get('AMENT_PREFIX_PATH', '').split(os.pathsep)]
    env = dict(env, AMENT_PREFIX_PATH=os.pathsep.join(filter(None, prefixes)))
    settings = {
        'CMAKE_BUILD_TYPE': 'Release',
        'CMAKE_INSTALL_PREFIX': VENV,
        'CMAKE_PREFIX_PATH': ';'.join(filter(None, prefixes)),
        'Python3_EXECUTABLE': PYTHON,
        'PYTHON_INSTALL_DIR': os.path.relpath(packages, VENV),
        'BUILD_TESTING': 'OFF',
    }
    source = os.path.join(ROOT, folder)
    run(env, 'cmake', '-S', source, '-B', build, *(f'-D{k}={v}' for k, v in settings.items()))
    run(env, 'cmake', '--build', build, '--parallel', str(os.cpu_count() or 1))
    run(env, 'cmake', '--install', build)


def install_packages(env):
    """Install the Python packages of this repository so that edits take effect at once."""
    # An interruption can leave metadata that pip then refuses to replace.
    for old in glob.glob(os.path.join(site_packages(env), 'rtest_*.dist-info')):
        shutil.rmtree(old)
    folders = [os.path.join(ROOT, 'src', name) for name in PACKAGES]
    # Not pip's old way, setup.py develop: it puts the commands where ROS wants them, see
    # setup.cfg, and not into .venv/bin.
    editable = [word for folder in folders for word in ('-e', folder)]
    pip_install(env, '--use-pep517', '--no-build-isolation', '--no-deps', *editable)
    # What pip leaves out: launch/ and config/ under the names that an installation has in ROS.
    index = os.path.join(VENV, 'share', 'ament_index', 'resource_index', 'packages')
    os.makedirs(index, exist_ok=True)
    for name, folder in zip(PACKAGES, folders, strict=True):
        link(folder, os.path.join(VENV, 'share', name))
        link(os.path.join(folder, 'resource', name), os.path.join(index, name))


def link(target, name):
    """Make or replace a symbolic link."""
    if os.path.islink(name):
        os.remove(name)
    os.symlink(target, name)


def setup():
    """Do what is left to do."""
    env = dict(os.environ)
    ros = find_ros(env)
    check(ros)
    # Two set-ups at once would spoil each other's work: the second waits for the first.
    fcntl.flock(os.open(ROOT, os.O_RDONLY), fcntl.LOCK_EX)

    # What .venv does not survive: another place, another Python, another ROS. It starts from
    # nothing too after an interrupted installation, whose half-unpacked wheels pip would keep.
    base = ' '.join([ROOT, BASE, *sys.version.split(), 'sourced' if ros else 'wheels'])
    tools = ['tools/setup_venv.py', 'tools/rtest_environment.py']
    required = base + '\n' + digest('requirements*.txt', *tools)
    messages, transforms = (
        digest('requirements-ros.txt', f'{folder}/*.*', f'{folder}/msg/*.msg', also=base)
        for folder in (MESSAGES, TRANSFORMS)
    )
    packages = digest('src/rtest_*/setup.*', also=base)

    stamp = read_stamp('requirements')
    if stamp.split('\n')[0] != base:
        make_venv(env, ros)
    if stamp != required:
        what = 'the requirements, ROS 2 sourced' if ros else 'the requirements, ROS 2 as wheels'
        with step('requirements', required, f'{what} (about a minute)'):
            install_requirements(env, ros)
    if read_stamp('messages') != messages:
        with step('messages', messages, 'rtest_msgs'):
            build_messages(env, MESSAGES)
    # Where a ROS is sourced it has its own, and two of one name must not meet.
    if not ros and read_stamp('tf2_msgs') != transforms:
        with step('tf2_msgs', transforms, 'tf2_msgs'):
            build_messages(env, TRANSFORMS)
    if read_stamp('packages') != packages:
        with step('packages', packages, ', '.join(PACKAGES)):
            install_packages(env)


def main():
    """Run the set-up; return the exit status."""
    try:
        setup()
    except SetupError as error:
        print(f'setup: {error}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print('setup: interrupted; make setup continues', file=sys.stderr)
        return 130
    return 0


if __name__ == '__main__':
    sys.exit(main())
