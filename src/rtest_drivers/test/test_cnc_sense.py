"""Which axis has the wrong sign, unit or name."""

import math
from dataclasses import replace

import numpy as np
import pytest

from rtest_drivers.cnc.axes import AxisSource
from rtest_drivers.cnc.sense import Move, judge

TRUE = {
    'X': AxisSource('X', 0, 'mm'), 'Y': AxisSource('Y', 1, 'mm', -1),
    'Z': AxisSource('Z', 2, 'mm'), 'B': AxisSource('B', 3, 'deg'),
    'C': AxisSource('C', 4, 'deg', -1),
}
MOVES = [Move('X', 1e-3), Move('Y', 1e-3), Move('Z', -1e-3), Move('B', math.radians(1.0)),
         Move('C', math.radians(1.0))]


def record(axes: list[AxisSource], moves: list[Move], noise: float = 1e-8) -> list[np.ndarray]:
    """Feedback of a machine whose controller is as in TRUE, read as `axes` says."""
    rng = np.random.default_rng(3)
    recorded = []
    for move in moves:
        raw = np.zeros((200, 5))
        source = TRUE[move.axis]
        raw[:, source.source] = (
            np.clip(np.linspace(-0.5, 1.5, 200), 0.0, 1.0) * move.distance / source.scale
        )
        rows = np.column_stack([raw[:, axis.source] * axis.scale for axis in axes])
        recorded.append(rows + noise * rng.standard_normal(rows.shape))
    return recorded


def findings(axes: dict[str, AxisSource], moves: list[Move] = MOVES) -> dict:
    found = judge(list(axes.values()), moves, record(list(axes.values()), moves))
    return {one.axis: one for one in found}


def test_all_right() -> None:
    assert {one.kind for one in findings(TRUE).values()} == {'right'}
    assert findings(TRUE)['Y'].ratio == pytest.approx(1.0, abs=1e-3)


def test_sign() -> None:
    found = findings({**TRUE, 'Y': AxisSource('Y', 1, 'mm')})
    assert [one.kind for one in found.values()] == ['right', 'sign', 'right', 'right', 'right']
    assert found['Y'].text == 'Y +1 mm: axes: Y: sign: -1 instead of 1'


@pytest.mark.parametrize(
    ('axis', 'unit', 'factor'),
    [('X', 'm', 1000.0), ('X', 'um', 1e-3), ('Z', 'inch', 25.4), ('B', 'rad', 57.29578),
     ('C', 'rad', 57.29578)],
)
def test_unit(axis: str, unit: str, factor: float) -> None:
    found = findings({**TRUE, axis: replace(TRUE[axis], unit=unit)})
    assert found[axis].kind == 'unit'
    assert found[axis].ratio == pytest.approx(factor, rel=1e-2)
    right = TRUE[axis].unit
    assert f'unit: {right} instead of {unit}' in found[axis].text
    assert sum(one.kind == 'right' for one in found.values()) == 4


def test_sign_and_unit_together() -> None:
    found = findings({**TRUE, 'B': AxisSource('B', 3, 'rad', -1)})['B']
    assert found.text.endswith('axes: B: sign: 1 instead of -1, unit: deg instead of rad')


def test_names_exchanged() -> None:
    found = findings({**TRUE, 'X': AxisSource('X', 2, 'mm'), 'Z': AxisSource('Z', 0, 'mm')})
    assert (found['X'].kind, found['X'].moved) == ('name', ('Z',))
    # The axis called Z has joint 0, which is X.
    assert found['X'].text == 'X +1 mm: what moved is called Z; give X the source 0'
    assert found['Z'].text.endswith('give Z the source 2')


def test_nothing_several_and_no_unit() -> None:
    moves = [Move('X', 1e-3), Move('B', math.radians(1.0)), Move('Z', 1e-3)]
    axes = list(TRUE.values())
    still, several, scale = record(axes, moves)
    still[:, 0] = 0.0
    several[:, 0] += several[:, 3] * 0.06  # TCP mode with the sphere 60 mm away.
    scale[:, 2] *= 1.7
    found = judge(axes, moves, [still, several, scale])
    assert [one.kind for one in found] == ['still', 'several', 'scale']
    assert found[1].moved == ('X', 'B') and 'TCP mode' in found[1].text
    assert found[2].ratio == pytest.approx(1.7, rel=1e-3)


def test_noise_of_the_encoders_is_no_motion() -> None:
    axes = list(TRUE.values())
    found = judge(axes, MOVES, record(axes, MOVES, noise=3e-6))
    assert {one.kind for one in found} == {'right'}
