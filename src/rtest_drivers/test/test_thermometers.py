"""Thermometers on a simulated line: readings, faults, reconnect, the check, mistakes."""

import math
import time
from pathlib import Path

import pytest

from rtest_drivers.cli import main
from rtest_drivers.config import config_path
from rtest_drivers.sim.gauge_devices import GaugeDevice
from rtest_drivers.sim.thermometer_devices import ThermocoupleModule
from rtest_drivers.thermometers.config import load_thermometers
from rtest_drivers.thermometers.serial_thermometers import SerialThermometers
from rtest_estimation.errors import UserError

pytestmark = pytest.mark.alone

FILE = r"""
controllers:
  - port: PORT
    unit: degC
    range_c: [5, 60]
    stddev_k: 0.1
    rate_hz: 10
    timeout_s: 0.2
    terminator: "\r"
    over_range: '+9999.9'
    questions:
      - {query: "#010\r", pattern: '>([+-][0-9.]{6})', sensors: [ambient]}
      - {query: "#01\r", pattern: '>[+-][0-9.]{6}([+-][0-9.]{6})([+-][0-9.]{6})',
         sensors: [B_cover, table]}
"""


class Line:
    """A module on a pseudo-terminal and the device file for it."""

    def __init__(self, folder: Path) -> None:
        self.celsius = [21.5, 23.25, 22.0]
        self.device = GaugeDevice(ThermocoupleModule(lambda: self.celsius), folder / 'port')
        self.path = folder / 'thermometers.yaml'
        self.path.write_text(FILE.replace('PORT', self.device.port))


@pytest.fixture
def line(tmp_path):
    made = Line(tmp_path)
    yield made
    made.device.close()


@pytest.fixture
def opened(line):
    backend = SerialThermometers(str(line.path))
    backend.open()
    yield backend
    backend.close()


def collect(backend, seconds=0.5):
    """Readings by sensor."""
    found, limit = {}, time.monotonic() + seconds
    while time.monotonic() < limit:
        for reading in backend.read(0.1):
            found.setdefault(reading.sensor, []).append(reading)
    return found


def until(backend, condition, seconds=10.0):
    limit = time.monotonic() + seconds
    while not condition(backend):
        assert time.monotonic() < limit
        collect(backend, 0.1)


def test_every_sensor_has_its_own_value_and_a_stamp_of_the_read(opened) -> None:
    before = time.time_ns()
    found = collect(opened)
    assert {name: {r.value for r in some} for name, some in found.items()} == {
        'ambient': {21.5}, 'B_cover': {23.25}, 'table': {22.0},
    }
    for some in found.values():
        stamps = [reading.stamp for reading in some]
        assert stamps == sorted(stamps)
        assert before - 1e9 < stamps[0] <= stamps[-1] <= time.time_ns()
        assert [reading.variance for reading in some] == pytest.approx([0.01] * len(some))
    # The two of one answer were read together.
    assert [r.stamp for r in found['B_cover']] == [r.stamp for r in found['table']]


@pytest.mark.parametrize(('unit', 'celsius'), [('K', -251.15), ('degF', -16.0 / 3.0)])
def test_units(line, unit, celsius) -> None:
    # 22 K and 22.4 degF, by hand.
    line.celsius = [22.0 if unit == 'K' else 22.4] * 3
    text = line.path.read_text().replace('degC', unit).replace('[5, 60]', '[-300, 60]')
    line.path.write_text(text)
    backend = SerialThermometers(str(line.path))
    backend.open()
    try:
        found = collect(backend, 0.3)
    finally:
        backend.close()
    assert found['ambient'][0].value == pytest.approx(celsius)


def test_what_is_no_temperature_is_told_and_not_given(line, opened) -> None:
    collect(opened, 0.2)
    line.celsius = [math.nan, 61.0, 22.0]
    until(opened, lambda b: 'ambient: out of range; B_cover: out of range' in b.health()[0])
    found = collect(opened)
    assert set(found) == {'table'}
    line.celsius = [21.0, 23.0, 22.0]
    until(opened, lambda b: 'out of range' not in b.health()[0])
    assert {reading.value for reading in collect(opened)['ambient']} == {21.0}


@pytest.mark.parametrize('fault', ['garbage', 'half', 'wrong', 'silent'])
def test_a_faulty_line_gives_no_temperature(line, opened, fault) -> None:
    line.device.fault = fault
    # Readings from before, and those of an answer under way.
    collect(opened, 0.3)
    # Three values do not answer the question for one.
    allowed = {'B_cover', 'table'} if fault == 'wrong' else set()
    limit = time.monotonic() + 0.6
    while time.monotonic() < limit:
        try:
            assert {reading.sensor for reading in opened.read(0.1)} <= allowed
        except ConnectionError as error:
            assert 'check power, cable, protocol' in str(error)
            time.sleep(0.05)
    line.device.fault = ''

    def again(backend) -> bool:
        try:
            return {'ambient', 'table'} <= set(collect(backend, 0.3))
        except ConnectionError:
            time.sleep(0.05)
            return False

    limit = time.monotonic() + 10.0
    while not again(opened):
        assert time.monotonic() < limit


def test_an_unplugged_line_is_told_and_found_again(line, opened) -> None:
    collect(opened, 0.2)
    line.device.unplug()
    with pytest.raises(ConnectionError, match='port'):
        for _ in range(50):
            opened.read(0.1)
    line.device.plug()
    opened.open()
    assert set(collect(opened)) == {'ambient', 'B_cover', 'table'}


# --- files ---


@pytest.mark.parametrize(
    ('old', 'new', 'message'),
    [
        ('unit: degC', 'unit: mm', "1: unit: expected one of .*, got 'mm'"),
        ('    unit: degC\n', '', '1: unit: missing'),
        ('[5, 60]', '[60, 5]', r'range_c: expected \[lower, upper\]'),
        ('[5, 60]', '[60]', 'range_c: expected 2 numbers'),
        ('rate_hz: 10', 'rate_hz: 100', 'rate_hz: expected 0.1 to 10'),
        ('stddev_k', 'stddev', "unknown key 'stddev'"),
        ('[ambient]', '[ambient air]', 'questions: 1: sensors: expected a list of names'),
        ('[ambient]', '[]', 'questions: 1: sensors: expected a list of names'),
        ('[ambient]', '[table]', 'sensor table is given twice'),
        ('[ambient]', '[ambient, more]', 'one group for each of 2 channels, got 1'),
        ('[B_cover, table]', '[B_cover]', 'one group for each of 1 channels, got 2'),
        ('    terminator: "\\r"\n', '', 'questions: 1: terminator: missing'),
        ('sensors: [ambient]', 'sensor: [ambient]', "questions: 1: unknown key 'sensor'"),
        ("'>([+-][0-9.]{6})'", "'>([+-'", 'no regular expression'),
    ],
)
def test_mistakes_are_told_in_one_line(tmp_path, old, new, message) -> None:
    assert old in FILE
    path = tmp_path / 'thermometers.yaml'
    path.write_text(FILE.replace(old, new, 1))
    with pytest.raises(UserError, match=message) as caught:
        load_thermometers(path)
    assert str(caught.value).startswith(str(path)) and '\n' not in str(caught.value)


def test_the_example_is_right() -> None:
    (line,) = load_thermometers(config_path('thermometers_example.yaml'))
    assert line.sensors == ('ambient', 'B_cover', 'table')
    # As the manual has it, a sign and five digits with a point; a broken wire is none.
    (reading,) = line.protocol.queries[1].read(b'>+023.25')
    assert line.physical(1, reading.value) == (23.25, '')
    (broken,) = line.protocol.queries[1].read(b'>+9999.9')
    assert math.isnan(broken.value)


def test_the_check_of_a_session_says_what_answers(line, tmp_path, capsys) -> None:
    session = tmp_path / 'session.yaml'
    session.write_text(f"""
machine: {config_path('nmv1500dcg.yaml')}
cycle: {{b_deg: [-30, 0, 30], c_deg: [0, 90, 180]}}
setups: {{a: {{sphere_mm: [0, -60, 40]}}}}
devices:
  thermometers: {{backend: serial, file: thermometers.yaml}}
""")
    line.celsius[1] = 80.0
    assert main(['session', '--config', str(session), '--check']) == 1
    out, err = capsys.readouterr()
    assert 'ambient: valid, 21.50 degC' in out and 'B_cover: out of range' in out
    assert 'B_cover: out of range; check its wire and range_c' in err and err.count('\n') == 1
