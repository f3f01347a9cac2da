"""The README names every key of the files that people and programs read and write."""

import ast
import re
from pathlib import Path

import pytest
from test_gap import EFFECTS, run
from test_verdict import RESULT, tolerances

from rtest_estimation.errors import UserError
from rtest_identification.gap.output import as_dict as gap_as_dict
from rtest_identification.output import as_dict
from rtest_identification.session_file import load_session
from rtest_identification.verdict import judge

ROOT = Path(__file__).resolve().parents[3]
README = (ROOT / 'README.md').read_text(encoding='utf-8')
MACHINE = ROOT / 'src/rtest_drivers/config/nmv1500dcg.yaml'


def keys(data):
    """Every key that is a word; symbols, axes and names of cycles are data."""
    found = set()
    if isinstance(data, dict):
        found = {key for key in data if re.fullmatch('[a-z][a-z0-9_]*', key)}
        data = data.values()
    elif not isinstance(data, list):
        return found
    return found.union(*map(keys, data))


def lacking(words):
    return sorted(word for word in words if f'`{word}`' not in README)


def test_the_keys_of_identification_json(tmp_path):
    verdict = judge(RESULT, tolerances(tmp_path, 'residual: {max_um: 2}'))
    data = as_dict(RESULT, verdict)
    assert len(data['error_maps']) == 2
    data['runout'] = dict.fromkeys(('radius', 'stddev', 'residual'))
    data['missing'] = [{'cycle': '', 'pose': 0, 'reason': ''}]
    assert len(keys(data)) > 50 and lacking(keys(data)) == []


def test_the_keys_of_gap_json():
    data = gap_as_dict('made', run(EFFECTS['scale/X'], 36))
    (effect,) = data['effects']
    for named in ('parameters', 'stddev', 'units'):
        effect[named] = None
    assert data['where'] and len(keys(data)) > 30 and lacking(keys(data)) == []


@pytest.mark.parametrize('section', [
    None, 'cycle', 'nest_calibration', 'spindle_runout', 'moves', 'table', 'spindle', 'devices',
])
def test_the_keys_of_a_session_file(tmp_path, section):
    head = (
        f'machine: {MACHINE}\nsetups: {{a: {{sphere_mm: [0, 0, 40]}}}}\n'
        'cycle: {b_deg: [-30, 0, 30], c_deg: [0, 90, 180], %s}\n'
    )
    text = head % ''
    if section is None:
        text += 'nonsense: 1\n'
    elif section == 'cycle':
        text = head % 'nonsense: 1'
    else:
        text += f'{section}: {{nonsense: 1}}\n'
    path = tmp_path / 'session.yaml'
    path.write_text(text)
    with pytest.raises(UserError, match="unknown key 'nonsense', expected one of") as caught:
        load_session(path)
    known = ast.literal_eval(str(caught.value).partition('expected one of ')[2])
    assert known and lacking(known) == []
