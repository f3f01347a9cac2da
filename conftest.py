"""What every test needs before numpy is imported."""

import os
import signal
import time
from collections.abc import Iterator

import pytest

# The problems are small: more threads than one are slower, and not bit for bit repeatable. The
# command and the launch file set the same.
for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS'):
    os.environ.setdefault(_name, '1')

# A shell that starts something in the background makes it, and all that it starts, deaf to Ctrl-C;
# the tests end some of what they start by it.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope='session', autouse=True)
def _nothing_is_left() -> Iterator[None]:
    """Some tests kill nodes, which then leave their shared memory and sockets."""
    started = time.time()
    yield
    from rtest_drivers.processes import remove_dead_shared_memory, remove_dead_sockets

    remove_dead_shared_memory(started - 1.0)
    remove_dead_sockets()
