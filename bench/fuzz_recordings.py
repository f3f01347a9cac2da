"""Read recordings that were changed at random, for as long as is wanted.

    python bench/fuzz_recordings.py [--seconds N] [--first SEED] [--keep DIR]

A good session is changed in its bytes, the values of its messages, its definitions, its machine
or its order, and read by everything that reads recordings. It must end in a description or in one
line. What ends otherwise is a bug: the recording is kept in DIR (default: the corpus of the
tests), and its seed and error are printed.
"""

from __future__ import annotations

import argparse
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path
from typing import NoReturn

_TESTS = [str(Path(__file__).resolve().parents[1] / f'src/rtest_{name}/test')
          for name in ('drivers', 'estimation')]
sys.path[:0] = _TESTS

import hostile  # noqa: E402  # found in the folder of the tests

_MEMORY = 4 << 30
# A recording of this size is read in a tenth of a second.
_TIMEOUT_S = 30


def _too_long(*_: object) -> NoReturn:
    raise TimeoutError(f'not read in {_TIMEOUT_S} s')


def main() -> None:
    """Fuzz; exit status 1 where a bug was found."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument('--seconds', type=float, default=60.0)
    options.add_argument('--first', type=int, default=1_000_000, metavar='SEED')
    options.add_argument('--keep', type=Path, default=Path(_TESTS[0]) / 'corpus', metavar='DIR')
    chosen = options.parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    signal.signal(signal.SIGALRM, _too_long)
    warnings.simplefilter('error')
    chosen.keep.mkdir(parents=True, exist_ok=True)
    answers: Counter[str] = Counter()
    bugs, slowest, seed = 0, 0.0, chosen.first
    deadline = time.monotonic() + chosen.seconds
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / 'changed.mcap'
        mutator = hostile.Mutator(Path(name))
        while time.monotonic() < deadline:
            mutator.mutated(seed, path)
            begun = time.monotonic()
            signal.alarm(_TIMEOUT_S)
            try:
                answer = hostile.read(path, identify=seed % 4 == 0)
                answers[answer.replace(str(path), '')[:50]] += 1
            # Whatever it is, it is what is looked for.
            except Exception:
                bugs += 1
                kept = chosen.keep / f'seed_{seed}.mcap'
                kept.write_bytes(path.read_bytes())
                print(f'seed {seed}, kept as {kept}:', traceback.format_exc(limit=-3), flush=True)
            finally:
                signal.alarm(0)
            slowest = max(slowest, time.monotonic() - begun)
            seed += 1
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    for answer, count in answers.most_common(20):
        print(f'{count:7d}  {answer}')
    print(
        f'{seed - chosen.first} recordings, {bugs} bugs, slowest {slowest:.2f} s, '
        f'memory {peak:.0f} MB'
    )
    sys.exit(1 if bugs else 0)


if __name__ == '__main__':
    main()
