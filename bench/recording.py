"""Time and memory of identifying a long recording beside other readers of the same file.

    python bench/recording.py [--minutes 60] [--folder /tmp]

The session: nest calibration and a static cycle of 7 x 12 poses at each of four sphere positions,
three gauges at 1 kHz in messages of ten readings, encoder feedback at 100 Hz; an hour of it is
3.6 million readings in 720,000 messages. Each reader runs in a process of its own; ratios are of
processor time, which other programs on the computer change less than the time that passes.

The plain script is what one would write for this session alone: rosbags, numpy, and
`scipy.linalg.lstsq` with a Jacobian from finite differences. It knows when the machine stood,
takes plain means, and gives values without uncertainty.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROOT = Path(__file__).resolve().parents[1]
MACHINE = ROOT / 'src/rtest_drivers/config/nmv1500dcg.yaml'
START = 1_700_000_000_000_000_000
GAUGE_HZ, BATCH, FEEDBACK_HZ = 1000, 10, 100
MOVE_S = 0.5
SETUPS = {'1a': (0, -0.09, 0.0406), '1b': (0, -0.09, 0.1406), '2a': (0, 0, 0.0406),
          '2b': (0, 0, 0.1406)}
ERRORS = {('B', 'X'): 8e-6, ('B', 'A'): 3e-5, ('C', 'A'): -4e-5, ('C', 'X'): -6e-6}
# Gauge directions of a nest whose gauges stand at right angles.
NEST = np.linalg.qr(np.array([[1.0, 1.0, 1.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 2.0]]).T)[0]
NOISE = 3e-7
READERS = ('rosbags', 'identify', 'mcap-ros2-support', 'script')


# --- the session ---


def make_session(path: Path, minutes: float) -> None:
    """Write a session of a machine with some location errors as a bare MCAP file."""
    from rtest_identification.kinematics import predict
    from rtest_identification.machine import load_machine
    from rtest_identification.plans import nest_calibration, static

    machine = load_machine(MACHINE)
    errors = np.zeros((len(machine.letters), 6))
    for (axis, letter), value in ERRORS.items():
        errors[machine.letters.index(axis), 'ABCXYZ'.index(letter)] = value
    outer, inner = np.radians(np.arange(-75, 76, 25)), np.radians(np.arange(12) * 30.0)
    plans = []
    for name, sphere in SETUPS.items():
        plans.append(nest_calibration(machine, name, np.array(sphere)))
        plans.append(static(machine, name, np.array(sphere), outer, inner))
    poses = sum(len(plan.commands) for plan in plans)
    dwell = minutes * 60.0 / (poses + len(plans)) - MOVE_S
    if dwell < 0.2:
        sys.exit(f'--minutes {minutes:g}: too short for {poses} poses')
    rng = np.random.default_rng(1)
    store, writer, channels, file = _open(path)
    _write(writer, channels['/rtest/machine'], START,
           store.serialize_cdr(store.types['std_msgs/msg/String'](data=machine.text),
                               'std_msgs/msg/String'))
    begin, sequence = START, 0
    for plan in plans:
        _write(writer, channels['/rtest/plan'], begin, _plan_message(store, plan, begin, dwell))
        knots, rows = [0.0], [plan.commands[0]]
        for row in plan.commands:
            knots += [knots[-1] + MOVE_S, knots[-1] + MOVE_S + dwell]
            rows += [row, row]
        rows = np.array(rows)
        error = predict(machine, plan.commands, errors).centre - plan.sphere
        reading = (error @ NEST.T)[np.repeat(np.arange(len(error)), 2)]
        reading = np.concatenate([reading[:1], reading])
        length = round((knots[-1] + MOVE_S) * 10) / 10
        t = np.arange(round(length * GAUGE_HZ)) / GAUGE_HZ
        values = np.stack([np.interp(t, knots, reading[:, k]) for k in range(3)], axis=1)
        values += NOISE * rng.normal(size=values.shape)
        gauges = _gauge_messages(store, begin, sequence, values)
        sequence += len(values)
        t = np.arange(round(length * FEEDBACK_HZ)) / FEEDBACK_HZ
        positions = np.stack([np.interp(t, knots, rows[:, k]) for k in range(rows.shape[1])], 1)
        encoders = _feedback_messages(store, begin, plan.axes, positions)
        for one, other in zip(gauges, encoders, strict=True):
            for topic, (stamp, data) in (('/rtest/cnc/feedback', other), ('/rtest/gauges', one)):
                _write(writer, channels[topic], stamp, data)
        begin += round(length * 1e9)
    writer.finish()
    file.close()


def _open(path: Path) -> tuple:
    store = get_typestore(Stores.ROS2_JAZZY)
    for kind in ('GaugeSamples', 'CyclePlan'):
        text = (ROOT / f'src/rtest_msgs/msg/{kind}.msg').read_text()
        store.register(get_types_from_msg(text, f'rtest_msgs/msg/{kind}'))
    file = path.open('wb')
    writer = Writer(file, compression=CompressionType.ZSTD)
    writer.start(profile='ros2', library='bench')
    channels = {}
    for topic, kind in (
        ('/rtest/machine', 'std_msgs/msg/String'), ('/rtest/plan', 'rtest_msgs/msg/CyclePlan'),
        ('/rtest/cnc/feedback', 'sensor_msgs/msg/JointState'),
        ('/rtest/gauges', 'rtest_msgs/msg/GaugeSamples'),
    ):
        text = store.generate_msgdef(kind, ros_version=2)[0]
        schema = writer.register_schema(kind, 'ros2msg', text.encode())
        channels[topic] = writer.register_channel(topic, 'cdr', schema)
    return store, writer, channels, file


def _write(writer: Writer, channel: int, stamp: int, data: bytes) -> None:
    writer.add_message(channel, log_time=stamp, publish_time=stamp, data=bytes(data))


def _header(store: object, stamp: int, frame: str) -> object:
    time_type = store.types['builtin_interfaces/msg/Time']
    header = store.types['std_msgs/msg/Header']
    return header(stamp=time_type(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id=frame)


def _plan_message(store: object, plan: object, stamp: int, dwell: float) -> bytes:
    point = store.types['geometry_msgs/msg/Point']
    message = store.types['rtest_msgs/msg/CyclePlan'](
        header=_header(store, stamp, 'machine'), session='bench', cycle=plan.cycle,
        kind=int(plan.kind), setup=plan.setup, sphere=point(*map(float, plan.sphere)),
        axes=list(plan.axes), commands=plan.commands.ravel(), dwell=dwell, feed=0.0,
    )
    return store.serialize_cdr(message, 'rtest_msgs/msg/CyclePlan')


def _gauge_messages(store: object, begin: int, sequence: int, values: np.ndarray) -> list:
    """(stamp, data) of every batch, made from one serialised message by exchanging its numbers."""
    count = len(values) // BATCH
    mark = np.full(BATCH * 3, np.pi)
    message = store.types['rtest_msgs/msg/GaugeSamples'](
        header=_header(store, begin, 'nest'), sequence=2**60 + 7, period=1.0 / GAUGE_HZ,
        channels=3, displacement=mark, status=np.zeros(BATCH * 3, dtype=np.uint8),
    )
    data = bytes(store.serialize_cdr(message, 'rtest_msgs/msg/GaugeSamples'))
    stamps = begin + np.arange(count) * (BATCH * 10**9 // GAUGE_HZ)
    return _exchanged(data, stamps, {
        data.index(np.uint64(2**60 + 7).tobytes()):
            (sequence + BATCH * np.arange(count, dtype=np.uint64))[:, None],
        data.index(mark.tobytes()): values.reshape(count, -1),
    })


def _feedback_messages(store: object, begin: int, axes: tuple, positions: np.ndarray) -> list:
    mark = np.full(len(axes), np.pi)
    message = store.types['sensor_msgs/msg/JointState'](
        header=_header(store, begin, ''), name=list(axes), position=mark,
        velocity=np.empty(0), effort=np.empty(0),
    )
    data = bytes(store.serialize_cdr(message, 'sensor_msgs/msg/JointState'))
    stamps = begin + np.arange(len(positions)) * (10**9 // FEEDBACK_HZ)
    return _exchanged(data, stamps, {data.index(mark.tobytes()): positions})


def _exchanged(data: bytes, stamps: np.ndarray, fields: dict[int, np.ndarray]) -> list:
    rows = np.tile(np.frombuffer(data, np.uint8), (len(stamps), 1))
    seconds = np.stack([stamps // 10**9, stamps % 10**9], axis=1).astype('<u4')
    for place, values in ((4, seconds), *fields.items()):
        raw = np.ascontiguousarray(values).view(np.uint8).reshape(len(stamps), -1)
        rows[:, place : place + raw.shape[1]] = raw
    return [(int(stamp), row.tobytes()) for stamp, row in zip(stamps, rows, strict=True)]


# --- the readers: each returns what it found, in words ---


def rosbags(path: Path) -> str:
    """Deserialise every message, nothing else."""
    from rosbags.highlevel import AnyReader

    count = 0
    with AnyReader([path]) as reader:
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
            count += 1
    return f'{count} messages'


def mcap_ros2_support(path: Path) -> str:
    """The same with the reader of the MCAP project."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with path.open('rb') as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        count = sum(1 for _ in reader.iter_decoded_messages())
    return f'{count} messages'


def identify(path: Path) -> str:
    """Everything that `rtest identify` does before it draws."""
    from rtest_identification.offline import identify_recording

    found = identify_recording(path, progress=lambda line: print(f'    {line}', file=sys.stderr))
    truth = {f'E_{letter}(0{"Y" if axis == "B" else "B"}){axis}': value
             for (axis, letter), value in ERRORS.items()}
    worst = max(
        abs(value - truth.get(symbol, 0.0)) / stddev
        for symbol, value, stddev in zip(
            found.location.symbols, found.location.value, found.location.stddev, strict=True
        )
    )
    return f'{len(found.observations)} poses, off by {worst:.1f} stddev at most'


def script(path: Path) -> str:
    """What one would write by hand for this one session."""
    import scipy.linalg
    from rosbags.highlevel import AnyReader

    from rtest_identification.kinematics import predict
    from rtest_identification.machine import load_machine
    from rtest_identification.symbols import location_parameters

    machine, plans, stamps, readings = load_machine(MACHINE), [], [], []
    with AnyReader([path]) as reader:
        for connection, _, data in reader.messages():
            if connection.msgtype.endswith(('GaugeSamples', 'CyclePlan')):
                message = reader.deserialize(data, connection.msgtype)
                stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
                if connection.msgtype.endswith('CyclePlan'):
                    plans.append((stamp, message))
                else:
                    rows = message.displacement.reshape(-1, 3)
                    stamps.append(stamp + np.arange(len(rows)) * round(message.period * 1e9))
                    readings.append(rows)
    t, d = np.concatenate(stamps), np.concatenate(readings)
    columns = [p.column for p in location_parameters(machine)]
    rows, targets, nest = [], [], None
    for number, (stamp, plan) in enumerate(plans):
        commands = plan.commands.reshape(-1, len(plan.axes))
        arrive = stamp + (MOVE_S + np.arange(len(commands)) * (MOVE_S + plan.dwell)) * 1e9
        first = np.searchsorted(t, arrive + 0.1e9)
        last = np.searchsorted(t, arrive + plan.dwell * 1e9)
        means = np.array([d[a:b].mean(axis=0) for a, b in zip(first, last, strict=True)])
        if plan.kind == 2:
            steps = commands[:, :3] - commands[0, :3]
            nest = scipy.linalg.lstsq(steps, means - means[0])[0]
            continue
        measured = (means - means[0]) @ np.linalg.inv(nest)
        base, zero = predict(machine, commands).centre, np.zeros((len(machine.letters), 6))
        block = np.zeros((len(commands), 3, len(columns) + 3 * len(plans)))
        for k, column in enumerate(columns):
            step = zero.copy()
            step.flat[column] = 1e-6
            block[:, :, k] = (predict(machine, commands, step).centre - base) / 1e-6
        block[:, :, len(columns) + 3 * number : len(columns) + 3 * number + 3] = np.eye(3)
        rows.append(block.reshape(-1, block.shape[2]))
        targets.append((measured - (base - base[0])).ravel())
    scipy.linalg.lstsq(np.concatenate(rows), np.concatenate(targets))
    return f'{sum(len(r) for r in rows) // 3} poses'


# --- the table ---


def _measure(name: str, path: Path) -> dict:
    """Run one reader here; time, memory and what it found."""
    function = {'rosbags': rosbags, 'identify': identify, 'script': script,
                'mcap-ros2-support': mcap_ros2_support}[name]
    begin, cpu = time.perf_counter(), time.process_time()
    found = function(path)
    return {'wall': time.perf_counter() - begin, 'cpu': time.process_time() - cpu,
            'memory': resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 'found': found}


def main() -> None:
    """Make the session where there is none, run every reader, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--minutes', type=float, default=60.0)
    parser.add_argument('--folder', type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument('--reader', choices=READERS, help='this one alone, in this process')
    arguments = parser.parse_args()
    path = arguments.folder / f'rtest-bench-{arguments.minutes:g}min.mcap'
    if arguments.reader:
        print(json.dumps(_measure(arguments.reader, path)))
        return
    if not path.exists():
        print(f'writing {path}', file=sys.stderr)
        make_session(path, arguments.minutes)
    results = {}
    for name in READERS:
        print(f'  {name}', file=sys.stderr)
        done = subprocess.run(
            [sys.executable, __file__, '--minutes', str(arguments.minutes), '--folder',
             str(arguments.folder), '--reader', name], stdout=subprocess.PIPE, check=True,
        )
        results[name] = json.loads(done.stdout)
    base = results['rosbags']
    print(f'{path}, {path.stat().st_size / 1e6:.0f} MB')
    print(f'{"":18}{"CPU [s]":>9}{"wall [s]":>10}{"ratio":>8}{"peak [MB]":>11}  found')
    for name, row in results.items():
        print(f'{name:18}{row["cpu"]:9.2f}{row["wall"]:10.2f}{row["cpu"] / base["cpu"]:8.2f}'
              f'{row["memory"]:11.0f}  {row["found"]}')


if __name__ == '__main__':
    main()
