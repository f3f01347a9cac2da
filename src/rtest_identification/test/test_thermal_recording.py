"""A recorded thermal session, from the readings to thermal.json."""

import argparse
import json
from types import SimpleNamespace

import numpy as np
import pytest
from independent import NMV, centre, nest_cycle
from synthetic import V
from test_recording import TYPES, BagMaker, header, temperature
from warming import MINUTE, START, readings, session, settling

from rtest_drivers.commands import thermal
from rtest_estimation.errors import UserError
from rtest_identification.thermal.offline import thermal_recording

TAU = 20 * MINUTE
MINUTES = np.arange(2, 63, 10)
HZ, DWELL, MOVE = 50, 0.3, 0.2


def state(time):
    return settling(time, TAU)


def errors(time, b, c):
    f = state(time)
    return {'B': {'X': 5e-6 - 2e-6 * f, 'Y': -6e-6 * f, 'Z': -2e-6 * f}}


def message(plan, name):
    return TYPES['rtest_msgs/msg/CyclePlan'](
        header(plan.stamp, 'machine'), 'warm', name, int(plan.kind), 't',
        TYPES['geometry_msgs/msg/Point'](*plan.sphere), list(plan.axes), plan.commands.ravel(),
        DWELL, 0.0,
    )


def play(bag, plan, rng, noise):
    """Feedback and readings of one cycle; the sphere is where the plain matrices have it."""
    clock, sequence, block = plan.stamp, bag.sequence, []
    for row, command in enumerate(plan.commands):
        before = plan.commands[row - 1] if row else command
        moving = int(MOVE * HZ) if row else 0
        still = int((1.0 if row == len(plan.commands) - 1 else DWELL) * HZ)
        offset = noise * rng.normal(size=3)
        for step in range(moving + still):
            part = min((step + 1) / (moving + 1), 1.0)
            at = before + part * (command - before)
            x = centre(*at, errors((clock - START) * 1e-9, at[3], at[4])) - plan.sphere + offset
            bag.add('/rtest/cnc/feedback', TYPES['sensor_msgs/msg/JointState'](
                header(clock, ''), list('XYZBC'), at, np.empty(0), np.empty(0)
            ), clock)
            block.append((clock, V @ x + 3e-8 * rng.normal(size=3)))
            clock += 10**9 // HZ
    for first in range(0, len(block), 10):
        part = block[first : first + 10]
        bag.add('/rtest/gauges', TYPES['rtest_msgs/msg/GaugeSamples'](
            header(part[0][0]), sequence, 1.0 / HZ, 3, np.concatenate([v for _, v in part]),
            np.zeros(3 * len(part), np.uint8),
        ), part[-1][0])
        sequence += len(part)
    bag.sequence = sequence


@pytest.fixture(scope='module')
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp('bags')
    bag = BagMaker(folder / 'warm' / 'warm.mcap')
    bag.sequence = 0
    rng = np.random.default_rng(0)
    nest = nest_cycle('1a').plan
    cycles = session(lambda *_: {}, MINUTES)
    sphere = cycles[0].plan.sphere
    # The nest stands where the cycles have it.
    commands = nest.commands + np.array([*(sphere - nest.sphere), 0.0, 0.0])
    nest = SimpleNamespace(**{
        **vars(nest), 'stamp': START + 10**9, 'sphere': sphere, 'commands': commands,
    })
    bag.add('/rtest/machine', TYPES['std_msgs/msg/String'](NMV), START)
    for plan, name in ((nest, 't-nest'), *((c.plan, 't-static') for c in cycles)):
        bag.add('/rtest/plan', message(plan, name), plan.stamp)
        play(bag, plan, rng, 0.25e-6)
    stamps, celsius = readings(lambda s: 22.0 + 1.4 * state(s), 64, noise=0.02, seed=1)
    for stamp, value in zip(stamps, celsius, strict=True):
        bag.add('/rtest/temperature', temperature('B_cover', value, int(stamp)), int(stamp))
    return bag.close()


def test_recording_gives_every_cycle(recorded):
    result = thermal_recording(recorded)
    # The same name again and again is not the same cycle again.
    assert [c.plan.cycle for c in result.cycles] == [f't-static ({n})' for n in range(1, 8)]
    np.testing.assert_allclose(result.time, MINUTE * (MINUTES - 2), atol=0.5)
    assert result.session == 'warm' and result.reference.noise_freedom > 0
    f = state((result.stamp - START) * 1e-9)
    for history, size in zip(result.errors[:3], (-2e-6, -6e-6, -2e-6), strict=True):
        wrong = np.abs(history.series.value - size * (f - f[0]))
        assert (wrong[1:] < 3.0 * history.series.stddev[1:]).all()
        assert history.drift.significant and history.best.sensor == 'B_cover'


def run(*arguments):
    parser = argparse.ArgumentParser()
    thermal.add_arguments(parser)
    return thermal.run(parser.parse_args([str(a) for a in arguments]))


def test_command_writes_and_sums_up(recorded, tmp_path, capsys):
    assert run(recorded, '--out', tmp_path, '--no-report') == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith('warm: 7 cycles in 60 min, 3 errors beyond U: E_Y(0Y)B -')
    assert last.endswith('thermal.json')
    data = json.loads((tmp_path / 'thermal.json').read_text())
    assert set(data['drifting']) == {'E_X(0Y)B', 'E_Y(0Y)B', 'E_Z(0Y)B'}
    assert [p.name for p in tmp_path.iterdir()] == ['thermal.json']


def test_mistakes_are_told_in_one_line(recorded, tmp_path):
    with pytest.raises(UserError, match='nothing.mcap'):
        run(tmp_path / 'nothing.mcap')
    file = tmp_path / 'file'
    file.write_text('')
    with pytest.raises(UserError, match='is not a directory'):
        run(recorded, '--out', file / 'out')
