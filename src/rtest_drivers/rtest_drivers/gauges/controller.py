"""One controller: a thread that asks it, and says when it is lost and when it is back."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence

from rtest_drivers.clock import HostClock
from rtest_drivers.gauges.align import Sample
from rtest_drivers.gauges.config import ControllerConfig
from rtest_drivers.gauges.frames import (
    Command,
    Framer,
    IllegalFrame,
    OtherAnswer,
    Query,
    Reading,
    bad,
)
from rtest_drivers.gauges.transport import Port
from rtest_estimation.records import Status

# A question fails and there was no legal answer for so long: the controller is lost [s].
LOST_S = 0.7
# Longest wait for a command of the set-up to be done [s].
_SETUP_S = 1.0
# An input silent for so long holds no late answer; that is waited for so long at most [s].
_QUIET_S, _NOISY_S = 0.5, 1.0
_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.2, 5.0


class Controller:
    """Asks one controller over and over; opens its line again, with back-off, when it is lost.

    deliver : called in the thread with the index of the query and what it gave
    changed : called in the thread when `problem` has changed

    The stamp of a reading is the middle between the question and the first byte of the answer,
    and half of that time its uncertainty; where the device says when it takes the reading, the
    stamp follows that. An answer that is not legal is a reading with a device error. After it, and
    after a time-out, the right one may still be under way: it is waited for and thrown away, so
    that it does not pass for the next one. Where the protocol has a fence that is certain, else
    answers that come more than _QUIET_S after the time-out are not recognised.

    problem : '' while it answers, else one line; None before the first attempt has ended
    failure : an exception that is a bug and ended the thread
    answers, errors, others, dropped, reconnects : counts of legal answers, of questions without
        one, of answers to another question, of bytes thrown away, of lines opened again
    faults : readings with a device error, for whatever reason
    uncertainty : largest one of the stamps since it was last set to zero [s]
    note : why the last reading was not valid
    """

    def __init__(
        self,
        config: ControllerConfig,
        clock: HostClock,
        deliver: Callable[[int, Sample], None],
        changed: Callable[[], None],
    ) -> None:
        self.config = config
        self._clock, self._deliver, self._changed = clock, deliver, changed
        self.problem: str | None = None
        self.failure: Exception | None = None
        self.answers = self.errors = self.others = self.dropped = self.reconnects = 0
        self.faults = 0
        self.uncertainty = 0.0
        self.note = ''
        self._framer, self._answered = Framer(config.protocol), 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=config.port, daemon=True)

    @property
    def name(self) -> str:
        """Port and protocol, as messages name it."""
        return f'{self.config.port} ({self.config.name})'

    def start(self) -> None:
        """Begin asking."""
        self._thread.start()

    def stop(self) -> None:
        """End asking, without waiting for it."""
        self._stop.set()

    def join(self) -> None:
        """Wait for the end."""
        self._thread.join()

    # --- the thread ---

    def _run(self) -> None:
        wait = 0.0
        try:
            while not self._stop.wait(wait):
                before = self.answers
                try:
                    self._connect()
                except ConnectionError as error:
                    self._set(str(error))
                wait = _FIRST_WAIT_S if self.answers > before else 2.0 * wait or _FIRST_WAIT_S
                wait = min(wait, _LONGEST_WAIT_S)
        except Exception as error:
            self.failure = error
            self._changed()

    def _connect(self) -> None:
        """Open the line and ask until it is lost or asking ends."""
        protocol, lost = self.config.protocol, self.problem
        port = Port(self.config.port, self.config.line)
        try:
            for command in protocol.setup:
                self._do(port, command, _SETUP_S)
            self._resynchronise(port, _SETUP_S)
            due = self._answered = time.monotonic()
            while not self._stop.wait(max(0.0, due - time.monotonic())):
                # What could not be asked in time is left out, not caught up with.
                due = max(due, time.monotonic() - 1.0 / self.config.rate) + 1.0 / self.config.rate
                for index, query in enumerate(protocol.queries):
                    if self._ask(port, index, query) and self.problem != '':
                        self.reconnects += lost is not None
                        self._set('')
        finally:
            port.close()

    def _ask(self, port: Port, index: int, query: Query) -> bool:
        """One question and its answer; returns whether that was legal."""
        self.dropped += port.drop()
        self._framer.clear()
        port.write(query.send)
        asked = time.monotonic_ns()
        limit, first, heard = asked + round(self.config.timeout * 1e9), 0, b''
        while (now := time.monotonic_ns()) < limit:
            data = port.read((limit - now) * 1e-9)
            first = first or time.monotonic_ns()
            heard += data
            for frame in self._framer.feed(data):
                try:
                    readings = query.read(frame)
                except OtherAnswer as error:
                    self.others += 1
                    self.note, first = str(error), 0
                except IllegalFrame as error:
                    return self._failed(port, index, query, str(error))
                else:
                    self.answers += 1
                    self._answered = time.monotonic()
                    self._give(index, self._stamp(asked, first or time.monotonic_ns()), readings)
                    return True
        said = f'only {heard[-40:]!r}' if heard else 'nothing'
        text = f'{said} came within {self.config.timeout:g} s'
        return self._failed(port, index, query, text)

    def _failed(self, port: Port, index: int, query: Query, reason: str) -> bool:
        self.errors += 1
        stamp = self._clock.now(), 0.0
        self._give(index, stamp, bad(Status.DEVICE_ERROR, reason, query.outputs))
        if time.monotonic() - self._answered > LOST_S:
            raise self._silence(f'no legal answer for {LOST_S} s')
        self._resynchronise(port, self.config.timeout)
        return False

    def _stamp(self, asked: int, first: int) -> tuple[int, float]:
        """Stamp [ns] and its uncertainty [s]."""
        half = (first - asked) // 2
        latch = self.config.protocol.latch
        if latch is not None:
            half = min(half, round(latch * 0.5e9))
        self.uncertainty = max(self.uncertainty, half * 1e-9)
        ago = time.monotonic_ns() - (asked + half)
        return self._clock.now() - ago, half * 1e-9

    def _give(self, index: int, stamp: tuple[int, float], readings: Sequence[Reading]) -> None:
        start = sum(one.outputs for one in self.config.protocol.queries[:index])
        done = [self._physical(start + at, reading) for at, reading in enumerate(readings)]
        values, status = zip(*done, strict=True)
        self._deliver(index, Sample(stamp[0], values, status, stamp[1]))

    def _physical(self, output: int, reading: Reading) -> tuple[float, Status]:
        """Reading in SI units, a displacement in the nest's sense, checked against the range."""
        if reading.status is not Status.VALID:
            self.note = reading.reason
            self.faults += reading.status is Status.DEVICE_ERROR
            return math.nan, reading.status
        value, problem = self.config.physical(output, reading.value)
        if problem:
            self.note = problem
            return math.nan, Status.OUT_OF_RANGE
        return value, Status.VALID

    # --- the line ---

    def _do(self, port: Port, command: Command, seconds: float) -> None:
        """Send a command and throw away what comes until it is done."""
        self._framer.clear()
        port.write(command.send)
        limit = time.monotonic() + seconds
        while (now := time.monotonic()) < limit and not self._stop.is_set():
            for frame in self._framer.feed(port.read(limit - now)):
                if command.done.fullmatch(frame):
                    return
                self.dropped += len(frame)
        raise self._silence(f'no answer to {command.send!r}')

    def _resynchronise(self, port: Port, seconds: float) -> None:
        """Throw away answers that may still be under way; no question is sent before that."""
        if self.config.protocol.fence is not None:
            self._do(port, self.config.protocol.fence, seconds)
            return
        limit = time.monotonic() + _NOISY_S
        while (data := port.read(_QUIET_S)) and time.monotonic() < limit:
            self.dropped += len(data)

    def _silence(self, what: str) -> ConnectionError:
        last = f', last: {self.note}' if self.note else ''
        return ConnectionError(
            f'{self.name}: {what}{last}; check power, cable, protocol, baud and parity, and the '
            'mode of the controller'
        )

    def _set(self, problem: str) -> None:
        self.problem = problem
        self._changed()
