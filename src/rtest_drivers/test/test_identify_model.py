"""Identifying with a model: without effects, with effects of one's own, and where results go."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rtest_drivers import cli

SHORT = Path(__file__).resolve().parents[3] / 'bags' / 'short'
OWN = 'effects: [{key: my-lobes/C, motions: {E_XC: p*cos(4*C)}, parameters: {p: {unit: um}}}]'
MODEL = 'effects: [{key: my-lobes/C, parameters: {p: {value: 1.0e-6, unit: m}}}]'


def write(path, text):
    path.write_text(text)
    return str(path)


def identified(folder, *options):
    assert cli.main(['identify', str(SHORT), '--out', str(folder), *options]) == 0
    return json.loads((folder / 'identification.json').read_text())


def test_a_model_without_effects_and_one_with_an_effect_of_ones_own(tmp_path):
    empty = write(tmp_path / 'empty.yaml', 'name: empty\nvalues: {}\n')
    own = write(tmp_path / 'own.yaml', 'name: own\n' + MODEL)
    effects = write(tmp_path / 'effects.yaml', OWN)
    without = identified(tmp_path / 'without')
    with_empty = identified(tmp_path / 'empty', '--model', empty)
    assert with_empty['model'] == 'empty'
    assert with_empty['residual_rms'] == without['residual_rms']
    with_own = identified(tmp_path / 'own', '--model', own, '--effects', effects)
    assert with_own['model'] == 'own'
    assert with_own['residual_rms'] != without['residual_rms']


@pytest.mark.parametrize('command', ['identify', 'gap'])
def test_a_model_whose_own_effect_is_not_given(capsys, tmp_path, command):
    model = write(tmp_path / 'model.yaml', MODEL)
    assert cli.main([command, str(SHORT), '--out', str(tmp_path / 'o'), '--model', model]) == 2
    _, error = capsys.readouterr()
    assert 'my-lobes/C' in error and '--effects' in error and error.count('\n') == 1


def test_effects_are_those_of_a_model(capsys, tmp_path):
    effects = write(tmp_path / 'effects.yaml', OWN)
    arguments = ['identify', str(SHORT), '--out', str(tmp_path / 'o'), '--effects', effects]
    assert cli.main(arguments) == 2
    assert '--model' in capsys.readouterr().err


@pytest.mark.parametrize('command', ['identify', 'gap'])
def test_two_recordings_of_one_name_are_not_written_to_one_folder(capsys, tmp_path, command):
    # Nothing is read: the recordings are not there.
    bags = [str(tmp_path / place / 's') for place in 'ab']
    assert cli.main([command, *bags, '--out', str(tmp_path / 'same')]) == 2
    _, error = capsys.readouterr()
    assert f'both would be written to {tmp_path / "same" / "s"}' in error
    assert error.count('\n') == 1
    assert not (tmp_path / 'same').exists()
