"""Recordings are input of strangers: one line for each, in bounded memory, and never code."""

import resource
import subprocess
import sys

import hostile
import hostile_cases
import pytest
import zstandard
from hostile_cases import CASES, CORPUS, chunk, file, message

from rtest_drivers.info import describe
from rtest_estimation.bagfile import read_bag
from rtest_estimation.errors import UserError
from rtest_estimation.yaml_text import MAX_DEPTH, MAX_SIZE, load_yaml, read_yaml
from rtest_identification.machine import parse_machine
from rtest_identification.offline import identify_recording
from rtest_identification.session_file import load_session


def told(path):
    """Everything that is said of a recording."""
    lines = []
    try:
        lines += describe(path)
    except UserError as error:
        lines.append(str(error))
    try:
        identify_recording(path)
    except UserError as error:
        lines.append(str(error))
    assert all(' '.join(line.split()).isprintable() for line in lines)
    return '\n'.join(lines)


@pytest.mark.parametrize('path', sorted(CORPUS.glob('*.mcap')), ids=lambda path: path.stem)
def test_every_file_of_the_corpus_is_told_in_lines(path):
    _, expected = CASES.get(path.stem, (None, ''))
    assert expected in told(path)
    hostile.read(path)


def test_the_corpus_is_what_makes_it(tmp_path):
    """A case whose file was forgotten, or whose maker has changed since."""
    assert {path.stem for path in CORPUS.glob('*.mcap')} >= CASES.keys()
    for name in ('plan_of_no_kind', 'record_longer_than_the_file'):
        CASES[name][0](tmp_path / 'new')
        assert (tmp_path / 'new').read_bytes() == (CORPUS / f'{name}.mcap').read_bytes()


def test_recordings_changed_at_random(tmp_path):
    mutator = hostile.Mutator(tmp_path)
    assert hostile.read(tmp_path / 'good.mcap') == 'read'
    answers = [
        hostile.read(mutator.mutated(seed, tmp_path / 'changed.mcap'), identify=seed % 4 == 0)
        for seed in range(80)
    ]
    # They are neither all read nor all refused.
    assert 20 < answers.count('read') < 79


BOMBS = """
import resource, sys
from rtest_estimation.bagfile import read_bag
from rtest_estimation.errors import UserError
try:
    print(sum(read_bag(sys.argv[1], ['std_msgs/msg/String']).topics.get('/a', ('', 0))[1:]))
except UserError as error:
    print(error)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024)
"""


@pytest.mark.parametrize(
    ('name', 'expected'),
    [('declared', 'unpacks to more than 100 times its size'), ('hidden', '1'), ('one', '2')],
)
def test_bombs_take_bounded_memory(tmp_path, name, expected):
    """Four gigabytes in forty chunks; the same not declared; and one chunk as large as may be."""
    size = 100_000_000
    bomb = message(b'\0\1\0\0' + bytes(size))
    packed = zstandard.compress(bomb)
    declared = {'declared': len(bomb), 'hidden': 1000, 'one': len(bomb)}[name]
    chunks = [chunk(b'', 'zstd', declared, packed)] * (1 if name == 'one' else 40)
    records = (hostile_cases.schema(), hostile_cases.channel(), message(), *chunks)
    path = tmp_path / 'bomb.mcap'
    path.write_bytes(file(*records))
    assert path.stat().st_size < 1_000_000
    answer, memory = subprocess.run(
        [sys.executable, '-c', BOMBS, str(path)], capture_output=True, text=True, check=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30)),
    ).stdout.splitlines()
    assert expected in answer
    # Twice the largest chunk that is believed, and Python with its libraries.
    assert int(memory) < 700


@pytest.mark.parametrize(
    ('listed', 'expected'),
    [
        ('../secret.mcap', None),
        ('/etc/passwd', None),
        ('..', None),
        ('', None),
        ('link.mcap', 'leads out of the recording'),
        ('{a: b}', None),
        ('~', None),
    ],
)
def test_metadata_leads_to_nothing_outside(tmp_path, listed, expected):
    secret, bag = tmp_path / 'secret.mcap', tmp_path / 'bag'
    secret.write_bytes(file(hostile_cases.schema(), hostile_cases.channel('/secret'), message()))
    bag.mkdir()
    (bag / 'bag.mcap').write_bytes(
        file(hostile_cases.schema(), hostile_cases.channel('/inside'), message())
    )
    if 'link' in listed:
        (bag / listed).symlink_to(secret)
    (bag / 'metadata.yaml').write_text(
        f'rosbag2_bagfile_information:\n  relative_file_paths: [{listed}]\n'
    )
    if expected:
        with pytest.raises(UserError, match=expected):
            read_bag(bag, ())
    else:
        assert list(read_bag(bag, ()).topics) == ['/inside']


def test_a_link_without_metadata_leads_to_nothing_outside(tmp_path):
    (tmp_path / 'bag').mkdir()
    (tmp_path / 'secret.mcap').write_bytes(file())
    (tmp_path / 'bag' / 'a.mcap').symlink_to(tmp_path / 'secret.mcap')
    with pytest.raises(UserError, match='leads out of the recording'):
        read_bag(tmp_path / 'bag', ())


def anchors(levels):
    """A few hundred bytes that unfold to 2**levels texts."""
    lines = ['k0: &k0 [x, x]']
    lines += [f'k{n}: &k{n} [*k{n - 1}, *k{n - 1}]' for n in range(1, levels)]
    return '\n'.join(lines)


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        (anchors(40), 'no anchors and aliases'),
        ('a: &a 1', 'no anchors and aliases'),
        ('a: !!python/object/apply:os.system [touch x]', 'not valid YAML'),
        ('a: !own 1', 'not valid YAML'),
        ('[' * 5000, f'{MAX_DEPTH} levels'),
        ('{a: ' * (MAX_DEPTH + 1) + '1' + '}' * (MAX_DEPTH + 1), f'{MAX_DEPTH} levels'),
        ('a: ' + '9' * 5000, 'not valid YAML'),
        ('a: 0x' + 'f' * 5000, '64 bits'),
        ('a: 2001-99-99', 'not valid YAML'),
        ('a: 1\na: 2', 'a key is there twice'),
        ('a: "\\x00"\n\x00', 'not valid YAML'),
        ('x' * (MAX_SIZE + 1), 'larger than'),
        ('--- 1\n--- 2', 'not valid YAML'),
    ],
)
def test_yaml_that_grows_or_runs_is_refused_in_one_line(tmp_path, text, expected):
    for refuse in (
        lambda: load_yaml(text, 'here'),
        lambda: parse_machine(text, 'here'),
    ):
        with pytest.raises(UserError, match=expected) as error:
            refuse()
        assert str(error.value).startswith('here: ')
        assert '\n' not in str(error.value)
        assert len(str(error.value)) < 300
    path = tmp_path / 'session.yaml'
    path.write_text(text)
    with pytest.raises(UserError, match=expected):
        load_session(path)
    assert not (tmp_path / 'x').exists()


def test_plain_yaml_is_read_as_before(tmp_path):
    text = 'a: 1\nb: [1.5, x, true, ~]\nc: {d: -3, e: "y"}\nf: 2001-02-03\n'
    data = load_yaml(text, 'here')
    assert data['a'] == 1
    assert data['b'] == [1.5, 'x', True, None]
    assert data['c'] == {'d': -3, 'e': 'y'}
    (tmp_path / 'file').write_text(text)
    assert read_yaml(tmp_path / 'file', 'it') == data
    with pytest.raises(UserError, match='cannot read it'):
        read_yaml(tmp_path, 'it')
    with pytest.raises(UserError, match='larger than'):
        read_yaml('/dev/zero', 'it')
