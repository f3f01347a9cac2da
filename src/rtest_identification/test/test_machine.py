"""Machine files: what they mean, and one clear line for every mistake."""

import pytest
from independent import NMV

from rtest_estimation.errors import UserError
from rtest_identification.machine import load_machine, parse_machine
from rtest_identification.symbols import location_parameters, map_parameters


def test_sides_go_from_the_bed_outwards():
    machine = parse_machine(NMV)
    assert machine.table_side == ('B', 'C')
    assert machine.tool_side == ('Y', 'X', 'Z')
    assert machine.letters == ('X', 'Y', 'Z', 'B', 'C')
    assert machine.axes['B'].upper == pytest.approx(2.792526803)


def test_location_errors_are_those_of_table_2_3():
    assert [p.symbol for p in location_parameters(parse_machine(NMV))] == [
        'E_X(0Y)B', 'E_Y(0Y)B', 'E_Z(0Y)B', 'E_A(0Y)B', 'E_B(0Y)B', 'E_C(0Y)B',
        'E_X(0B)C', 'E_A(0B)C', 'E_A(0Y)Z', 'E_B(0X)Z', 'E_C(0Y)X',
    ]


def test_position_dependent_errors_are_those_of_table_2_4():
    machine = parse_machine(NMV)
    assert [p.symbol for p in map_parameters(machine, 'B')] == [
        'E_X(Y)B', 'E_Y(Y)B', 'E_Z(Y)B', 'E_A(Y)B', 'E_B(Y)B', 'E_C(Y)B',
    ]
    assert map_parameters(machine, 'C')[4].symbol == 'E_B(B)C'


@pytest.mark.parametrize(
    ('old', 'new', 'words'),
    [
        ('chain: [C, B, bed, Y, X, Z]', 'chain: [C, B, Y, X, Z]', "chain: expected 'bed'"),
        ('chain: [C, B, bed, Y, X, Z]', 'chain: [C, C, bed, Y, X, Z]', 'chain'),
        ('type: rotary', 'type: rotatory', 'B: type'),
        ('type: linear', 'type: [linear]', 'X: type'),
        ('type: linear', 'type: {}', 'X: type'),
        ('direction: [1, 0, 0]', 'direction: [.inf, 0, 0]', 'X: direction'),
        ('name: NMV', 'tool_mm: [.inf, 0, 0]', 'tool_mm: expected three numbers'),
        ('sense: 1', 'sense: 2', 'B: sense: expected 1 or -1'),
        ('range_deg: [-180, 160]', 'range_deg: [160, -180]', 'B: range_deg'),
        ('range_mm: [-210, 210]', 'range_deg: [-210, 210]', "X: unknown key 'range_deg'"),
        ('direction: [1, 0, 0]', 'direction: [1, 1, 0]', 'X: direction: expected a unit vector'),
        ('direction: [1, 0, 0]', 'direction: [0, 1, 0]', 'span'),
        ('direction: [1, 0, 0]', 'direction: x', 'X: direction: expected three numbers'),
        ('name: NMV', 'nmae: NMV', "unknown key 'nmae'"),
        ('name: NMV', 'name: [', 'not valid YAML'),
    ],
)
def test_mistakes_name_file_key_and_what_is_expected(old, new, words):
    with pytest.raises(UserError, match='file.yaml') as caught:
        parse_machine(NMV.replace(old, new, 1), 'file.yaml')
    assert words in str(caught.value)
    assert '\n' not in str(caught.value)


def test_a_tag_in_the_yaml_runs_nothing():
    with pytest.raises(UserError):
        parse_machine('!!python/object/apply:os.system ["true"]', 'file.yaml')


def test_a_missing_file_is_a_user_error(tmp_path):
    with pytest.raises(UserError, match=r'none\.yaml'):
        load_machine(tmp_path / 'none.yaml')
