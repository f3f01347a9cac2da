"""Mistakes in the files beside a recording are told before its readings are looked at."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from test_recording import BagMaker, temperature

from rtest_drivers import cli
from rtest_estimation.errors import UserError
from rtest_estimation.recording import read_recording
from rtest_identification.gap.offline import gap_recording

SHORT = Path(__file__).resolve().parents[3] / 'bags' / 'short'
EFFECTS = 'effects: [{key: mine/B, motions: {E_XB: %s}, parameters: {p: {unit: um}}}]'


@pytest.mark.parametrize(
    ('command', 'option', 'text', 'expected'),
    [
        ('identify', '--tolerance', 'squareness: {limit_um: 5}', '_um is for lengths'),
        ('identify', '--tolerance', 'maps_D: {max_um: 5}', 'no such error or group'),
        ('identify', '--priors', 'linear_axes: {Q: {}}', 'expected a linear axis'),
        ('identify', '--model', 'effects: [{key: scael/X}]', 'did you mean scale/X'),
        ('identify', '--model', 'machine: other', "is of machine 'other'"),
        ('identify', '--machine', 'chain: []', 'axes: expected a mapping'),
        ('gap', '--model', 'effects: [{key: scael/X}]', 'did you mean scale/X'),
        ('gap', '--model', 'values: {E_X(0Q)B: {value: 0}}', 'no free error of this machine'),
        ('gap', '--model', 'machine: other', "is of machine 'other'"),
        ('gap', '--effects', EFFECTS % '0*p', 'its factor in the formulas is always 0'),
        ('gap', '--effects', EFFECTS % 'p*T.oil', 'this session has no temperatures'),
        ('gap', '--machine', 'chain: []', 'axes: expected a mapping'),
    ],
)
def test_a_mistake_is_told_first(capsys, tmp_path, monkeypatch, command, option, text, expected):
    def read(*_):
        raise AssertionError('the readings were looked at')

    monkeypatch.setattr('rtest_identification.offline.recording_of', read)
    monkeypatch.setattr('rtest_identification.gap.offline.recording_of', read)
    path = tmp_path / 'file.yaml'
    path.write_text(text)
    arguments = [command, str(SHORT), '--out', str(tmp_path / 'out'), option, str(path)]
    assert cli.main(arguments) == 2
    _, error = capsys.readouterr()
    assert expected in error and error.count('\n') == 1


def test_effects_see_the_temperatures_of_the_recording(tmp_path):
    folder = tmp_path / 'warm'
    folder.mkdir()
    shutil.copy(SHORT / 'short.mcap', folder / 'warm_0.mcap')
    recording = read_recording(SHORT)
    start = recording.plans[0].stamp
    more = BagMaker(folder / 'warm_1.mcap')
    for stamp in range(recording.start, recording.end, 10**9):
        warm = 20.0 - np.expm1(-max(stamp - start, 0) * 1e-9 / 80.0)
        more.add('/rtest/temperature', temperature('oil', warm, stamp), stamp)
    more.add('/rtest/temperature', temperature('', 20.0, start), start)
    more.close()
    path = tmp_path / 'effects.yaml'
    path.write_text(EFFECTS % 'p*(T.oil - 20)')
    found = gap_recording(folder, effects_path=path)
    # That is the library's drift of B with the time constant 80 s, beside what is constant.
    (told,) = found.confusions
    assert told.startswith('mine/B looks like drift (')
    assert any('/rtest/temperature: 1 message left out' in text for text in found.warnings)
    path.write_text(EFFECTS % 'p*T.bed')
    with pytest.raises(UserError, match=r'this session has T\.oil'):
        gap_recording(folder, effects_path=path)
