"""A model file in the simulated cell: the loop from gap to truth and back."""

from pathlib import Path

import numpy as np
import pytest

from rtest_drivers.sim.errors import NO_ERRORS
from rtest_drivers.sim.kinematics import sphere_in_table
from rtest_drivers.sim.model import load_motions
from rtest_drivers.sim.truth import load_truth
from rtest_estimation.errors import UserError
from rtest_identification.gap.model_file import Model, ModelEffect, Value, save_model

CONFIG = Path(__file__).resolve().parents[1] / 'config'


def model_file(tmp_path, key, parameters, shape=None):
    effect = ModelEffect(
        key, {k: Value(v, None, '') for k, v in parameters.items()},
        {k: Value(v, None, '') for k, v in (shape or {}).items()},
    )
    save_model(Model('m', 'NMV1500DCG', {}, (effect,)), tmp_path / 'model.yaml')
    return tmp_path / 'model.yaml'


def truth_file(tmp_path, model):
    text = (CONFIG / 'cell_demo.yaml').read_text()
    text = text.replace('machine: nmv1500dcg.yaml', f'machine: {CONFIG / "nmv1500dcg.yaml"}')
    path = tmp_path / 'cell.yaml'
    path.write_text(f'{text}\nmodel: {model}\n')
    return path


def test_a_model_moves_the_machine_as_its_formula_says(tmp_path):
    cell = load_truth(truth_file(tmp_path, model_file(tmp_path, 'scale/X', {'e': 1e-5})))
    motions = cell.errors.model
    assert motions.axes == {'X'}
    at = {name: np.array([0.2, -0.1]) for name in cell.machine.letters}
    np.testing.assert_allclose(motions.of_axis('X', at)[:, 3], [2e-6, -1e-6])
    np.testing.assert_allclose(motions.of_axis('B', at), 0.0)


def test_growing_coning_by_hand(tmp_path):
    path = model_file(tmp_path, 'coning-grows/C', {'A cos z': 1e-5, 'A sin z': 0.0})
    cell = load_truth(truth_file(tmp_path, path))
    at = {name: np.zeros(1) for name in cell.machine.letters}
    at |= {'B': np.array([np.pi / 2]), 'C': np.array([np.pi / 2])}
    # (E_A, E_B) = A (cos C, sin C) at B = 90 deg: all of it in E_B.
    found = cell.errors.model.of_axis('C', at)[0]
    np.testing.assert_allclose(found[:3], [0.0, 1e-5, 0.0], atol=1e-18)


def test_the_sphere_sees_it(tmp_path):
    path = model_file(tmp_path, 'scale/X', {'e': 1e-5})
    machine = load_truth(CONFIG / 'cell_demo.yaml').machine
    from dataclasses import replace

    errors = replace(NO_ERRORS, model=load_motions(path, machine))
    position = np.zeros((1, 5))
    position[0, machine.letters.index('X')] = 0.1
    moved = sphere_in_table(machine, position, errors) - sphere_in_table(machine, position)
    np.testing.assert_allclose(moved[0], [1e-6, 0.0, 0.0], atol=1e-15)


@pytest.mark.parametrize(
    ('key', 'parameters', 'words'),
    [('backlash/X', {'h': 1e-6}, 'not simulated'), ('scale/X', {'f': 1.0}, 'expected one of e'),
     ('scale/Q', {'e': 1.0}, 'no effect')],
)
def test_what_cannot_be_simulated_is_refused(tmp_path, key, parameters, words):
    path = model_file(tmp_path, key, parameters)
    with pytest.raises(UserError, match=words):
        load_truth(truth_file(tmp_path, path))


OWN = 'effects: [{key: lobes/C, motions: {E_XC: "%s"}, parameters: {p: {unit: um}}}]'


def own_truth_file(tmp_path, formula):
    path = truth_file(tmp_path, model_file(tmp_path, 'lobes/C', {'p': 2e-6}))
    effects = tmp_path / 'effects.yaml'
    effects.write_text(OWN % formula)
    with path.open('a') as file:
        file.write(f'effects: {effects}\n')
    return path


def test_an_effect_of_the_users_own_moves_the_machine(tmp_path):
    cell = load_truth(own_truth_file(tmp_path, 'p*cos(4*C)*sin(B)'))
    at = {name: np.zeros(2) for name in cell.machine.letters}
    at |= {'B': np.full(2, np.pi / 2), 'C': np.array([0.0, np.pi / 4])}
    found = cell.errors.model.of_axis('C', at)
    np.testing.assert_allclose(found, [[0, 0, 0, 2e-6, 0, 0], [0, 0, 0, -2e-6, 0, 0]], atol=1e-18)


@pytest.mark.parametrize('formula', ['p*t', 'p*sign(C)', 'p*d1'])
def test_an_own_effect_of_more_than_positions_is_not_simulated(tmp_path, formula):
    with pytest.raises(UserError, match='not simulated'):
        load_truth(own_truth_file(tmp_path, formula))


def test_an_own_effect_that_is_not_given_and_effects_without_a_model(tmp_path):
    path = truth_file(tmp_path, model_file(tmp_path, 'lobes/C', {'p': 2e-6}))
    with pytest.raises(UserError, match='effects: beside model:'):
        load_truth(path)
    path.write_text(path.read_text().replace('model:', 'effects:'))
    with pytest.raises(UserError, match='expected model: beside it'):
        load_truth(path)


def test_the_model_of_another_machine_is_refused(tmp_path):
    model = model_file(tmp_path, 'scale/X', {'e': 1e-5})
    model.write_text(model.read_text().replace('NMV1500DCG', 'other'))
    with pytest.raises(UserError, match="is of machine 'other', the simulated one is 'NMV1500DCG"):
        load_truth(truth_file(tmp_path, model))
