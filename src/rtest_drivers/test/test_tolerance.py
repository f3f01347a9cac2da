"""`rtest identify --tolerance`: the example file on a recording, and mistakes in a file."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rtest_drivers import cli
from rtest_drivers.config import config_path

SHORT = Path(__file__).resolve().parents[3] / 'bags' / 'short'


def run(capsys, *arguments) -> tuple[int, str, str]:
    status = cli.main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    return status, out, err


def test_the_example_judges_a_recording(capsys, tmp_path):
    status, out, err = run(
        capsys, 'identify', SHORT, '--out', tmp_path, '--tolerance',
        config_path('tolerance_example.yaml'),
    )
    assert status == 0 and not err
    data = json.loads((tmp_path / 'identification.json').read_text())
    judged = data['verdict']
    assert judged['overall'] in ('pass', 'fail', 'undecided')
    kinds = {entry['symbol']: entry['verdict'] for entry in judged['errors']}
    assert {'E_X(0B)C', 'E_A(0Y)Z', 'E_A(Y)B', 'residual', 'volumetric'} <= set(kinds)
    assert not [s for s in data['undetermined'] if kinds[s] != 'undecided']
    assert f'verdict: {judged["overall"]} (' in out.splitlines()[-1]
    assert any('E_X(0B)C' in line and 'µm' in line for line in out.splitlines())


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        ('E_X(0B)D: {limit_um: 5}', 'E_X(0B)D: this machine has no such error or group; nearest'),
        ('E_X(0B)C: {limit: 5}', "unknown key 'limit'"),
    ],
)
def test_a_mistake_in_the_file_is_one_line(capsys, tmp_path, text, expected):
    path = tmp_path / 'limits.yaml'
    path.write_text(text)
    out_folder = tmp_path / 'out'
    status, _, err = run(capsys, 'identify', SHORT, '--out', out_folder, '--tolerance', path)
    assert status == 2
    assert err.startswith(f'rtest: {path}: ') and err.count('\n') == 1 and expected in err
    assert not out_folder.exists()
