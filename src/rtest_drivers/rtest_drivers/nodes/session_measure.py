"""Carrying out one cycle in the node `session`: in the simulated cell, or on a real machine."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rtest_drivers.cnc.programs import program_of, start_program
from rtest_drivers.nodes.session_cycles import Cycles, Key
from rtest_drivers.nodes.session_heard import HEARD_S, Heard
from rtest_drivers.nodes.session_voice import Voice
from rtest_drivers.nodes.session_waiting import SessionError, Wait
from rtest_drivers.schedule import NANOSECONDS, STOPPED_S, Progress
from rtest_drivers.wishes import ABORT, CALIBRATE, REPEAT, SKIP, Wishes
from rtest_estimation.errors import UserError
from rtest_estimation.records import CyclePlan
from rtest_identification.session_file import BY_HAND, UNATTENDED, Device

# How often progress is told: of a simulated cycle, of a real one [s].
PROGRESS_S, SLOW_PROGRESS_S = 2.0, 10.0
# A simulated clock that stands still this long has lost its cell [s].
CLOCK_TIMEOUT_S = 30.0


@dataclass(frozen=True)
class Measuring:
    """What measuring a cycle needs, wherever it is.

    now : time of the session [ns]
    limit : longest time a cycle may take [s]; 0 is an estimate from its path
    """

    now: Callable[[], int]
    wait: Wait
    voice: Voice
    heard: Heard
    cycles: Cycles
    wishes: Wishes
    limit: float


@dataclass(frozen=True)
class InSimulatedCell(Measuring):
    """Cycles that the simulated cell carries out."""

    def measure(self, plan: CyclePlan, due: int) -> list[Key]:
        """Publish one plan and wait for its finished cycle; returns its key.

        Goes on where the cycle has stopped; it is then finished by the next plan or at the end.

        due : when it is to begin [ns]. The plan is published at once: a simulated cell that knows
            for how long it has nothing to do lets that time pass quickly

        Raises SessionError where the clock stands.
        """
        self.cycles.tell_turn(plan, due)
        key = self.cycles.start(plan, due)
        shown, told = time.monotonic(), 0
        progress = Progress(plan, key[1], shown, self.limit)
        while not self.cycles.finished(key):
            self.wait(lambda: self.cycles.finished(key), 0.2)
            self.cycles.tell_finished()
            now, wall = self.now(), time.monotonic()
            if progress.clock_stands(now, wall) > CLOCK_TIMEOUT_S:
                raise SessionError(f'{plan.cycle}: the clock has stood still for '
                                   f'{CLOCK_TIMEOUT_S:.0f} s; is the simulated cell running?')
            if self.cycles.finished(key) or self.wishes.wish == ABORT:
                break
            done, poses = self.heard.poses(key)
            if done:
                self.voice.status = f'measuring {plan.cycle}'
            if why := progress.stopped(now, wall, done, self.heard.feedback_age):
                self.voice.warn_cycle(plan, why)
                self.voice.say_cycle(plan, f'{why}; going on')
                break
            if wall - shown > PROGRESS_S and told < done < poses:
                shown, told = wall, done
                self.voice.say_cycle(plan, f'{done} of {poses} poses')
        return [key]


@dataclass(frozen=True)
class OnMachine(Measuring):
    """Cycles whose NC programs run on a real machine.

    folder : of the session file, where the NC programs are
    device : the CNC; None where the session file names none
    """

    folder: Path
    device: Device | None

    def measure(self, plan: CyclePlan, due: int) -> list[Key]:
        """Measure a cycle, as often as it has to be; the keys of all attempts.

        Waits as long as it takes until somebody starts the program. due : when it is to begin [ns]
        """
        self.cycles.tell_turn(plan, due)
        if not self._wait_for_turn(plan, due):
            return []
        by_hand = self.device is None or self.device.programs == BY_HAND
        keys = []
        while True:
            self._wait_for_end_of_program(plan)
            self.wishes.wish = ''
            keys.append(self.cycles.start(plan))
            if not by_hand:
                # Once: after an E-stop only a person starts a machine again.
                by_hand = not self._start_program(plan, self.device)
            if by_hand:
                self.voice.say_cycle(plan, f'start {self._program_name(plan)}')
            by_hand = True
            self.wishes.following = True
            again = self._follow(plan, keys[-1])
            self.wishes.following = False
            if not again:
                return keys

    def _wait_for_turn(self, plan: CyclePlan, due: int) -> bool:
        """Wait until a cycle is to begin; False where somebody wishes that it does not."""
        self.wishes.wish = ''
        self.wishes.following = True
        while (left := (due - self.now()) / NANOSECONDS) > 0.0:
            if self.wait(lambda: self.wishes.wish in (SKIP, CALIBRATE, ABORT), left):
                self.wishes.following = False
                self.voice.say_cycle(plan, f'{self.wishes.wish}, as was asked for')
                return False
        self.wishes.following = False
        return True

    def _follow(self, plan: CyclePlan, key: Key) -> bool:
        """Wait for a cycle; whether it is to be measured anew."""
        shown, told, complained = time.monotonic(), 0, False
        progress = Progress(plan, key[1], shown, self.limit, attended=True)
        while not self.cycles.finished(key) and not self.wishes.wish:
            self.wait(lambda: self.cycles.finished(key) or bool(self.wishes.wish), 0.2)
            self.cycles.tell_finished()
            wall = time.monotonic()
            done, poses = self.heard.poses(key)
            if self.heard.program.has_left(wall, done) and not self.cycles.finished(key):
                self.voice.say_cycle(
                    plan, f'{done} of {len(plan.commands)} poses, and the program has ended'
                    f'{self.heard.why()}; the cycle is measured anew, or `rtest ask skip`'
                )
                return True
            why = progress.stopped(self.now(), wall, done, self.heard.feedback_age)
            if why and not complained:
                self.voice.warn_cycle(plan, why)
                self.voice.say_cycle(
                    plan, f'{why}{self.heard.why()}; go on with the program, or '
                    '`rtest ask repeat` to measure the cycle anew, `rtest ask skip` to leave it'
                )
            complained = bool(why)
            if wall - shown > SLOW_PROGRESS_S and told < done < poses:
                shown, told = wall, done
                self.voice.say_cycle(plan, f'{done} of {poses} poses')
        if self.wishes.wish and not self.cycles.finished(key):
            self.voice.say_cycle(plan, f'{self.wishes.wish}, as was asked for')
        return self.wishes.wish == REPEAT

    def _wait_for_end_of_program(self, plan: CyclePlan) -> None:
        """The program of the cycle before still moves the sphere out of the nest."""
        program = self.heard.program
        reports = program.reports
        self.wait(lambda: program.reports > reports + 1, 2.0 * HEARD_S)
        if program.stands:
            return
        self.voice.status = 'waiting for the end of the NC program'
        if not self.wait(lambda: program.stands, STOPPED_S):
            self.voice.say_cycle(plan, 'the program before still runs; end it')
            self.wait(lambda: program.stands, math.inf)

    def _start_program(self, plan: CyclePlan, device: Device) -> bool:
        """Start the program of a cycle; False where it has to be started by hand."""
        program = program_of(plan.cycle, self.folder)
        unattended = device.programs == UNATTENDED
        try:
            start_program(str(device.file), program.absolute(), unattended)
        except (UserError, ConnectionError) as error:
            self.voice.say_cycle(plan, str(error))
            return False
        waits = '' if unattended else '; when the sphere is clear of the nest let it go on'
        poses = len(plan.commands)
        self.voice.say_cycle(plan, f'{program.name} started: {poses} poses{waits}')
        return True

    def _program_name(self, plan: CyclePlan) -> str:
        """For example `program 1a-static.ngc: 86 poses`."""
        program = program_of(plan.cycle, self.folder)
        name = f'program {program.name}' if program else f'the NC program of {plan.cycle}'
        return f'{name}: {len(plan.commands)} poses'
