"""The simulated cell warms up: against an integrated equation, in readings and temperatures."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.integrate import solve_ivp

from rtest_drivers.sim.cell import Cell
from rtest_drivers.sim.truth import Truth, load_truth
from rtest_drivers.sim.warming import Lagging, Warming
from rtest_estimation.errors import UserError
from rtest_estimation.records import CyclePlan, Kind
from rtest_identification.session_file import load_session

CONFIG = Path(__file__).parents[1] / 'config'
TRUTH = load_truth(CONFIG / 'cell_thermal.yaml')
PLANS = load_session(CONFIG / 'thermal.yaml').plans
EPOCH = 1_700_000_000_000_000_000
MINUTE = 60_000_000_000


def quiet(**changes: object) -> Truth:
    """Without any noise or mounting error, and with no run-out."""
    gauges = dataclasses.replace(
        TRUTH.gauges, noise=0.0, dwell_noise=0.0, direction_error=0.0, position_error=0.0
    )
    encoders = dataclasses.replace(TRUTH.encoders, linear_noise=0.0, rotary_noise=0.0)
    drives = dataclasses.replace(TRUTH.drives, settle=0.0)
    return dataclasses.replace(
        TRUTH, gauges=gauges, encoders=encoders, drives=drives, runout=np.zeros(2), **changes
    )


def cycle(number: int, minute: float) -> CyclePlan:
    plan = next(p for p in PLANS if p.cycle == f'low-thermal-{number:02d}')
    return dataclasses.replace(plan, session='s', stamp=EPOCH + round(minute * MINUTE))


def run(truth: Truth, plans: list[CyclePlan], step: float, until: float) -> tuple:
    """Blocks, feedback and temperatures up to a minute, in steps [min]."""
    cell = Cell(truth, EPOCH)
    for plan in plans:
        cell.queue(plan)
    blocks, feedback, temperatures = [], [], []
    while cell.now < EPOCH + round(until * MINUTE):
        output = cell.advance(cell.now + round(step * MINUTE))
        blocks += output.blocks
        feedback += output.feedback
        temperatures += output.temperatures
    return blocks, feedback, temperatures


def test_what_follows_the_heat_is_the_solution_of_the_equation() -> None:
    heat = ((0.0, 1.0), (600.0, 0.3), (900.0, 0.0))
    one = Lagging(rise=-6e-6, lag=400.0, rest=1e-6)
    warming = Warming(heat, {}, {}, 1, 0.0)
    times = np.linspace(-200.0, 2000.0, 60)

    def share(t: float) -> float:
        return 0.0 if t < 0 else 1.0 if t < 600 else 0.3 if t < 900 else 0.0

    solved = solve_ivp(
        lambda t, x: (one.rise * share(t) - x) / one.lag, (-200.0, 2000.0), [0.0],
        t_eval=times, max_step=2.0, rtol=1e-9, atol=1e-14,
    )
    found = warming.value(one, times)
    np.testing.assert_allclose(found - 1e-6, solved.y[0], atol=1e-8)
    assert (found[times <= 0] == 1e-6).all()


def test_the_gauges_see_the_axis_of_the_table_move() -> None:
    blocks, _, _ = run(quiet(), [cycle(1, 1.0), cycle(2, 61.0)], 0.5, 62.0)
    stamps = np.concatenate([block.stamps for block in blocks])
    values = np.concatenate([block.displacement for block in blocks])
    # After each cycle the axes rest where it ended, at B = C = 0.
    minutes = (stamps - EPOCH) / MINUTE - 1.0
    first, second = ((minutes > start + 0.6) & (minutes < start + 0.9) for start in (0.0, 60.0))
    moved = values[second].mean(axis=0) - values[first].mean(axis=0)
    settled = 1.0 - np.exp(-minutes / 45.0)
    part = settled[second].mean() - settled[first].mean()
    # The table goes by this much, so that the sphere goes the other way in its frame.
    np.testing.assert_allclose(
        np.linalg.solve(TRUTH.gauges.directions, moved),
        -part * np.array([-2.037e-6, -6.112e-6, -2.037e-6]), atol=1e-9,
    )


def test_temperatures_begin_at_rest_and_rise_with_the_first_static_cycle() -> None:
    _, _, temperatures = run(TRUTH, [cycle(1, 10.0), cycle(2, 200.0)], 1.0, 200.0)
    found = {}
    for reading in temperatures:
        found.setdefault(reading.sensor, []).append((reading.stamp, reading.value))
    assert set(found) == {'ambient', 'B_cover', 'bridge', 'table', 'nest'}
    stamp, celsius = np.array(found['B_cover']).T
    assert np.unique(np.diff(stamp)).tolist() == [10e9]
    minutes = (stamp - EPOCH) / MINUTE - 10.0
    truth = 22.1 + np.where(minutes > 0, 1.416 * (1.0 - np.exp(-minutes / 40.0)), 0.0)
    assert np.std(celsius - truth) == pytest.approx(0.02, rel=0.1)
    assert abs(np.mean((celsius - truth)[minutes < 0])) < 3 * 0.02 / np.sqrt(60)
    assert truth[np.argmin(abs(minutes - 180.0))] - 22.1 == pytest.approx(1.4, abs=0.001)
    assert {reading.variance for reading in temperatures} == {0.02**2}


def test_little_is_read_in_a_long_wait_and_everything_near_a_cycle() -> None:
    plans = [cycle(1, 1.0), cycle(2, 16.0)]
    blocks, feedback, temperatures = run(TRUTH, plans, 0.25, 17.0)
    stamps = np.array([one.stamp for one in feedback])
    wait = (stamps > EPOCH + 3 * MINUTE) & (stamps < EPOCH + 15 * MINUTE)
    assert 60 <= wait.sum() <= 90
    near = (stamps > EPOCH + 16 * MINUTE - 4e9) & (stamps <= EPOCH + 17 * MINUTE)
    assert near.sum() == 64 * 25
    # Nothing is lost: the readings are counted as they are given.
    ends = np.cumsum([len(block.displacement) for block in blocks])
    assert [block.sequence for block in blocks] == [0, *ends[:-1].tolist()]
    # However time is chopped.
    again = run(TRUTH, plans, 17.0, 17.0)
    assert [one.stamp for one in again[1]] == stamps.tolist()
    np.testing.assert_array_equal([one.position for one in again[1]],
                                  [one.position for one in feedback])
    np.testing.assert_array_equal(np.concatenate([b.displacement for b in again[0]]),
                                  np.concatenate([b.displacement for b in blocks]))
    assert again[2] == temperatures


def test_a_cell_says_how_long_it_waits() -> None:
    cell = Cell(TRUTH, EPOCH)
    assert cell.waits_until is None
    cell.queue(cycle(1, 10.0))
    cell.advance(EPOCH + MINUTE)
    assert cell.waits_until == EPOCH + 10 * MINUTE - 5_000_000_000
    cell.advance(cell.waits_until)
    assert cell.waits_until is None
    usual = Cell(dataclasses.replace(TRUTH, thin=0), EPOCH)
    usual.queue(cycle(1, 10.0))
    usual.advance(EPOCH + MINUTE)
    assert usual.waits_until is None


def test_a_nest_calibration_does_not_start_the_heat() -> None:
    nest = dataclasses.replace(PLANS[0], stamp=EPOCH)
    assert nest.kind is Kind.NEST_CALIBRATION
    _, _, temperatures = run(quiet(warming=dataclasses.replace(TRUTH.warming, noise=0.0)),
                             [nest], 1.0, 3.0)
    assert {r.value for r in temperatures if r.sensor == 'B_cover'} == {22.1}


@pytest.mark.parametrize(
    ('changes', 'expected'),
    [
        ({'heat': [[5, 1.0], [0, 0.0]]}, 'warming: heat: expected ascending minutes'),
        ({'heat': [1.0]}, 'warming: heat: expected a list of'),
        ({'sensors': {'B cover': {'rest_c': 20, 'rise_k': 1, 'lag_min': 5}}},
         'sensors: B cover: expected a name'),
        ({'sensors': {'b': {'rise_k': 1, 'lag_min': 5}}}, 'sensors: b: rest_c: missing'),
        ({'errors': {'E_Y(0Y)B': {'rise_urad': 1, 'lag_min': 5}}}, 'expected rise_um'),
        ({'errors': {'E_Y(Y)B': {'rise_um': 1, 'lag_min': 5}}}, 'expected a constant'),
        ({'errors': {'E_Y(0Y)A': {'rise_um': 1, 'lag_min': 5}}}, 'no axis A'),
        ({'errors': {'E_Y(0Y)B': {'rise_um': 1, 'lag_min': 0}}}, 'lag_min: expected at least'),
        ({'thermometers': {'every_s': 0}}, 'every_s: expected at least 0.1'),
        ({'sensor': {}}, "warming: unknown key 'sensor'"),
    ],
)
def test_mistakes_are_told_in_one_line(tmp_path, changes, expected) -> None:
    data = yaml.safe_load((CONFIG / 'cell_thermal.yaml').read_text())
    data['machine'] = str(CONFIG / data['machine'])
    data['warming'] |= changes
    path = tmp_path / 'truth.yaml'
    path.write_text(yaml.safe_dump(data))
    with pytest.raises(UserError) as caught:
        load_truth(path)
    assert expected in str(caught.value) and '\n' not in str(caught.value)
