"""Protocols of gauges: frames of the manuals, error codes, and bytes that are no frame."""

import math
import random
from decimal import Decimal

import pytest

from rtest_drivers.gauges import heidenhain, keyence, line_protocol, mitutoyo
from rtest_drivers.gauges.frames import Framer, IllegalFrame, OtherAnswer, Protocol
from rtest_estimation.errors import UserError
from rtest_estimation.records import Status
from rtest_identification.session_reader import Reader

LINE = {
    'query': '?\r',
    'terminator': '\r\n',
    'pattern': r'\s*(\S+) mm\s+(\S+) mm',
    'no_signal': '-----',
    'over_range': 'OL',
}


def options(**keys) -> Reader:
    return Reader('device.yaml: controllers: 1', keys)


LKG = keyence.lkg(2, 'mm', options())
LKG_SINGLE = keyence.lkg(1, 'mm', options())
LKG5000 = keyence.lkg5000(3, 'mm', options())
ND287 = heidenhain.nd287(1, 'mm', options())
ND287_A = heidenhain.nd287(1, 'mm', options(command='A0200', decimals=4))
MUX = mitutoyo.mux10(3, 'mm', options())
DIGIMATIC = mitutoyo.digimatic(1, 'mm', options())
TEXT = line_protocol.line(2, 'mm', options(**LINE))


def read(protocol: Protocol, frame: bytes, query: int = 0) -> list:
    """Values, or the status of what has none."""
    readings = protocol.queries[query].read(frame)
    assert len(readings) == protocol.queries[query].outputs
    for one in readings:
        assert math.isnan(one.value) == (one.status is not Status.VALID)
        assert bool(one.reason) == (one.status is not Status.VALID)
    return [one.value if one.status is Status.VALID else one.status for one in readings]


OVER, NONE, ERROR = Status.OUT_OF_RANGE, Status.NO_SIGNAL, Status.DEVICE_ERROR


@pytest.mark.parametrize(
    ('protocol', 'frame', 'expected'),
    [
        (LKG, b'M0,+01.2345,-00.1234', [1.2345, -0.1234]),
        # The measured values of page 5-6.
        (LKG_SINGLE, b'M1,+01.2345', [1.2345]),
        (LKG_SINGLE, b'M1,-00.0120', [-0.012]),
        (LKG_SINGLE, b'M1,+1234.56', [1234.56]),
        (LKG_SINGLE, b'M1,-00001.2', [-1.2]),
        (LKG_SINGLE, b'M1,+0012345', [12345.0]),
        (LKG_SINGLE, b'M1,XXXXXXXX', [NONE]),
        (LKG_SINGLE, b'M1,+FFFFFFF', [OVER]),
        (LKG_SINGLE, b'M1,-FFFFFFF', [OVER]),
        (LKG_SINGLE, b'M1,-FFFFFF', [OVER]),
        (LKG, b'M0,+FFFFFFF,+00.5000', [OVER, 0.5]),
        (LKG, b'M0,-00.0001,XXXXXXXX', [-0.0001, NONE]),
        (LKG5000, b'MM,111000000000,+00.1000,-000.260,XXXXXXXX', [0.1, -0.26, NONE]),
        # The example of the ND 287's manual, page 115: X = -5.23 mm within the limits, actual.
        (ND287, b'-      5.23  =A', [-5.23]),
        (ND287, b'+12345.6789    ', [12345.6789]),
        (ND287, b'+  123.4567    ', [123.4567]),
        (ND287, b'+    0.0000  ? ', [0.0]),
        (ND287, b'+    0.0120  <1', [0.012]),
        (ND287, b'+    0.0000 ?  ', [ERROR]),
        (ND287, b'+    0.1234 "  ', [ERROR]),
        (ND287, b'+    0.1234 G  ', [ERROR]),
        (ND287, b'+    0.1234  =G', [ERROR]),
        (ND287, b'\x15', [ERROR]),
        (ND287_A, b'\x02+123456789', [12345.6789]),
        (ND287_A, b'\x02-000001473', [-0.1473]),
        (ND287_A, b'\x15', [ERROR]),
        # Mux-10 format: GageMux manual page 7, QM-Height manual section 6.3.4.
        (MUX, b'01A-001.2340', [-1.234]),
        (MUX, b'01A+0000.123', [0.123]),
        (MUX, b'01A+00.12345', [0.12345]),
        (MUX, b'911', [ERROR]),
        (MUX, b'912', [ERROR]),
        # 99MBA043A page 6-12, LSM-6200 page 6-28, 99MAF600B section 6.2.1.
        (DIGIMATIC, b'FFFF801234530', [-12.345]),
        (DIGIMATIC, b'FFFF021076540', [21.0765]),
        (DIGIMATIC, b'\nFFFF000012330', [0.123]),
        (DIGIMATIC, b'FFFF000012331', [ERROR]),
        (TEXT, b'  +1.25 mm  -0.5 mm', [1.25, -0.5]),
        (TEXT, b'12 mm OL mm', [12.0, OVER]),
        (TEXT, b'----- mm 1 mm', [NONE, 1.0]),
    ],
)
def test_legal_answers(protocol, frame, expected) -> None:
    assert read(protocol, frame) == expected


@pytest.mark.parametrize(
    ('protocol', 'codes'),
    [
        (LKG, (b'00', b'01', b'20', b'21', b'22', b'88', b'99')),
        (LKG5000, (b'50', b'51', b'60', b'61', b'62', b'88', b'99')),
    ],
)
def test_every_error_code_of_keyence_is_a_device_error_with_its_meaning(protocol, codes) -> None:
    command = protocol.queries[0].send[:2]
    texts = set()
    for code in codes:
        readings = protocol.queries[0].read(b'ER,' + command + b',' + code)
        assert {one.status for one in readings} == {ERROR}
        assert code.decode() in readings[0].reason
        assert 'not in the manual' not in readings[0].reason
        texts.add(readings[0].reason)
    assert len(texts) == len(codes)
    assert 'not in the manual' in protocol.queries[0].read(b'ER,' + command + b',77')[0].reason


@pytest.mark.parametrize(
    ('protocol', 'frame'),
    [
        (LKG, b'M1,+01.2345'),
        (LKG, b'Q0'),
        (LKG, b'R0'),
        (LKG, b'SW,CA'),
        (LKG, b'ER,M1,01'),
        (LKG, b'ER,R0,01'),
        (LKG_SINGLE, b'M0,+01.2345,-00.1234'),
        (LKG5000, b'MS,01,+00.1000'),
        (LKG5000, b'ER,MS,50'),
        (ND287, b'\x02+000012345'),
        (ND287_A, b'+    0.0120  <1'),
        (MUX, b'02A-001.2340'),
        (MUX, b'921'),
    ],
)
def test_an_answer_to_another_question_is_recognised(protocol, frame) -> None:
    with pytest.raises(OtherAnswer):
        protocol.queries[0].read(frame)


@pytest.mark.parametrize(
    ('protocol', 'frame'),
    [
        (LKG, b''),
        (LKG, b'M0'),
        (LKG, b'M0,'),
        (LKG, b'M0,+01.2345'),
        (LKG, b'M0,+01.2345,-00.123'),
        (LKG, b'M0,+01.2345,-00.12345'),
        (LKG, b'M0,+01.2345,-00.1234,+00.0000'),
        (LKG, b'M0,+01.2345,-00..123'),
        (LKG, b'M0,+01.2345,-0012.34e'),
        (LKG, b'M0,+01.2345,-1e-0012'),
        (LKG, b'M0,+01.2345, 00.1234'),
        (LKG, b'M0,+01.2345,-.001234'),
        (LKG, b'M0,+01.2345,-001234.'),
        (LKG, b'M0,+01.2345,-FFFFF'),
        (LKG, b'M0,+01.2345,XXXXXXX'),
        (LKG, b'm0,+01.2345,-00.1234'),
        (LKG, b'\nM0,+01.2345,-00.1234'),
        (LKG, b'M0,+01.23M0,+01.2345,-00.1234'),
        (LKG, b'M0,\xb201.2345,-00.1234'),
        (LKG, 'M0,+01.234٤,-00.1234'.encode()),
        (LKG, b'ER,M0,1'),
        (LKG, b'ER,M0,011'),
        (LKG5000, b'MM,110000000000,+00.1000,-000.260'),
        (LKG5000, b'MM,111000000000,+00.1000,-000.260'),
        (ND287, b''),
        (ND287, b'-      5.23  =A '),
        (ND287, b'+123456.7890   '),
        (ND287, b'      5.23  =A'),
        (ND287, b'-      5.23 =A'),
        (ND287, b'- 5    5.23  =A'),
        (ND287, b'-      5.2.  =A'),
        (ND287, b'       5.23  =A'),
        (ND287, b'-      5.23  xA'),
        (ND287, b'+\x15'),
        (ND287_A, b'+000001473'),
        (ND287_A, b'\x02+00001473'),
        (ND287_A, b'\x02+0000001473'),
        (ND287_A, b'\x02 000001473'),
        (MUX, b'01A-001.234'),
        (MUX, b'01A-001.23400'),
        (MUX, b'01B-001.2340'),
        (MUX, b'01A 001.2340'),
        (MUX, b'00A+001.2340'),
        (MUX, b'01A+001.2.40'),
        (MUX, b'91'),
        (DIGIMATIC, b'FFFF80123453'),
        (DIGIMATIC, b'FFFF8012345300'),
        (DIGIMATIC, b'8FFF801234530'),
        (DIGIMATIC, b'FFFF101234530'),
        (DIGIMATIC, b'FFFF80123A530'),
        (DIGIMATIC, b'FFFF801234560'),
        (DIGIMATIC, b'FFFF801234532'),
        (TEXT, b'+1.25 mm'),
        (TEXT, b'+1.25 mm -0.5 mm x'),
        (TEXT, b'nan mm 1 mm'),
        (TEXT, b'inf mm 1 mm'),
        (TEXT, b'1e3 mm 1 mm'),
        (TEXT, b'1_0 mm 1 mm'),
        (TEXT, b'1. mm 1 mm'),
        (TEXT, '١ mm 1 mm'.encode()),
    ],
)
def test_what_is_not_exactly_a_legal_answer_is_none(protocol, frame) -> None:
    with pytest.raises(IllegalFrame):
        protocol.queries[0].read(frame)


def test_questions_are_those_of_the_manuals() -> None:
    assert [query.send for query in LKG.queries] == [b'M0\r']
    assert [query.send for query in LKG_SINGLE.queries] == [b'M1\r']
    assert [query.send for query in LKG5000.queries] == [b'MM,111000000000\r']
    assert [query.send for query in ND287.queries] == [b'\x02']
    assert [query.send for query in ND287_A.queries] == [b'\x1bA0200\r']
    assert [query.send for query in MUX.queries] == [b'1\r', b'2\r', b'3\r']
    setup = keyence.lkg(1, 'mm', options(sampling_us=200)).setup
    assert [command.send for command in setup] == [b'Q0\r', b'SW,CA,3\r', b'R0\r']


def test_multiplexer_inputs_are_told_apart() -> None:
    assert read(MUX, b'02A+000.5000', query=1) == [0.5]
    with pytest.raises(OtherAnswer):
        read(MUX, b'01A+000.5000', query=1)


def test_unit_of_the_frame_is_checked() -> None:
    inch = heidenhain.nd287(1, 'inch', options())
    assert read(inch, b'+    0.1234 "  ') == [0.1234]
    assert read(inch, b'+    0.1234    ') == [ERROR]
    assert read(mitutoyo.digimatic(1, 'inch', options()), b'FFFF000012331') == [0.123]


@pytest.mark.parametrize(
    ('make', 'outputs', 'keys', 'message'),
    [
        (keyence.lkg, 3, {}, 'channels: an LK-G has two outputs, got 3; use a second'),
        (keyence.lkg, 2, {'sampling_us': 30}, r'sampling_us: expected one of \[20, 50'),
        (keyence.lkg5000, 13, {}, 'channels: an LK-G5000 has twelve outputs'),
        (heidenhain.nd287, 2, {}, 'channels: expected one for each display, got 2'),
        (heidenhain.nd287, 1, {'command': 'A0100'}, 'command: expected ctrl-b or A0200'),
        (heidenhain.nd287, 1, {'command': 'A0200'}, 'decimals: belongs to'),
        (heidenhain.nd287, 1, {'decimals': 4}, 'decimals: belongs to'),
        (heidenhain.nd287, 1, {'command': 'A0200', 'decimals': 9}, 'decimals: expected a whole'),
        (mitutoyo.mux10, 10, {}, 'channels: a multiplexer has nine inputs'),
        (mitutoyo.digimatic, 2, {}, 'channels: expected one, got 2'),
        (mitutoyo.digimatic, 1, {'query': 1}, 'query: expected ASCII text, got 1'),
        (line_protocol.line, 2, {**LINE, 'pattern': '('}, 'pattern: no regular expression'),
        (line_protocol.line, 2, {**LINE, 'pattern': '(.+)'}, 'pattern: expected one group'),
        (line_protocol.line, 1, {**LINE, 'pattern': r'(\d+)+'}, 'matching it could take too'),
        (line_protocol.line, 1, {**LINE, 'pattern': r'(?:a|a)*(\d)'}, 'repeat no group'),
        (line_protocol.line, 1, {**LINE, 'pattern': '.*.+(.).*x.*y.*'}, 'more than four'),
        (line_protocol.line, 1, {**LINE, 'pattern': '[0-9]*' * 20 + '(x)'}, 'more than four'),
        (line_protocol.line, 1, {**LINE, 'pattern': '[0-9]{0,9}' * 8 + '(x)'}, 'too long'),
        (line_protocol.line, 1, {**LINE, 'pattern': '(?:' * 3000 + '(x)' + ')' * 3000}, 'deep'),
        (line_protocol.line, 2, {**LINE, 'query': ''}, 'expected at least one character'),
        (line_protocol.line, 2, {**LINE, 'terminator': 'µ'}, 'terminator: expected ASCII text'),
        (line_protocol.line, 2, {'query': '?'}, 'terminator: missing'),
    ],
)
def test_mistakes_in_the_device_file(make, outputs, keys, message) -> None:
    with pytest.raises(UserError, match=message) as caught:
        make(outputs, 'mm', options(**keys))
    assert str(caught.value).startswith('device.yaml: controllers: 1: ')
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(
    'pattern', [r'\s*([+-]?\d+\.\d{1,6})\s?mm', r'(?:[+-]\d{1,4}\.\d{4},){2}([+-]\d{1,4})',
                r'(?:MM|IN)[.*+?]{3}(\S+)', r'(a){2}(?:bc){40}'],
)
def test_patterns_of_displays(pattern: str) -> None:
    line_protocol.line(1, 'mm', options(**{**LINE, 'pattern': pattern}))


def test_escaped_brackets_are_no_group() -> None:
    protocol = line_protocol.line(1, 'mm', options(**{**LINE, 'pattern': r'[()]+\)+(\S+)'}))
    assert read(protocol, b'()()))1.5') == [1.5]


# --- cutting a stream into frames ---


def test_frames_do_not_depend_on_how_the_bytes_arrive() -> None:
    data = b'-      5.23  =A\r\n\x15+    0.1234    \r\n'
    whole = Framer(ND287).feed(data)
    assert whole == [b'-      5.23  =A', b'\x15', b'+    0.1234    ']
    single = Framer(ND287)
    assert [frame for byte in data for frame in single.feed(bytes([byte]))] == whole


def test_an_overlong_line_is_dropped_as_a_whole() -> None:
    framer, frame = Framer(LKG), b'M0,+01.2345,-00.1234'
    for _ in range(1000):
        assert framer.feed(b'x' * 97) == []
    # Its end looks like an answer.
    assert framer.feed(frame + b'\r' + frame + b'\r') == [frame]
    assert framer.dropped == 97_000 + len(frame)
    framer = Framer(ND287)
    assert framer.feed(b'x' * 100 + b'\r') == []
    assert framer.feed(b'\n' + b'-      5.23  =A\r\n') == [b'-      5.23  =A']


def test_clearing_forgets_half_a_frame() -> None:
    framer = Framer(LKG)
    assert framer.feed(b'M0,+01.') == []
    framer.clear()
    assert framer.feed(b'M0,+01.2345,-00.1234\r') == [b'M0,+01.2345,-00.1234']


# --- fuzzing against readers that share no code with the protocols ---


def _digits(text: str, most_points: int) -> bool:
    return (
        text.count('.') <= most_points
        and all(c in '0123456789.' for c in text)
        and not text.startswith('.')
        and not text.endswith('.')
        and text != ''
    )


def _lkg_field(text: str) -> Decimal | None:
    good = len(text) == 8 and text[0] in '+-' and _digits(text[1:], 1)
    return Decimal(text) if good else None


def oracle_lkg(frame: bytes) -> list | None:
    text = frame.decode('latin-1')
    if not text.startswith('M0,') or text.count(',') != 2:
        return None
    fields = text.split(',')[1:]
    legal = {'XXXXXXXX', '+FFFFFFF', '-FFFFFFF', '+FFFFFF', '-FFFFFF'}
    if any(_lkg_field(field) is None and field not in legal for field in fields):
        return None
    return [_lkg_field(field) for field in fields]


def oracle_nd287(frame: bytes) -> list | None:
    text = frame.decode('latin-1')
    if len(text) != 15 or text[0] not in '+-' or text[11] != ' ' or text[13] not in ' <=>?':
        return None
    number = text[1:11].lstrip(' ')
    if not _digits(number, 1) or text[12] != ' ' or text[14] not in ' A1':
        return None
    return [Decimal(text[0] + number)]


def oracle_nd287_a(frame: bytes) -> list | None:
    text = frame.decode('latin-1')
    good = len(text) == 11 and text[0] == '\x02' and text[1] in '+-' and _digits(text[2:], 0)
    return [Decimal(text[1:]) / 10000] if good else None


def oracle_mux(frame: bytes) -> list | None:
    text = frame.decode('latin-1')
    good = len(text) == 12 and text[:3] == '01A' and text[3] in '+-' and _digits(text[4:], 1)
    return [Decimal(text[3:])] if good else None


def oracle_digimatic(frame: bytes) -> list | None:
    text = frame.decode('latin-1').strip('\n')
    good = len(text) == 13 and text[:4].upper() == 'FFFF' and text[4] in '08'
    if not good or not _digits(text[5:], 0) or text[11] not in '012345' or text[12] != '0':
        return None
    value = Decimal(int(text[5:11])).scaleb(-int(text[11]))
    return [-value if text[4] == '8' else value]


SEEDS = {
    'lkg': (LKG, oracle_lkg, [
        b'M0,+01.2345,-00.1234\r', b'M0,XXXXXXXX,+FFFFFFF\r', b'ER,M0,01\r', b'M1,+00.0001\r',
    ]),
    'nd287': (ND287, oracle_nd287, [
        b'-      5.23  =A\r\n', b'+  123.4567    \r\n', b'+    0.0000 ?  \r\n', b'\x15',
        b'\x02+000012345\r\n',
    ]),
    'nd287-a': (ND287_A, oracle_nd287_a, [
        b'\x02+123456789\r\n', b'\x02-000001473\r\n', b'\x15', b'+    0.1234    \r\n',
    ]),
    'mux10': (MUX, oracle_mux, [
        b'01A-001.2340\r', b'01A+00.12345\r', b'911\r', b'02A+000.1000\r',
    ]),
    'digimatic': (DIGIMATIC, oracle_digimatic, [b'FFFF801234530\r\n', b'FFFF021076540\r']),
}


def mangle(rng: random.Random, data: bytes) -> bytes:
    """Random bytes, flipped bits, truncation, concatenation, insertion, deletion, or nothing."""
    what, data = rng.randrange(7), bytearray(data)
    at = rng.randrange(len(data))
    if what == 0:
        return rng.randbytes(rng.randrange(1, 40))
    if what == 1:
        data[at] ^= 1 << rng.randrange(8)
    elif what == 2:
        return bytes(data[:at])
    elif what == 3:
        return bytes(data[at:] + data)
    elif what == 4:
        data.insert(at, rng.choice(b'0123456789.+-,FX \r\n\x02\x15'))
    elif what == 5:
        del data[at]
    return bytes(data)


@pytest.mark.parametrize('name', SEEDS)
def test_every_number_out_was_legally_framed_in(name) -> None:
    protocol, oracle, seeds = SEEDS[name]
    rng = random.Random(f'gauge {name}')
    numbers = refused = 0
    for _ in range(3000):
        stream = b''.join(mangle(rng, rng.choice(seeds)) for _ in range(rng.randrange(1, 30)))
        framer, out = Framer(protocol), []
        at = 0
        while at < len(stream):
            size = rng.randrange(1, 12)
            out += framer.feed(stream[at : at + size])
            at += size
        # What an independent cut of the same stream gives, in the same order.
        marked = stream
        if protocol.alone:
            marked = stream.replace(b'\x15', b'\x15' + protocol.terminator)
        lines = marked.split(protocol.terminator)[:-1]
        assert out == [line for line in lines if len(line) <= protocol.longest]
        for frame in out:
            try:
                readings = protocol.queries[0].read(frame)
            except (IllegalFrame, OtherAnswer):
                assert oracle(frame) is None
                refused += 1
                continue
            expected = oracle(frame)
            for index, one in enumerate(readings):
                if one.status is Status.VALID:
                    assert expected is not None, frame
                    assert one.value == float(expected[index])
                    numbers += 1
                else:
                    assert math.isnan(one.value)
                    assert expected is None or expected[index] is None
    # The mangling leaves some frames legal and some not.
    assert numbers > 3000
    assert refused > 10_000


def test_random_bytes_give_no_number() -> None:
    rng = random.Random(5)
    for protocol, _, _ in SEEDS.values():
        framer = Framer(protocol)
        for _ in range(300):
            for frame in framer.feed(rng.randbytes(64)):
                with pytest.raises((IllegalFrame, OtherAnswer)):
                    if all(one.status is ERROR for one in protocol.queries[0].read(frame)):
                        raise IllegalFrame('a refusal is no number')
