"""Effects of users: read safely, named and used as built-in ones are."""

import math
import time
from pathlib import Path

import numpy as np
import pytest
from independent import NMV, SETUPS, noisy, static_cycle

from rtest_estimation.errors import UserError
from rtest_identification.gap.confusions import confusions, described
from rtest_identification.gap.effects import library
from rtest_identification.gap.formula import parse_formula
from rtest_identification.gap.model_file import (
    Model,
    ModelEffect,
    Value,
    load_model,
    save_model,
)
from rtest_identification.gap.rows import make_rows
from rtest_identification.gap.separate import separate
from rtest_identification.gap.units import to_si
from rtest_identification.gap.user_effects import RESERVED, load_effects
from rtest_identification.gap.workflow import analyse
from rtest_identification.machine import parse_machine
from rtest_identification.observations import stack

MACHINE = parse_machine(NMV)
NEST = np.array([[1, 0, 1], [-0.5, 0.8660254037844386, 1], [-0.5, -0.8660254037844386, 1]])
NEST = NEST / np.sqrt(2.0)
BEARING = """
effects:
  - key: my-bearing/C
    name: bearing of the table
    motions:
      E_X(B)C: p*cos(4*C) + q*sin(4*C)
      E_YC: -p*sin(4*C) + q*cos(4*C)
    parameters: {p: {unit: um}, q: {unit: um}}
"""
NOISE = 2.5e-7


def one(formula, more='', unit='um'):
    return (
        f'effects: [{{key: mine/C, motions: {{E_XC: "{formula}"}}, '
        f'parameters: {{p: {{unit: {unit}}}}}{more}}}]'
    )


def load(tmp_path, text, **options):
    path = tmp_path / 'mine.yaml'
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_effects(path, MACHINE, **options)


def refused(tmp_path, text, **options):
    """The one line with which a file is refused, at once."""
    begun = time.monotonic()
    with pytest.raises(UserError) as caught:
        load(tmp_path, text, **options)
    assert time.monotonic() - begun < 2.0
    message = str(caught.value)
    assert 'mine.yaml' in message
    assert message.isascii() and message.isprintable() and len(message) < 700
    return message


@pytest.fixture(scope='module')
def rows():
    def plain(b, c):
        return {'C': {'X': 20e-6, 'A': 5e-5}, 'B': {'Z': -10e-6}}

    rng = np.random.default_rng(5)
    observations = stack(MACHINE, [noisy(static_cycle(s, plain), NOISE, rng) for s in SETUPS])
    return make_rows(observations, 0, dict.fromkeys(SETUPS, NEST))


def test_columns_are_the_formula_times_the_response_of_the_machine(tmp_path, rows):
    (effect,) = load(tmp_path, BEARING)
    scene = rows.scene
    c = scene.position('C')[:, None]
    x, y = scene.slope('C', 'X'), scene.slope('C', 'Y')
    wanted = np.stack(
        [x * np.cos(4 * c) - y * np.sin(4 * c), x * np.sin(4 * c) + y * np.cos(4 * c)], axis=2
    )
    assert np.allclose(effect.columns(scene, ()), wanted, rtol=0, atol=1e-15)
    assert effect.key == 'my-bearing/C'
    assert effect.symbols == ('E_XC', 'E_YC')
    assert [(p.name, p.unit) for p in effect.parameters] == [('p', 'm'), ('q', 'm')]


@pytest.mark.parametrize('formula, of', [
    ('p*sign(B)', lambda s: s.direction('B')),
    ('p*X**2', lambda s: s.position('X') ** 2),
    ('-p/(2 + B)**2', lambda s: -1.0 / (2.0 + s.position('B')) ** 2),
    ('p*(sqrt(abs(B)) + pi)', lambda s: np.sqrt(np.abs(s.position('B'))) + math.pi),
    ('p*log(1 + t)/2**-1.5', lambda s: np.log1p(s.time) * 2.0**1.5),
    ('+p*tan(B/4)*exp(-t/100)', lambda s: np.tan(s.position('B') / 4) * np.exp(-s.time / 100)),
    ('p*d2', lambda s: s.fitted @ NEST[1]),
    ('p*C - 3*(p - p*B)/2', lambda s: s.position('C') - 1.5 + 1.5 * s.position('B')),
])
def test_names_and_operations_mean_what_they_say(tmp_path, rows, formula, of):
    (effect,) = load(tmp_path, one(formula))
    got = effect.columns(rows.scene, ())[:, :, 0]
    wanted = rows.scene.slope('C', 'X') * of(rows.scene)[:, None]
    assert np.allclose(got, wanted, rtol=1e-12, atol=1e-300)


def test_table_formulas_are_displacements(tmp_path, rows):
    text = (
        'effects: [{key: m, table: {Z: p*d1, X: q*t}, '
        'parameters: {p: {unit: 1}, q: {unit: um/h}}}]'
    )
    (effect,) = load(tmp_path, text)
    columns = effect.columns(rows.scene, ())
    assert np.array_equal(columns[:, 2, 0], rows.scene.fitted @ NEST[0])
    assert np.array_equal(columns[:, 0, 1], rows.scene.time)
    assert not columns[:, 1].any() and effect.symbols == ()
    assert [p.unit for p in effect.parameters] == ['1', 'm/s']


def test_shapes_are_in_si_and_their_grids_multiply(tmp_path, rows):
    shape = ', shape: {tau: {unit: min, grid: [1, 2]}, L: {unit: mm, grid: [20, 50, 30]}}'
    (effect,) = load(tmp_path, one('p*exp(-t/tau)*sin(X/L)', shape))
    assert len(effect.grid) == 6 and effect.grid[0] == pytest.approx((60.0, 0.02))
    assert [p.unit for p in effect.shape] == ['s', 'm']
    scene = rows.scene
    wanted = np.exp(-scene.time / 120) * np.sin(scene.position('X') / 0.03)
    got = effect.columns(scene, (120.0, 0.03))[:, :, 0]
    assert np.allclose(got, scene.slope('C', 'X') * wanted[:, None])
    # Beyond the grid its ends hold: the refinement looks a little past them.
    assert np.array_equal(
        effect.columns(scene, (59.0, 0.051)), effect.columns(scene, (60.0, 0.05))
    )
    with pytest.raises(UserError, match=r'mine/C: tau = 600: expected .* 60 to 120'):
        effect.columns(scene, (600.0, 0.03))


def test_a_temperature_is_interpolated_at_the_poses(tmp_path, rows):
    stamps, values = np.array([0, 80 * 10**9]), np.array([20.0, 24.0])
    (effect,) = load(tmp_path, one('p*T.oil'), temperatures={'oil': (stamps, values)})
    got = effect.columns(rows.scene, ())[:, :, 0]
    wanted = 20.0 + rows.scene.observations.stamp * 1e-9 / 20.0
    assert np.allclose(
        got, rows.scene.slope('C', 'X') * np.minimum(wanted, 24.0)[:, None], atol=1e-12
    )
    assert 'has no temperatures' in refused(tmp_path, one('p*T.oil'))
    message = refused(tmp_path, one('p*T.bed'), temperatures={'oil': (stamps, values)})
    assert "'T.bed': this session has T.oil" in message


def test_the_example_loads_and_is_visible(rows):
    config = Path(__file__).parents[2] / 'rtest_drivers' / 'config'
    effects = load_effects(config / 'effects_example.yaml', MACHINE)
    assert [e.key for e in effects] == ['my-bearing/C', 'my-brake/B', 'my-gauge/1']
    for effect in effects:
        columns = effect.columns(rows.scene, effect.grid[0])
        assert np.isfinite(columns).all() and columns.any()


@pytest.mark.parametrize('text, size, unit', [
    ('um', 1e-6, 'm'), ('arcsec', math.pi / 648000, 'rad'), ('um/m', 1e-6, 'm/m'),
    ('urad/mm', 1e-3, 'rad/m'), ('um/m^2', 1e-6, 'm/m^2'), ('nm/h', 1e-9 / 3600, 'm/s'),
    ('1/mm^2', 1e6, '1/m^2'), ('um/K', 1e-6, 'm/K'), ('1', 1.0, '1'),
])
def test_units(text, size, unit):
    found = to_si(text)
    assert found == (pytest.approx(size, rel=1e-12), unit)


@pytest.mark.parametrize('text', ['', 'UM', 'um/', '/m', 'um/m/m', 'um/m^9', 'um*m', 'um ', 'µm'])
def test_what_is_no_unit(text):
    assert to_si(text) is None


@pytest.mark.parametrize('formula, what', [
    ('p*p', 'product of parameters'),
    ('p**2', 'power of a parameter'),
    ('C/p', 'division by a parameter'),
    ('sin(p*C)', 'parameter inside sin()'),
    ('p*C + 1e-6', 'term without a parameter'),
    ('cos(C)', 'no parameter in it'),
    ('p*abs(p)', 'parameter inside abs()'),
])
def test_what_is_not_linear_is_told(tmp_path, formula, what):
    message = refused(tmp_path, one(formula))
    assert what in message and f"mine/C: E_XC = '{formula}'" in message


@pytest.mark.parametrize('formula', [
    '0*p', 'p*(C - C)', 'p - p', 'p*C - C*p', 'p*X*0*d1', 'p*(abs(sign(B)) - sign(B)**2)',
    'p*(abs(B) + B)*(abs(B) - B)',
])
def test_a_parameter_that_changes_nothing_is_refused(tmp_path, formula):
    assert 'mine/C: p: its factor in the formulas is always 0' in refused(tmp_path, one(formula))


def test_each_parameter_must_change_one_of_the_formulas(tmp_path):
    message = refused(tmp_path, BEARING.replace('q*sin(4*C)', '0*q').replace('q*cos', '0*q*cos'))
    assert 'my-bearing/C: q: its factor' in message
    (effect,) = load(tmp_path, BEARING.replace('q*sin(4*C)', '0*q'))
    assert len(effect.parameters) == 2


@pytest.mark.parametrize('formula', [
    # Small, short, far, seldom or not a number somewhere: no reason to refuse.
    '1e-9*p', 'p*X**8', 'p*exp(-t/0.1)', 'p*(abs(t - 7200) + t - 7200)', 'p*d1**4', 'p*log(B)',
    'p*exp(-((X - 0.05)/0.001)**2)', 'p*(1 - sign(B)**2)', 'p*(T.oil - 20)', 'p/(t - t)',
])
def test_a_parameter_that_changes_anything_is_not_refused(tmp_path, formula):
    steady = {'oil': (np.array([0]), np.array([20.0]))}
    assert load(tmp_path, one(formula), temperatures=steady)


def test_what_passes_is_linear_in_numbers_too():
    formula = parse_formula(
        '-(p*C - q)/(1 + C**2) + 2*q*sin(C) - (p + q)*3', 'w', ('p', 'q'), {'C'}
    )
    rng = np.random.default_rng(2)
    c, p, q = rng.normal(size=(3, 50))
    whole = -(p * c - q) / (1 + c**2) + 2 * q * np.sin(c) - (p + q) * 3
    parts = [formula.coefficient(name, ('p', 'q'), {'C': c}) for name in 'pq']
    assert np.allclose(p * parts[0] + q * parts[1], whole)


HOSTILE = [
    "__import__('os').system('true')", 'p*C.__class__', 'p*T.__class__', 'p.real', '__name__*p',
    'p*(lambda: 1)()', 'p*[C for C in (1,)][0]', 'p*sum(C for i in C)', 'p if C else p',
    'p*(C and B)', 'p*(not C)', 'p*(C is B)', 'p*(x:=1)', "p*'a'*9", 'p*True', 'p*1j', 'p*None',
    'p*(C<1)', 'p*...', 'p*C[0]', 'p*(C,B)', 'p*()', 'p*{1}', 'p*C//2', 'p*C%2', 'p*~1',
    'p*(1<<9999)', 'p@C', 'p*await C', "p*f'{C}'", 'p*sin(*C)', 'p*sin(**C)', 'p*sign(*B)',
    'p*sin(C, out=C)', 'p*sign(B, k=1)', 'p*sin(C, B)', 'p*sin', 'p*sin()', 'p*sin(C)()',
    'p*sign(B+C)', 'p*sign(Q)', 'p*sign', 'p*T', 'p*A', 'p*eval(C)', 'p*9**9**9**9**9',
    'p*2**99999999', 'p*C**B', 'p*C**9', 'p*C**1e3', 'p*C**-8.5', 'p*1e999', 'p*' + '9' * 450,
    'p*0x' + 'f' * 400, 'p;p', 'p=1', 'p\n*', '', ' ', '*', 'p*(', 'p)', '(' * 150,
    '(' * 150 + 'p' + ')' * 150, '-' * 400 + 'p', '+'.join(['p'] * 240), 'p*' + 'C(' * 19,
    'p*' + 'sin(' * 100 + 'C' + ')' * 100, 'p*' + 'C' * 20000, 'p' + '**2' * 100, 'ｐ*C',
    'p*ｓｉｎ(C)', 'p*С', 'p*π', 'p*C\u202e', 'p*C²', 'p*0777', 'p*1if C else 2', 'import os',
    'p*(yield)', 'p*d0', 'p*d99', 'p*nan', 'p*inf', 'p*pi.real', 'p*C!=1', 'p*0x1for x in C',
    'p # *C', '\\', '`p`', 'p*!C', 'p*$C', 'p*.C', 'p*C.1',
]


@pytest.mark.parametrize('formula', HOSTILE, ids=range(len(HOSTILE)))
def test_hostile_formulas_are_refused_in_one_line(tmp_path, formula):
    text = one(formula.replace('\\', '\\\\').replace('"', '\\"'))
    message = refused(tmp_path, text)
    assert 'mine/C' in message


BOMB = '\n'.join(
    ['a0: &a0 [x, x]'] + [f'a{k}: &a{k} [*a{k - 1}, *a{k - 1}, *a{k - 1}]' for k in range(1, 40)]
)


@pytest.mark.parametrize('text, what', [
    (b'effects: ' + b'x' * 10**7, '65536 bytes'),
    (b'\xff\xfe\x00', 'cannot read'),
    (b'', 'nothing in it'),
    (BOMB, 'anchors'),
    ('a: &a [*a]', 'anchors'),
    ('effects: !!python/object/apply:os.system [true]', 'tags'),
    ('effects: !!int 7', 'tags'),
    ('[' * 60000, 'levels'),
    ('{' * 60000, 'levels'),
    ('- ' * 30000, 'levels'),
    ('? ' * 30000, 'levels'),
    ('"\\UFFFFFFFF"', 'not valid YAML'),
    ('%YAML ' + '9' * 5000 + '.1\n--- a', 'not valid YAML'),
    ('a: [1', 'not valid YAML'),
    ('{[a]: b}', 'text as key'),
    ('a: 1\na: 2', 'twice'),
    ('effects: []\n---\neffects: []', 'one YAML document'),
    ('effects: 3', 'expected a list'),
    ('effects: [3]', 'expected a mapping'),
    ('other: []', 'unknown key'),
    ('effects: [{key: "x\\e[31m"}]', 'family/axis'),
    ('effects: [' + '{key: a},' * 51 + ']', '1 to 50'),
    (BEARING.replace('my-bearing/C', 'radial/C.9'), 'the library has a family radial'),
    (BEARING + BEARING.replace('effects:', ''), 'two effects'),
    (BEARING.replace('E_YC', 'E_XC'), 'two formulas'),
    (BEARING.replace('E_X(B)C', 'E_X(0B)C'), 'expected E_X(B)C'),
    (BEARING.replace('E_X(B)C', 'E_X(Y)C'), 'expected E_X(B)C'),
    (BEARING.replace('E_X(B)C', 'E_XA'), 'axis of X Y Z B C'),
    (BEARING.replace('E_X(B)C', 'E_QC'), 'letter of X Y Z A B C'),
    (BEARING.replace('bearing of the table', '"a\\nb"'), 'printable'),
    (BEARING.replace('bearing of the table', '"\\uD800"'), 'printable'),
    (BEARING.replace('unit: um', 'unit: inch'), 'unit: expected one of 1, nm'),
    (BEARING.replace('q: {unit: um}', 'q: {}'), 'parameters: q: unit'),
    (BEARING.replace('q: {unit: um}', 'q: {unit: um}, r: {unit: um}'), 'r: in no formula'),
    (BEARING.replace('q: {unit: um}', 'C: {unit: um}'), "'C': expected a name"),
    (BEARING.replace('q: {unit: um}', 'd7: {unit: um}'), "'d7': expected a name"),
    (BEARING.replace('q: {unit: um}', '__q: {unit: um}'), "'__q': expected a name"),
    (one('p*a', ', shape: {a: {unit: s, grid: [1]}}'), '2 to 40'),
    (one('p*a', ', shape: {a: {unit: s, grid: [1, .nan]}}'), '2 to 40'),
    (one('p*a', ', shape: {a: {unit: s, grid: [1, inf]}}'), '2 to 40'),
    (one('p*a', ', shape: {a: {unit: s, grid: [1, [2]]}}'), '2 to 40'),
    (one('p*a', f', shape: {{a: {{unit: s, grid: {list(range(41))}}}}}'), '2 to 40'),
    (one('p*a', ', shape: {' + ','.join(
        f'{n}: {{unit: s, grid: [1, 2]}}' for n in 'abc') + '}'), '2 at most'),
    (one('p*a*b', ', shape: {' + ','.join(
        f'{n}: {{unit: s, grid: {list(range(1, 41))}}}' for n in 'ab') + '}'), 'shorter grids'),
    ('effects: [{key: m, parameters: {p: {unit: um}}}]', 'motions or table'),
    ('effects: [{key: m, table: {X: [p]}, parameters: {p: {unit: um}}}]', 'expected a formula'),
    ('effects: [{key: m, table: {A: p}, parameters: {p: {unit: um}}}]', 'unknown key'),
    ('effects: [{key: m, table: {X: p}}]', 'at least one'),
], ids=lambda value: str(value)[:20])
def test_hostile_and_wrong_files_are_refused_in_one_line(tmp_path, text, what):
    assert what in refused(tmp_path, text)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(UserError, match=r'none\.yaml: cannot read'):
        load_effects(tmp_path / 'none.yaml', MACHINE)


@pytest.mark.parametrize('formula', [
    'p/C', 'p*log(B)', 'p*sqrt(B)', 'p*exp(1e6)', 'p*exp(40 + 0*C)', 'p*(1e9*t)**8', 'p/(t-t)',
])
def test_what_is_not_finite_on_the_scene_names_effect_and_formula(tmp_path, rows, formula):
    (effect,) = load(tmp_path, one(formula))
    with pytest.raises(UserError) as caught:
        effect.columns(rows.scene, ())
    assert f"mine/C: E_XC = '{formula}': the factor of p is" in str(caught.value)
    assert '\n' not in str(caught.value)


def test_gauges_that_are_not_there(tmp_path, rows):
    (effect,) = load(tmp_path, one('p*d4'))
    with pytest.raises(UserError, match='d4: the nest of this session has 3 gauges'):
        effect.columns(rows.scene, ())
    without = make_rows(rows.scene.observations, 0, {})
    with pytest.raises(UserError, match='not calibrated'):
        effect.columns(without.scene, ())


def test_no_family_of_the_library_is_free(rows):
    families = {effect.key.split('/')[0] for effect in library(rows.scene)}
    assert families <= RESERVED


def test_confusions_find_a_twin_and_what_the_base_model_swallows(tmp_path, rows):
    known = library(rows.scene)
    (twin,) = load(tmp_path, one('p*cos(2*C)'))
    alike = dict(confusions(twin, rows, known))
    assert alike['radial/C.2'] == pytest.approx(1.0, abs=1e-9)
    assert 'scale/X' not in alike
    (own,) = load(tmp_path, one('p*cos(8*C)*sin(3*B)'))
    assert confusions(own, rows, known) == []
    # A shift of the table's axis that does not change is what the location errors are.
    (constant,) = load(tmp_path, one('p*(1 + 0*C)'))
    ((key, cosine),) = confusions(constant, rows, known)
    assert key == 'invisible' and cosine > 0.9998


def test_what_the_data_cannot_show_and_what_the_model_has_is_said_in_words(tmp_path, rows):
    scene = rows.scene
    known = library(scene)
    (constant,) = load(tmp_path, one('p*(1 + 0*C)'))
    assert described(constant, rows, known).startswith('these data cannot show mine/C: ')
    (own,) = load(tmp_path, one('p*cos(8*C)*sin(3*B)'))
    assert described(own, rows, known) is None
    (twin,) = load(tmp_path, one('p*cos(2*C)'))
    assert described(twin, rows, known).startswith('mine/C looks like radial/C.2 (1.000)')
    (radial,) = [effect for effect in known if effect.key == 'radial/C.2']
    modelled = make_rows(scene.observations, 0, dict.fromkeys(SETUPS, NEST), [(radial, ())])
    assert described(twin, modelled, known).startswith('mine/C is already in the model')
    assert described(constant, modelled, known).startswith('these data cannot show mine/C: ')


def test_an_effect_written_again_is_the_same_effect(tmp_path, rows):
    text = (
        'effects: [{key: my-scale/X, motions: {E_XX: p*X}, parameters: {p: {unit: um/m}}}, '
        '{key: bow/X, motions: {E_YX: p*X**2}, parameters: {p: {unit: 1/m}}}]'
    )
    scale, bow = load(tmp_path, text)
    assert separate(rows, scale, ['scale/X'], [scale]) == 'scale/X: the same effect'
    # What the chain makes alike stays two effects.
    told = separate(rows, bow, ['straightness/YX', 'angle/CX'], [bow])
    assert 'straightness/YX: the same effect' in told
    assert 'angle/CX: no further R-test pose; measure one of the two directly' in told


def session(errors_at, seed):
    rng = np.random.default_rng(seed)
    made = [noisy(static_cycle(setup, errors_at), NOISE, rng) for setup in SETUPS]
    return stack(MACHINE, made)


def test_an_effect_of_the_user_is_named_and_used_like_a_built_in_one(tmp_path):
    p, q = 0.8e-6, -0.4e-6

    def errors_at(b, c):
        return {
            'B': {'X': 20e-6, 'A': 4e-5},
            'C': {
                'X': 15e-6 + p * np.cos(4 * c) + q * np.sin(4 * c),
                'Y': -p * np.sin(4 * c) + q * np.cos(4 * c),
            },
        }

    (effect,) = load(tmp_path, BEARING)
    observations = session(errors_at, 11)
    result = analyse(observations, 0, dict.fromkeys(SETUPS, NEST), more=[effect])
    assert result.verdict == 'explained'
    (found,) = result.found
    assert found.effect.key == 'my-bearing/C' and found.confidence > 0.9
    assert np.all(np.abs(found.value - [p, q]) < 4 * found.stddev)
    assert np.all(found.stddev < 0.05e-6)
    assert result.gap.heldout_after < 1.1 * NOISE < result.gap.heldout_before
    # Its entry in a model file works as any other's.
    values = {n: Value(float(v), None, 'm') for n, v in zip('pq', found.value, strict=True)}
    model = Model('m', 'NMV', effects=(ModelEffect(found.effect.key, values),))
    save_model(model, tmp_path / 'model.yaml')
    model = load_model(tmp_path / 'model.yaml')
    again = analyse(observations, 0, dict.fromkeys(SETUPS, NEST), model, more=[effect])
    assert again.verdict == 'no gap' and again.found == ()


def test_an_effect_with_a_shape_outside_the_library_is_named_and_refined(tmp_path):
    text = one('p*sin(3*B)*cos(m*C)', ', shape: {m: {unit: 1, grid: [1.2, 1.4, 1.6, 1.8]}}')
    (effect,) = load(tmp_path, text)

    def errors_at(b, c):
        return {'C': {'X': 1.2e-6 * np.sin(3 * b) * np.cos(1.57 * c)}}

    observations = session(errors_at, 12)
    result = analyse(observations, 0, {}, more=[effect])
    (found,) = result.found
    assert found.effect.key == 'mine/C' and result.verdict == 'explained'
    assert found.value == pytest.approx([1.2e-6, 1.57], rel=0.05)
    assert np.all(np.abs(found.value - [1.2e-6, 1.57]) < 4 * found.stddev)
    # Nothing in the library closes this gap.
    assert analyse(observations, 0, {}).verdict == 'unknown effect'


def test_an_effect_with_two_shapes_is_named_at_its_grid(tmp_path):
    shape = ', shape: {m: {unit: 1, grid: [2.5, 3.5]}, L: {unit: mm, grid: [20, 30]}}'
    (effect,) = load(tmp_path, one('p*cos(m*C)*sin(X/L)', shape))

    # The sphere of 2a is on the axis of C, so that X follows B alone.
    height = SETUPS['2a'][2]

    def errors_at(b, c):
        return {'C': {'X': 1e-6 * np.cos(3.5 * c) * np.sin(height * np.sin(b) / 0.03)}}

    cycle = static_cycle('2a', errors_at, c=np.radians(29 * np.arange(12)))
    observations = stack(MACHINE, [noisy(cycle, NOISE, np.random.default_rng(13))])
    result = analyse(observations, 0, {}, more=[effect])
    (found,) = result.found
    assert (found.effect.key, found.shape) == ('mine/C', pytest.approx((3.5, 0.03)))
    assert abs(found.value[0] - 1e-6) < 4 * found.stddev[0]
