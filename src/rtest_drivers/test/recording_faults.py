"""Faults put into recordings on purpose, and how much of each recording is then there.

Used by the tests with few points and by bench/recording_faults.py with many. What must be there is
worked out without the code under test: by the `mcap` library from the whole file, or by what the
killed process itself had noted.
"""

import os
import random
import resource
import struct
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader, breakup_chunk

from rtest_drivers import mcap_file, session_writer
from rtest_drivers.message_types import MessageTypes
from rtest_drivers.session_writer import SessionWriter
from rtest_estimation.bagfile import read_bag
from rtest_estimation.errors import UserError
from rtest_estimation.mcap_scan import McapScan

STRING = 'std_msgs/msg/String'
_TIME = struct.Struct('<q')


@dataclass
class Outcome:
    """Of faults of one kind.

    points : how many; opened : how many recordings could be read after
    lost : messages that must be there and are not
    worst : longest time at the end of a recording that is missing [s]
    told : recordings that say themselves that something is missing
    """

    points: int = 0
    opened: int = 0
    lost: int = 0
    worst: float = 0.0
    told: int = 0
    notes: dict = field(default_factory=dict)


# ---- cuts ----


def chunk_ends(path):
    """Where each chunk of a whole file ends, and how many messages are in the file up to there."""
    with path.open('rb') as file:
        places = sorted(
            index.chunk_start_offset + index.chunk_length
            for index in make_reader(file).get_summary().chunk_indexes
        )
        file.seek(0)
        counts, total = [], 0
        for record in StreamReader(file, emit_chunks=True).records:
            if type(record).__name__ == 'Chunk':
                total += sum(isinstance(inner, Message) for inner in breakup_chunk(record))
                counts.append(total)
    return list(zip(places, counts, strict=True))


def cut(path, places, folder, torn=False):
    """Cut a whole recording at each place; `torn`: zeros follow instead, as after a power cut."""
    whole = path.read_bytes()
    ends = chunk_ends(path)
    damaged = folder / 'damaged.mcap'
    outcome = Outcome()
    for place in places:
        tail = bytes(len(whole) - place) if torn else b''
        damaged.write_bytes(whole[:place] + tail)
        expected = max([count for end, count in ends if end <= place], default=0)
        outcome.points += 1
        try:
            bag = read_bag(damaged, ())
        except UserError:
            # Of less than what says that it is an MCAP file nothing can be read.
            outcome.opened += place < 8
            outcome.told += 1
            outcome.lost += expected
            continue
        outcome.opened += 1
        outcome.told += bool(bag.warnings)
        found = sum(count for _, count in bag.topics.values())
        outcome.lost += max(0, expected - found)
    return outcome


def misframe(path, count, seed, folder):
    """Change one bit in the opcode or length of a chunk of a whole recording."""
    whole = path.read_bytes()
    with path.open('rb') as file:
        summary = make_reader(file).get_summary()
    expected = summary.statistics.message_count
    places = [index.chunk_start_offset for index in summary.chunk_indexes]
    bits = [8 * place + bit for place in places for bit in range(8 * 9)]
    chance = random.Random(seed)
    damaged = folder / 'damaged.mcap'
    outcome = Outcome()
    for bit in chance.sample(bits, min(count, len(bits))):
        changed = bytearray(whole)
        changed[bit // 8] ^= 1 << bit % 8
        damaged.write_bytes(changed)
        bag = read_bag(damaged, ())
        outcome.points += 1
        outcome.opened += 1
        outcome.told += bool(bag.warnings)
        outcome.lost += abs(expected - sum(number for _, number in bag.topics.values()))
    return outcome


def random_places(path, count, seed):
    """Distinct places to cut a file at, its last byte among them."""
    size = path.stat().st_size
    return [size - 1, *random.Random(seed).sample(range(size - 1), count - 1)]


# ---- processes ----


def start(run, *arguments):
    """Run one of the functions of this file in a process of its own."""
    return subprocess.Popen(
        [sys.executable, __file__, run.__name__, *map(str, arguments)],
        stdout=subprocess.PIPE,
        text=True,
    )


def text(size, number):
    """A String of `size` letters that cannot be packed, serialised."""
    letters = random.Random(number).randbytes(size).hex()[:size].encode()
    return b'\0\1\0\0' + (size + 1).to_bytes(4, 'little') + letters + b'\0'


def open_writer(folder, **options):
    """A writer with one topic /a."""
    writer = SessionWriter(folder, **options)
    writer.add_topic('/a', MessageTypes().definition(STRING), '')
    return writer


def kill(folder, count, seed, rate=1000.0, longest=3.0, promise=1.0):
    """Kill a recording process at random moments with SIGKILL while it takes messages.

    promise : what was put longer before the end than this must be there [s]
    """
    chance = random.Random(seed)
    outcome = Outcome()
    for number in range(count):
        bag, notes = folder / f'killed{number}', folder / f'put{number}'
        child = start(record_until_killed, bag, notes, rate)
        while not notes.exists() or not notes.stat().st_size:
            time.sleep(0.001)
        time.sleep(chance.uniform(0.0, longest))
        child.kill()
        killed = time.monotonic_ns()
        child.communicate()
        noted = notes.read_bytes()
        noted = noted[: len(noted) // _TIME.size * _TIME.size]
        put = [time_ for (time_,) in _TIME.iter_unpack(noted)]
        sequences = [entry.sequence for entry in McapScan(bag / f'{bag.name}.mcap').entries()]
        outcome.points += 1
        found = read_bag(bag, ())
        outcome.opened += 1
        outcome.told += bool(found.warnings)
        # Every message in its place: the same numbers from the first on.
        whole = sequences == list(range(len(sequences)))
        due = sum(time_ < killed - promise * 1e9 for time_ in put)
        outcome.lost += max(0, due - len(sequences)) if whole else len(put)
        if len(sequences) < len(put):
            outcome.worst = max(outcome.worst, (killed - put[len(sequences)]) / 1e9)
    return outcome


def record_until_killed(bag, notes, rate):
    """Put messages at a rate for ever, and note when each was put."""
    writer = open_writer(bag)
    handle = os.open(notes, os.O_CREAT | os.O_WRONLY)
    rate = float(rate)
    begun, number = time.monotonic(), 0
    while True:
        stamp = time.monotonic_ns()
        writer.put('/a', time.time_ns(), 0, number, text(100, number))
        os.write(handle, _TIME.pack(stamp))
        number += 1
        time.sleep(max(0.0, begun + number / rate - time.monotonic()))


# ---- disks ----


def fill_disk(folder, count, seed):
    """Limit the size of the file at random, kill the process while the disk is full.

    Every other time there is room again before the end, and nothing may be missing then.
    """
    chance = random.Random(seed)
    outcome = Outcome()
    for number in range(count):
        bag, size = folder / f'full{number}', chance.randrange(2_000, 400_000)
        room = bool(number % 2)
        answer = start(record_to_full_disk, bag, size, int(room)).communicate()[0].split()
        outcome.points += 1
        found = read_bag(bag, ())
        outcome.opened += 1
        there = found.topics.get('/a', ('', 0))[1]
        before, put = int(answer[0]), int(answer[1])
        outcome.lost += max(0, (put if room else before) - there)
        outcome.told += answer[2] == 'told'
    return outcome


def record_to_full_disk(bag, size, room):
    """Tell: messages on the disk before it was full, put in all, whether it was told."""
    session_writer.FLUSH_INTERVAL = 0.02
    writer = open_writer(bag)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    number = safe = 0
    while writer.error is None:
        for _ in range(20):
            writer.put('/a', time.time_ns(), 0, number, text(500, number))
            number += 1
        wait(lambda due=number: writer.error or writer.written == due)
        stored = writer.size
        # The file has grown once more: everything that was taken before is in it.
        wait(lambda last=stored: writer.error or writer.size > last, 0.2)
        if writer.error is None and writer.size > stored:
            safe = number
    told = 'told' if 'File too large' in writer.error else 'silent'
    if room:
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
        writer.close()
    print(safe, number, told, flush=True)
    if not room:
        os._exit(0)


def wait(condition, timeout=30.0):
    """Wait for something; goes on in any case."""
    end = time.monotonic() + timeout
    while not condition() and time.monotonic() < end:
        time.sleep(0.002)


def stall(folder, memory, flood):
    """Record on a disk that does not answer; memory of the process and losses by their count.

    memory : what may wait [bytes]; flood : what is sent meanwhile [bytes]
    """
    bag = folder / 'stalled'
    answer, _ = start(record_to_stalled_disk, bag, memory, flood).communicate()
    put, dropped, waiting, before, peak = map(int, answer.split())
    found = read_bag(bag, ())
    there = found.topics['/a'][1]
    counted = f'not written /a: {dropped} messages'
    return Outcome(
        1, 1, abs(put - dropped - there), 0.0, sum(counted in text_ for text_ in found.warnings),
        {'put': put, 'dropped': dropped, 'waiting': waiting, 'grown': peak - before},
    )


def record_to_stalled_disk(bag, memory, flood):
    """Tell: put, dropped, most bytes waiting, resident memory before and at its most [bytes]."""
    mended = threading.Event()
    real = os.fsync

    def fsync(handle):
        mended.wait()
        real(handle)

    writer = open_writer(bag, memory=memory)
    mcap_file.os.fsync = fsync
    before = _resident()
    size, number, most = 10_000, 0, 0
    message = text(size, 1)
    while number * size < flood:
        # A copy each, as the middleware gives.
        writer.put('/a', time.time_ns(), 0, number, bytes(bytearray(message)))
        most = max(most, writer.waiting)
        number += 1
    peak = _peak()
    mended.set()
    writer.close()
    dropped = writer.dropped['/a']
    print(number, dropped, most, before, peak)


def _resident():
    return int(Path('/proc/self/statm').read_text().split()[1]) * resource.getpagesize()


def _peak():
    # Not getrusage, which begins with that of the process that started this one.
    (line,) = (line for line in Path('/proc/self/status').read_text().splitlines()
               if line.startswith('VmHWM'))
    return int(line.split()[1]) * 1024


if __name__ == '__main__':
    _name, _folder, *_rest = sys.argv[1:]
    globals()[_name](
        Path(_folder), *(int(part) if part.isdecimal() else part for part in _rest)
    )
