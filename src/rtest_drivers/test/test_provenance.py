"""What a recording says of how it was made, and identification with another nest calibration."""

import dataclasses
import hashlib
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

import rtest_estimation
from rtest_drivers.info import describe
from rtest_drivers.mcap_file import McapFile
from rtest_drivers.message_types import MessageTypes
from rtest_drivers.provenance import provenance
from rtest_estimation.errors import UserError
from rtest_estimation.recording import read_recording
from rtest_estimation.version import code_version
from rtest_identification.offline import estimate_recording, identify_recording, nests_of

ROOT = Path(__file__).resolve().parents[3]
SHORT = ROOT / 'bags' / 'short'
SESSION = ROOT / 'bags' / 'short.yaml'


def test_the_code_is_told_apart(tmp_path, monkeypatch):
    folder = Path(rtest_estimation.__file__).parent
    files = {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob('*.py')}
    text = b''.join(name.encode() + b'\0' + files[name] for name in sorted(files, key=Path))
    assert f'(code {hashlib.sha256(text).hexdigest()[:12]})' in code_version('rtest_estimation')
    shutil.copytree(folder, tmp_path / 'rtest_copy', ignore=shutil.ignore_patterns('__pycache__'))
    monkeypatch.syspath_prepend(tmp_path)
    same = code_version('rtest_copy')
    assert same.partition(' (')[2] == code_version('rtest_estimation').partition(' (')[2]
    with (tmp_path / 'rtest_copy' / 'errors.py').open('a') as file:
        file.write('# changed\n')
    code_version.cache_clear()
    assert code_version('rtest_copy') != same


def test_session_and_device_files_are_in_it_word_for_word(tmp_path):
    found = yaml.safe_load(provenance('monday', SESSION, {'gauges': SESSION}, {}))
    assert found['session'] == 'monday'
    assert found['session_file'] == {'path': str(SESSION), 'text': SESSION.read_text()}
    assert found['devices']['gauges'] == found['session_file']
    assert found['software']['rtest_drivers'] == code_version('rtest_drivers')
    assert found['libraries']['numpy'] == np.__version__
    # As it is recorded: CDR of a std_msgs/String.
    text = provenance('monday', SESSION, {}, {'1a-nest': 28}).encode() + b'\0'
    definition = MessageTypes().definition('std_msgs/msg/String')
    bag = McapFile(tmp_path / 'bag')
    bag.add_topic('/rtest/configuration', definition.name, definition.text, definition.type_hash)
    data = b'\0\1\0\0' + len(text).to_bytes(4, 'little') + text
    bag.write('/rtest/configuration', 10**9, 10**9, 0, data)
    bag.close()
    lines = describe(tmp_path / 'bag')
    assert f'software  rtest_estimation {code_version("rtest_estimation")}' in lines


def test_another_nest_calibration_turns_every_displacement():
    recording = read_recording(SHORT)
    own = {f.nest.setup: f.nest for f in estimate_recording(recording) if f.nest is not None}
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    given = {
        name: dataclasses.replace(nest, direction=nest.direction @ turned, calibration='x')
        for name, nest in own.items()
    }
    before = estimate_recording(recording)
    after = estimate_recording(recording, nests=given)
    measured = [(a, b) for a, b in zip(before, after, strict=True) if a.nest is None]
    assert len(measured) == 3
    for one, other in measured:
        assert other.cycle.calibration == 'x'
        for point, same in zip(one.cycle.points, other.cycle.points, strict=True):
            # d = V x = (V T) (T' x), and V T is what is now taken for V.
            np.testing.assert_allclose(
                same.displacement, turned.T @ point.displacement, rtol=0, atol=1e-12
            )


def test_its_own_calibration_given_changes_nothing():
    one, other = identify_recording(SHORT), identify_recording(SHORT, nest_path=SHORT)
    np.testing.assert_array_equal(one.location.value, other.location.value)
    with pytest.raises(UserError, match='no nest calibration of set-up .*, there is '):
        plans = read_recording(SHORT).plans
        nests_of(SHORT, [dataclasses.replace(plans[0], setup='elsewhere')])


def test_cycles_that_were_not_begun_are_told(tmp_path, monkeypatch):
    """A session that was killed in its second cycle."""
    wanted = {'outer-nest': 28, 'outer-static': 27, 'third': 30, 'fourth': 12}
    monkeypatch.setattr('rtest_drivers.info._configuration', lambda bag, key: wanted)
    lines = '\n'.join(describe(SHORT))
    assert 'third, fourth: 42 poses were not begun' in lines
