"""Separation of squareness (3.5) against a machine of plain matrices."""

from dataclasses import replace

import numpy as np
import pytest
from independent import NMV, SETUPS, B, C, noisy, static_cycle, turn

from rtest_identification.machine import parse_machine
from rtest_identification.pipeline import identify
from rtest_identification.presentation import present
from rtest_identification.squareness import separate, strain

MACHINE = parse_machine(NMV)
SYMBOLS = ('E_A(0Y)Z', 'E_B(0X)Z', 'E_C(0Y)X')
EACH = {'E_A(0Y)Z': 17e-6, 'E_B(0X)Z': -8e-6, 'E_C(0Y)X': 14e-6}
# What a table does besides; none of it may get into the squareness.
TABLE = {
    'B': {'X': -7.8e-6, 'Y': 12.1e-6, 'Z': -38e-6, 'A': 1.8e-5, 'B': 4.1e-5, 'C': 0.8e-5},
    'C': {'X': 5e-6, 'A': -1.5e-5},
}
NOISE = 2.5e-7


def linear(values):
    errors = {}
    for symbol, value in values.items():
        errors.setdefault(symbol[-1], {})[symbol[2]] = value
    return errors


def found(errors_at, setups=tuple(SETUPS), noise=0.0, seed=0, b=B, c=C, drop=()):
    """Separation of a simulated session; errors_at(b, c, x) with the position of X."""
    rng = np.random.default_rng(seed)
    cycles = []
    for setup in setups:
        sphere = [*SETUPS[setup], 1.0]

        def at(level, station, sphere=sphere):
            x = (turn('B', level) @ turn('C', station) @ sphere)[0]
            return errors_at(level, station, x)

        cycle = static_cycle(setup, at, b, c)
        points = tuple(p for p in cycle.points if p.index not in drop)
        cycle = replace(cycle, points=points)
        cycles.append(noisy(cycle, noise, rng) if noise else cycle)
    result = identify(MACHINE, cycles)
    return separate(result, present(result)), result


@pytest.mark.parametrize('symbols', [*((s,) for s in SYMBOLS), SYMBOLS], ids='-'.join)
def test_every_squareness_error_comes_out_with_its_sign(symbols):
    values = {s: EACH[s] for s in symbols}
    separation, _ = found(lambda b, c, x: {**TABLE, **linear(values)})
    expected = [values.get(s, 0.0) for s in SYMBOLS]
    assert separation.symbols == SYMBOLS and separation.determined.all()
    # Second order: 1e-5 of 4e-5 times other errors; the ellipse does not shift even stations.
    np.testing.assert_allclose(separation.value, expected, atol=5e-9)
    np.testing.assert_allclose(separation.joint, expected, atol=5e-9)


def test_equations_3_9_and_3_10_with_the_signs_found():
    """beta = beta_ZX cos 2B as printed; alpha = a cos B - g sin B, the opposite of Eq. 3-10."""
    separation, _ = found(lambda b, c, x: {**TABLE, **linear(EACH)})
    a, b, g = (EACH[s] for s in SYMBOLS)
    for difference in separation.differences:
        alpha, beta = difference.value.T
        np.testing.assert_allclose(beta, b * np.cos(2 * B), atol=2e-8)
        np.testing.assert_allclose(alpha, a * np.cos(B) - g * np.sin(B), atol=2e-8)


@pytest.mark.parametrize('number', range(3))
def test_the_strain_of_a_squareness_error_is_that_of_its_motion(number):
    """A tilt of Z about X sends the sphere to -Y, about Y to +X; X about Z sends it to +Y."""
    parameters = found(lambda b, c, x: {})[1].location.parameters
    parameter = next(p for p in parameters if p.symbol == SYMBOLS[number])
    expected = np.zeros((3, 3))
    expected[[(1, 2), (0, 2), (1, 0)][number]] = [-1.0, 1.0, 1.0][number]
    np.testing.assert_allclose(strain(MACHINE, parameter.column), expected, atol=1e-12)


def test_a_map_of_b_does_not_get_into_it():
    """What the rotary axes do tilts circle and line alike."""

    def errors(b, c, x):
        wave = {'A': 3e-5 * np.sin(2 * b), 'B': 2e-5 * b**2, 'C': 3e-5 * b, 'X': 1e-6 * np.cos(b)}
        return {'B': {k: TABLE['B'].get(k, 0) + wave.get(k, 0) for k in 'XYZABC'},
                'C': TABLE['C'], **linear(EACH)}

    separation, _ = found(errors)
    np.testing.assert_allclose(separation.value, list(EACH.values()), atol=2e-8)


@pytest.mark.parametrize(
    ('setups', 'note'),
    [
        (('1a', '2a', '2b'), ''),
        (('1a', '1b'), 'stand in'),
        (('1a', '2b'), 'stand in'),
        (('1a', '2a'), 'different heights'),
        (('1a',), 'different heights'),
    ],
)
def test_any_subset_of_the_setups(setups, note):
    separation, _ = found(lambda b, c, x: {**TABLE, **linear(EACH)}, setups)
    assert any(note in text for text in separation.lines.notes) is bool(note)
    if note == 'different heights':
        assert separation.lines.along is None and not separation.determined.any()
        assert np.isfinite(separation.lines.across[0].value).all()
    else:
        np.testing.assert_allclose(separation.value, list(EACH.values()), atol=5e-9)


def test_no_circle_no_separation():
    separation, _ = found(lambda b, c, x: {**TABLE}, ('2a', '2b'))
    assert separation is None


def test_missing_poses_shift_nothing():
    separation, _ = found(
        lambda b, c, x: {**TABLE, **linear({'E_B(0X)Z': -8e-6})}, drop=(3, 4, 5, 17, 40, 41)
    )
    # Half an ellipse shifts the centre a little; no centre of an outer circle is used here.
    np.testing.assert_allclose(separation.value, [0.0, -8e-6, 0.0], atol=1e-8)
    bare, _ = found(
        lambda b, c, x: {**TABLE, **linear({'E_B(0X)Z': -8e-6})}, drop=tuple(range(1, 11))
    )
    assert np.isnan(bare.lines.across[0].value[0]).all()
    assert any('B = -75' in note and '2 points' in note for note in bare.lines.notes)
    np.testing.assert_allclose(bare.value, [0.0, -8e-6, 0.0], atol=1e-8)


def test_stated_uncertainty_holds_and_false_alarms_are_rare():
    """200 sessions; noise is put on the positions, which the fit of the offsets only shifts."""
    _, result = found(lambda b, c, x: {**TABLE, **linear(EACH)})
    view = present(result)
    rng = np.random.default_rng(41)
    z, alarms = [], 0
    for _ in range(200):
        noise = NOISE * rng.normal(size=view.measured.shape)
        separation = separate(result, replace(view, measured=view.measured + noise))
        z.append((separation.value - list(EACH.values())) / separation.stddev)
        alarms += bool(separation.failures)
    assert alarms <= 6
    z = np.array(z)
    assert 0.9 < z.std() < 1.1 and np.abs(z.mean(axis=0)).max() < 4 / np.sqrt(200)
    assert 0.92 < np.mean(np.abs(z) < 1.96) < 0.98


def test_an_alarm_follows_the_chance_it_states():
    _, result = found(lambda b, c, x: linear(EACH), ('1a', '2a', '2b'))
    view = present(result)
    rng = np.random.default_rng(42)
    p = []
    for _ in range(200):
        noise = NOISE * rng.normal(size=view.measured.shape)
        separation = separate(result, replace(view, measured=view.measured + noise))
        p += [a.probability for a in separation.agreements]
    # Uniform if the statistic is the F it is taken for (Kolmogorov-Smirnov at 1 %: 1.63/sqrt n).
    p = np.sort(p)
    assert np.abs(p - np.linspace(0, 1, len(p))).max() < 1.63 / np.sqrt(len(p))


def test_pitch_of_x_is_detected_and_named():
    """E_B of X grows with x: the thesis's own finding (3.7.2)."""

    def errors(b, c, x):
        return {**TABLE, **linear(EACH), 'X': {'C': EACH['E_C(0Y)X'], 'B': 3e-4 * x}}

    for seed in range(5):
        separation, _ = found(errors, noise=NOISE, seed=seed)
        failures = separation.failures
        assert len(failures) == 1
        assert failures[0].startswith('beta_ZX does not follow cos 2B')
        assert 'Z-X squareness is not one number, e.g. pitch of X' in failures[0]


def test_without_pitch_the_same_sessions_raise_no_alarm():
    for seed in range(5):
        separation, _ = found(
            lambda b, c, x: {**TABLE, **linear(EACH)}, noise=NOISE, seed=seed
        )
        assert not separation.failures
        z = (separation.value - separation.joint) / separation.stddev
        assert np.abs(z).max() < 4
