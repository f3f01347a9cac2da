"""The device file of a nest."""

from pathlib import Path

import pytest

from rtest_drivers.gauges.config import PROTOCOLS, load_nest, range_text
from rtest_drivers.gauges.frames import Line
from rtest_estimation.errors import UserError

FULL = """\
controllers:
  - protocol: keyence-lkg
    port: /dev/ttyUSB0
    channels: [1, 3]
    unit: mm
    sign: [1, -1]
    range_mm: [-1, 0.5]
    rate_hz: 200
    baud: 57600
    sampling_us: 100
  - {protocol: heidenhain-nd287, port: 'socket://10.0.0.7:4001', channels: [2], unit: inch}
"""


def write(folder: Path, text: str) -> Path:
    path = folder / 'nest.yaml'
    path.write_text(text, encoding='utf-8')
    return path


def test_a_full_file(tmp_path) -> None:
    config = load_nest(write(tmp_path, FULL))
    laser, display = config.controllers
    assert config.channels == 3
    assert (laser.channels, laser.signs, display.channels) == ((0, 2), (1, -1), (1,))
    assert laser.limits == pytest.approx((-1e-3, 0.5e-3))
    assert (laser.rate, laser.timeout) == (200.0, 0.25)
    assert laser.line == Line(57600)
    assert [query.outputs for query in laser.protocol.queries] == [2]
    # What the file does not say is the factory setting.
    assert display.line == Line(9600, 7, 'even', 2)
    assert (display.signs, display.limits) == ((1,), None)
    assert laser.physical(1, 0.25) == (-0.25e-3, '') and display.physical(0, 2.0) == (0.0508, '')


def test_every_protocol_can_be_named(tmp_path) -> None:
    more = {
        'line': ', query: "?", terminator: "\\r\\n", pattern: "(\\\\S+)"',
        'heidenhain-nd287': ', command: A0200, decimals: 4, parity: none, stopbits: 1',
    }
    for name in PROTOCOLS:
        text = f'{{protocol: {name}, port: x, channels: [1], unit: um{more.get(name, "")}}}'
        config = load_nest(write(tmp_path, f'controllers: [{text}]'))
        assert config.controllers[0].name == name


@pytest.mark.parametrize(
    ('old', 'new', 'message'),
    [
        ('controllers:\n', 'gauges:\n', "unknown key 'gauges', expected one of"),
        (FULL, '', 'expected a mapping with the key controllers'),
        (FULL, 'controllers: []', 'controllers: expected a list of mappings'),
        (FULL, 'controllers: {a: 1}', 'controllers: expected a list of mappings'),
        (FULL, 'controllers: [5]', 'controllers: 1: expected a mapping of'),
        (FULL, 'controllers: [', 'not valid YAML'),
        (FULL, 'controllers: !!python/object:os.system []', 'not valid YAML'),
        ('    unit: mm\n', '    unit: mm\n    unit: um\n', 'not valid YAML: a key is there twice'),
        ('keyence-lkg', 'keyence', "1: protocol: expected one of .*, got 'keyence'"),
        ('keyence-lkg', '[1]', r'1: protocol: expected one of .*, got \[1\]'),
        ('    unit: mm\n', '', '1: unit: missing'),
        ('unit: mm', 'unit: cm', "1: unit: expected one of .*, got 'cm'"),
        ('/dev/ttyUSB0', '7', '1: port: expected a device, socket://HOST'),
        *(('/dev/ttyUSB0', port, r'1: port: expected a device, socket://HOST:PORT or rfc2217://')
          for port in ('socket://127.0.0.1', 'rfc2217://127.0.0.1', 'socket://127.0.0.1:99999',
                       'socket://127.0.0.1:abc', 'socket://a..b:4001', 'foo://x:1', 'loop://',
                       '"hwgrep://("', '"spy:///dev/ttyS0?file=x"', '"socket://[::1"',
                       '"/dev/tty\\0"')),
        ('/dev/ttyUSB0', 'socket://10.0.0.7:4001', 'port socket://.* is given twice'),
        ('[1, 3]', '[1, 4]', r'channels: expected 1 to 3, each once, got \[1, 2, 4\]'),
        ('[1, 3]', '[1, 1]', r'channels: expected 1 to 3, each once, got \[1, 1, 2\]'),
        ('[1, 3]', '[0, 1]', r'channels: expected 1 to 3, each once, got \[0, 1, 2\]'),
        ('[1, 3]', '[1, 3.0]', '1: channels: expected a list of whole numbers'),
        ('[1, 3]', '[]', '1: channels: expected a list of whole numbers'),
        ('[1, 3]', '[1, true]', '1: channels: expected a list of whole numbers'),
        ('[1, 3]', '[1, 3, 4]', '1: channels: an LK-G has two outputs'),
        ('[1, -1]', '2', '1: sign: expected 1 or -1'),
        ('[1, -1]', '[1]', '1: sign: expected 1 or -1, or one for each of 2 channels'),
        ('[1, -1]', '1.0', '1: sign: expected 1 or -1'),
        ('[1, -1]', 'true', '1: sign: expected 1 or -1'),
        ('[-1, 0.5]', '[1, -1]', r'1: range_mm: expected \[lower, upper\]'),
        ('[-1, 0.5]', '[-1]', '1: range_mm: expected 2 numbers'),
        ('[-1, 0.5]', '[-1, .inf]', '1: range_mm: expected 2 numbers'),
        ('rate_hz: 200', 'rate_hz: 0', '1: rate_hz: expected 0.1 to 1000, got 0'),
        ('rate_hz: 200', 'rate_hz: fast', '1: rate_hz: expected 0.1 to 1000'),
        ('rate_hz: 200', 'timeout_s: 5', '1: timeout_s: expected 0.01 to 0.3, got 5'),
        ('baud: 57600', 'baud: 9600.5', '1: baud: expected a whole number'),
        ('baud: 57600', 'bytesize: 9', '1: bytesize: expected a whole number from 7 to 8'),
        ('baud: 57600', 'parity: maybe', '1: parity: expected one of'),
        ('baud: 57600', 'stopbits: 3', '1: stopbits: expected a whole number from 1 to 2'),
        ('sampling_us: 100', 'sampling_us: 30', '1: sampling_us: expected one of'),
        ('sampling_us: 100', 'sampling_us: [20]', '1: sampling_us: expected one of'),
        ('sampling_us: 100', 'sampling_us: 100.0', '1: sampling_us: expected one of'),
        ('sampling_us: 100', 'command: ctrl-b', "1: unknown key 'command'"),
    ],
)
def test_mistakes_are_told_in_one_line(tmp_path, old, new, message) -> None:
    assert old in FULL
    path = write(tmp_path, FULL.replace(old, new, 1))
    with pytest.raises(UserError, match=message) as caught:
        load_nest(path)
    text = str(caught.value)
    assert text.startswith(str(path))
    assert '\n' not in text


def test_a_file_that_is_not_there(tmp_path) -> None:
    with pytest.raises(UserError, match='cannot read the device file'):
        load_nest(tmp_path / 'none.yaml')
    path = tmp_path / 'bytes.yaml'
    path.write_bytes(b'\xff\xfe\x00')
    with pytest.raises(UserError, match='cannot read the device file'):
        load_nest(path)


def test_more_channels_than_a_message_carries(tmp_path) -> None:
    entries = [
        f'{{protocol: heidenhain-nd287, port: p{number}, channels: [{number}], unit: mm}}'
        for number in range(1, 18)
    ]
    with pytest.raises(UserError, match='expected at most 16 channels'):
        load_nest(write(tmp_path, f'controllers: [{", ".join(entries)}]'))


def test_ranges_are_told_in_the_sense_of_the_nest(tmp_path) -> None:
    # One output counts against the nest; a controller without a range is not known.
    path = write(tmp_path, """
controllers:
  - {protocol: keyence-lkg, port: /dev/null, channels: [1, 2], unit: mm,
     sign: [1, -1], range_mm: [-1, 0.5]}
  - {protocol: heidenhain-nd287, port: /dev/zero, channels: [3], unit: mm}
""")
    assert range_text(load_nest(path)) == '-1 0.5; -0.5 1; ?'
