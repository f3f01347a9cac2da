"""How much of a recording is there after a fault: many random points of each kind, as a table.

    python bench/recording_faults.py [--points N] [--kills N] [--seed N]

Cuts: the bags of the project are cut, or zeroed from there on, at random places; everything in the
chunks before, as the mcap library counts them in the whole file, must be read. Bits: one in the
opcode or length of a chunk is changed; everything must be read. Kills: a process that records
1,000 messages a second is killed with SIGKILL at random moments; everything that was put more than
a second before must be there. Full disk: the file may not grow beyond a random size; what was on
the disk must stay, and where there is room again nothing may be missing. Stalled disk: fsync does
not return while four times the allowed memory is sent; memory must stay within it, and what was
not written must be counted in the recording.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'src/rtest_drivers/test'))

from recording_faults import Outcome, cut, fill_disk, kill, misframe, random_places, stall

from rtest_drivers.mcap_file import McapFile
from rtest_drivers.message_types import MessageTypes

_ROOT = Path(__file__).resolve().parents[1]
_MEMORY = 64_000_000


def _row(name: str, outcome: Outcome) -> str:
    worst = f'{outcome.worst:.2f}' if outcome.worst else '-'
    return (
        f'{name:34} {outcome.points:7d} {outcome.opened:7d} {outcome.told:7d} {outcome.lost:13d} '
        f'{worst:>12}'
    )


def _tiny(folder: Path) -> Path:
    """A whole recording of a few chunks, small enough to be cut at every byte."""
    file = McapFile(folder / 'tiny')
    definition = MessageTypes().definition('std_msgs/msg/String')
    file.add_topic('/a', definition.name, definition.text, definition.type_hash)
    for number in range(9):
        file.write('/a', 1_700_000_000_000_000_000 + number, 0, number, b'\0\1\0\0\2\0\0\0x\0')
        if number % 3 == 2:
            file.flush()
    file.close()
    return file.path


def main() -> None:
    """Print the table; exit status 1 where something was lost."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument('--points', type=int, default=400, help='cuts of each bag')
    options.add_argument('--kills', type=int, default=30)
    options.add_argument('--seed', type=int, default=1)
    chosen = options.parse_args()
    print(
        f'{"fault":34} {"points":>7} {"opened":>7} {"told":>7} {"lost messages":>13} '
        f'{"worst end/s":>12}'
    )
    lost = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tiny = _tiny(folder)
        whole = range(tiny.stat().st_size)
        rows = [('every byte of a small file: cut', lambda: cut(tiny, whole, folder)),
                ('every byte: zeros from there on', lambda: cut(tiny, whole, folder, True))]
        for bag in ('short', 'open-01'):
            path = _ROOT / 'bags' / bag / f'{bag}.mcap'
            places = random_places(path, chosen.points, chosen.seed)
            rows += [
                (f'{bag}: cut', lambda p=path, q=places: cut(p, q, folder)),
                (f'{bag}: zeros from there on', lambda p=path, q=places: cut(p, q, folder, True)),
                (f'{bag}: a bit before a chunk',
                 lambda p=path: misframe(p, chosen.points, chosen.seed, folder)),
            ]
        rows += [
            ('killed with SIGKILL', lambda: kill(folder, chosen.kills, chosen.seed)),
            ('disk full', lambda: fill_disk(folder, chosen.kills, chosen.seed)),
            ('disk stalled', lambda: stall(folder, _MEMORY, 4 * _MEMORY)),
        ]
        for label, run in rows:
            outcome = run()
            lost += outcome.lost
            print(_row(label, outcome), flush=True)
            if outcome.notes:
                print(
                    f'{"":4}allowed to wait {_MEMORY / 1e6:.0f} MB, waited '
                    f'{outcome.notes["waiting"] / 1e6:.1f} MB, memory of the process grew by '
                    f'{outcome.notes["grown"] / 1e6:.1f} MB; {outcome.notes["dropped"]} of '
                    f'{outcome.notes["put"]} messages not written, and counted'
                )
    sys.exit(1 if lost else 0)


if __name__ == '__main__':
    main()
