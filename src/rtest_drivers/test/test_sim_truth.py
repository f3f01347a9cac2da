"""Error functions, and truth files with mistakes in them."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from rtest_drivers.sim.errors import GeometricErrors, parse_errors, split
from rtest_drivers.sim.fields import Fields
from rtest_drivers.sim.kinematics import follow, sphere_in_table
from rtest_drivers.sim.truth import load_truth, main
from rtest_estimation.errors import UserError
from rtest_identification.machine import load_machine

CONFIG = Path(__file__).parents[1] / 'config'
MACHINE = load_machine(CONFIG / 'nmv1500dcg.yaml')


def errors(text: str):
    return parse_errors(Fields(yaml.safe_load(text), 'truth.yaml'), MACHINE)


def at(**degrees: float) -> dict[str, np.ndarray]:
    return {name: np.radians([degrees.get(name, 0.0)]) for name in MACHINE.letters}


def test_terms_add_up() -> None:
    given = errors("""
location_errors_um: {E_X(0B)C: 4.0}
location_errors_arcsec: {E_A(0B)C: 1.0}
position_dependent:
  E_X(B)C:
    - {constant_um: 0.5}
    - {harmonic: 2, cos_um: 1.0, sin_um: 2.0}
    - {harmonic: 1, sin_um: 3.0, times: {abs: B}}
    - {constant_um: 5.0, times: {sin: 1, of: B}}
    - {power: 2, of: B, at_90deg_um: 8.0}
""")
    # B = -45, C = 30: cos 60 = 0.5, sin 60 = 0.866, sin 30 * 45/90, sin -45, (45/90)^2
    expected = 4.0 + 0.5 + 0.5 + 2 * 0.75**0.5 + 3 * 0.25 - 5 * 0.5**0.5 + 2.0
    values = given.of_axis('C', at(B=-45, C=30))
    assert values[0, 3] == pytest.approx(expected * 1e-6, rel=1e-12)
    assert values[0, 0] == pytest.approx(4.84813681e-6, rel=1e-8)
    assert given.of_axis('B', at(B=-45, C=30)) == pytest.approx(np.zeros((1, 6)))
    alone = given.dependent('E_X(B)C', {'B': np.radians(-45.0), 'C': np.radians(30.0)})
    assert alone == pytest.approx((expected - 4.0) * 1e-6, rel=1e-12)


def test_linear_axes_have_powers_of_their_position() -> None:
    given = errors('position_dependent: {E_YX: [{power: 2, at_100mm_um: 3.0}]}')
    positions = {name: np.array([0.0]) for name in MACHINE.letters} | {'X': np.array([-0.2])}
    assert given.of_axis('X', positions)[0, 4] == pytest.approx(12e-6)


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        ('location_errors_um: {E_X(0Y)Q: 1}', 'E_X(0Y)Q: no axis Q'),
        ('location_errors_um: {E_X(0Q)B: 1}', 'E_X(0Q)B: no axis Q'),
        ('location_errors_um: {EXB: 1}', 'expected a symbol such as'),
        ('location_errors_um: {E_A(0Y)B: 1}', 'expected in urad or arcsec'),
        ('location_errors_um: {E_X(Y)B: 1}', 'expected a constant of a rotary axis'),
        ('squareness_urad: {E_A(0Y)B: 1}', 'expected a constant of a linear axis'),
        ('location_errors_um: {E_X(0Y)B: 1, E_X(0Z)B: 1}', 'given already as E_X(0Y)B'),
        ('location_errors_um: {E_X(0Y)B: much}', "E_X(0Y)B: expected a number, got 'much'"),
        ('position_dependent: {E_X(0Y)B: []}', 'a location error'),
        ('position_dependent: {E_X(Y)B: [{harmonic: 0, cos_um: 1}]}', 'from 1 up'),
        ('position_dependent: {E_X(Y)B: [{harmonic: 2, cos_urad: 1}]}', "unknown key 'cos_urad'"),
        ('position_dependent: {E_A(Y)B: [{constant_um: 1}]}', 'constant_urad or constant_arcsec'),
        ('position_dependent: {E_X(Y)B: [{power: 1, at_100mm_um: 1}]}', 'expected at_90deg_um'),
        ('position_dependent: {E_XX: [{harmonic: 1, cos_um: 1}]}', 'does not turn'),
        ('position_dependent: {E_X(Y)B: {constant_um: 1}}', 'expected a list'),
    ],
)
def test_mistakes_are_named(text: str, expected: str) -> None:
    with pytest.raises(UserError) as caught:
        errors(text)
    assert expected in str(caught.value)
    assert str(caught.value).startswith('truth.yaml: ')


@pytest.mark.parametrize(
    ('change', 'expected'),
    [
        ({'sead': 1}, "unknown key 'sead'"),
        ({'runout_um': [1]}, 'runout_um: expected 2 numbers'),
        ({'seed': 1.5}, 'seed: expected a whole number'),
        ({'machine': 'none.yaml'}, 'none.yaml'),
        ({'faults': [{'kind': 'gauge_asleep'}]}, "faults[0]: kind: expected one of ['feedback_s"),
        ({'faults': [{'kind': 'pose_skipped', 'cycle': 'a'}]}, 'needs cycle and pose'),
        ({'faults': [{'kind': 'gauge_nan', 'at_s': 1.0}]}, 'for_s: missing'),
        ({'encoders': {'rate_hz': 0}}, 'encoders: rate_hz: expected at least 0.1'),
    ],
)
def test_mistakes_in_the_file_are_named(tmp_path: Path, change: dict, expected: str) -> None:
    data = yaml.safe_load((CONFIG / 'cell_demo.yaml').read_text())
    data['machine'] = str(CONFIG / 'nmv1500dcg.yaml')
    path = tmp_path / 'truth.yaml'
    path.write_text(yaml.safe_dump(data | change))
    with pytest.raises(UserError) as caught:
        load_truth(path)
    assert expected in str(caught.value)


def test_the_demo_has_every_error() -> None:
    truth = load_truth(CONFIG / 'cell_demo.yaml')
    given = truth.errors
    locations = {f'E_{component}(0Y)B' for component in 'XYZABC'} | {'E_X(0B)C', 'E_A(0B)C'}
    assert set(given.constants) == locations | {'E_A(0Y)Z', 'E_B(0X)Z', 'E_C(0Y)X'}
    stations = np.radians(np.arange(-75.0, 76.0, 25.0))
    turn = np.radians(np.arange(0.0, 360.0, 30.0))
    for component in 'XYZABC':
        size = 0.2e-6 if component in 'XYZ' else 1e-6
        values = given.dependent(f'E_{component}(Y)B', {'B': stations})
        assert np.abs(values).max() > size
        # The constant is the location error.
        assert abs(values.mean()) < 1e-9
        values = given.dependent(f'E_{component}(B)C', {'B': stations[:, None], 'C': turn})
        assert values.shape == (7, 12)
        assert np.abs(values).max() > size


def test_the_demo_map_does_not_move_the_location_errors() -> None:
    """Plain least squares on the four-setup cycle finds the constants, whatever the maps do."""
    truth = load_truth(CONFIG / 'cell_demo.yaml')
    angles = [(b, c) for b in np.arange(-75, 76, 25) for c in np.arange(0, 360, 30)]
    angles = np.radians([(0, 0), *angles, (0, 0)])
    setups = np.array([[0, -90, 40.6], [0, -90, 140.6], [0, 0, 40.6], [0, 0, 140.6]]) * 1e-3
    rows = np.column_stack([np.zeros((len(angles), 3)), angles])
    poses = [follow(truth.machine, rows, sphere) for sphere in setups]

    def measured(given: GeometricErrors) -> np.ndarray:
        return np.stack([sphere_in_table(truth.machine, pose, given) for pose in poses])

    nominal = measured(GeometricErrors({}, {}))
    columns = [
        (measured(GeometricErrors({symbol: 1e-6}, {})) - nominal).ravel() / 1e-6
        for symbol in truth.errors.constants
    ]
    for cycle in range(4):
        for direction in range(3):
            offset = np.zeros_like(nominal)
            offset[cycle, :, direction] = 1.0
            columns.append(offset.ravel())
    data = (measured(truth.errors) - nominal).ravel()
    found = np.linalg.lstsq(np.array(columns).T, data, rcond=None)[0]
    for value, (symbol, expected) in zip(found, truth.errors.constants.items(), strict=False):
        # A fifth of what noise of 0.25 um leaves: 0.03 um, 0.3 urad.
        slack = 0.006e-6 if split(symbol).component in 'XYZ' else 0.06e-6
        assert value == pytest.approx(expected, abs=slack), symbol


def test_a_truth_file_is_checked_with_the_cycles_of_a_session(tmp_path, capsys) -> None:
    data = yaml.safe_load((CONFIG / 'cell_demo.yaml').read_text())
    data['machine'] = str(CONFIG / 'nmv1500dcg.yaml')
    data['faults'] = [
        {'kind': 'gauge_silent', 'at_s': 1.0, 'for_s': 1.0},
        {'kind': 'gauge_nan', 'cycle': '1a-static', 'pose': 85},
        {'kind': 'gauge_error', 'cycle': '1a-static', 'pose': 86},
        {'kind': 'lost_block', 'cycle': '1c-static'},
    ]
    path = tmp_path / 'truth.yaml'
    path.write_text(yaml.safe_dump(data))
    assert main([str(path), '1a-nest=28', '1a-static=86']) == 0
    first, second = capsys.readouterr().out.splitlines()
    assert 'gauge_error: no pose 86 in 1a-static, which has 86 poses' in first
    assert "lost_block: no cycle '1c-static' in this session, which has 1a-nest, 1a" in second
    assert main([str(path)]) == 0 and not capsys.readouterr().out
    path.write_text('machine: [\n')
    assert main([str(path)]) == 2
    assert capsys.readouterr().err.count('\n') == 1
