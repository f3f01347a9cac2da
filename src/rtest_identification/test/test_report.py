"""The report: whole, self-contained, for any set-ups and chains; and what its figures choose."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from independent import NMV, SETUPS, noisy, static_cycle

from rtest_estimation.records import Cycle, CyclePlan, CyclePoint, Kind, Missing
from rtest_identification.figures.shapes import magnify
from rtest_identification.figures.style import chosen_levels, magnification, round_down
from rtest_identification.kinematics import linear_positions, predict
from rtest_identification.machine import parse_machine
from rtest_identification.pipeline import identify
from rtest_identification.presentation import present
from rtest_identification.report import render
from rtest_identification.report_sections import draw
from rtest_identification.squareness import separate
from rtest_identification.symbols import location_parameters

MACHINE = parse_machine(NMV)
ERRORS = {'B': {'X': -7.8e-6, 'B': 4.1e-5}, 'C': {'A': -1.5e-5}, 'Z': {'B': -8e-6}}
LINEAR = """
  X: {type: linear, direction: [1, 0, 0]}
  Y: {type: linear, direction: [0, 1, 0]}
  Z: {type: linear, direction: [0, 0, 1]}
"""
TRUNNION = f"""
name: trunnion
chain: [C, A, Y, bed, X, Z]
axes: {LINEAR}
  A: {{type: rotary, direction: [1, 0, 0], sense: -1}}
  C: {{type: rotary, direction: [0, 0, 1], sense: -1}}
"""
ONE_IN_HEAD = f"""
name: table and head
chain: [C, bed, X, Y, Z, B]
axes: {LINEAR}
  B: {{type: rotary, direction: [0, 1, 0]}}
  C: {{type: rotary, direction: [0, 0, 1]}}
tool_mm: [0, 0, -150]
"""
TWO_IN_HEAD = f"""
name: fork head
chain: [bed, X, Y, Z, C, B]
axes: {LINEAR}
  B: {{type: rotary, direction: [0, 1, 0]}}
  C: {{type: rotary, direction: [0, 0, 1]}}
tool_mm: [0, 0, -150]
"""
ROUND = np.radians(np.arange(12) * 30.0)


def session(setups=tuple(SETUPS), noise=2.5e-7, drop=(), **levels):
    rng = np.random.default_rng(51)
    cycles = []
    for setup in setups:
        cycle = noisy(static_cycle(setup, lambda b, c: ERRORS, **levels), noise, rng)
        kept = tuple(p for p in cycle.points if p.index not in drop)
        gone = tuple(Missing(n, 'made so') for n in drop)
        cycles.append(replace(cycle, points=kept, missing=gone))
    return identify(MACHINE, cycles)


def other_machine(text, outer, inner, spheres, seed=52):
    """A session on any chain, by the package's own kinematics, with errors on every axis."""
    machine, rng = parse_machine(text), np.random.default_rng(seed)
    errors = np.zeros((5, 6))
    rotary = [machine.letters.index(n) for n in machine.rotary]
    errors[rotary] = rng.normal(size=(2, 6)) * ([2e-5] * 3 + [5e-6] * 3)
    truth = {}
    for p in location_parameters(machine):
        if p.axis in machine.linear:
            truth[p.symbol] = errors.flat[p.column] = 2e-5 * rng.normal()
    cycles = []
    for name, sphere in spheres.items():
        positions = np.zeros((len(outer) * len(inner), 5))
        grid = np.array(np.meshgrid(outer, inner, indexing='ij')).reshape(2, -1)
        positions[:, rotary] = grid.T
        positions = linear_positions(machine, np.array(sphere), positions)
        w = predict(machine, positions, errors).centre - sphere
        w = w - w[0] + 2e-7 * rng.normal(size=w.shape)
        points = tuple(
            CyclePoint(n, n, row, np.zeros(5, np.int8), x, 1e-15 * np.eye(3), 10)
            for n, (row, x) in enumerate(zip(positions, w, strict=True))
        )
        plan = CyclePlan(
            len(cycles), 'made', f'{name}-static', Kind.STATIC, name, np.array(sphere),
            machine.letters, positions, 0.3,
        )
        cycles.append(Cycle(plan, points, (), '', len(cycles)))
    return identify(machine, cycles), truth


SPHERES = {
    'far': (0.0, -0.09, 0.05), 'far high': (0.0, -0.09, 0.15),
    'mid': (0.0, 0.0, 0.05), 'mid high': (0.0, 0.0, 0.15),
}


class Links(HTMLParser):
    """Everything a page would fetch."""

    def __init__(self):
        super().__init__()
        self.found = []

    def handle_starttag(self, tag, attributes):
        for name, value in attributes:
            fetches = name in ('src', 'srcset', 'data', 'poster', 'action', 'background')
            if fetches or (name == 'href' and tag in ('link', 'base', 'image', 'use')):
                self.found.append((tag, value or ''))


def test_the_page_is_whole_and_fetches_nothing(tmp_path):
    result = session()
    page = render(result, tmp_path)
    links = Links()
    links.feed(page)
    assert len(links.found) >= 10
    assert all(value.startswith('data:image/png;base64,') for _, value in links.found)
    assert '@import' not in page.split('</style>')[0] and 'url(' not in page.split('</style>')[0]
    # What the page itself says, without the library, holds no address at all.
    scripts = re.findall(r'<script>(.*?)</script>', page, re.DOTALL)
    library = max(scripts, key=len)
    assert len(library) > 1e6 and page.count('<script') == 3
    assert not re.search(r'https?://', page.replace(library, ''))
    order = [page.index(text) for text in (
        '<h2>What the table does', '<h2>Error map', '<h2>Location errors', '<h2>Residuals',
        '<h2>Separation of squareness', '<h2>More figures',
    )]
    assert order == sorted(order)
    for name in ('positions_3d', 'positions', 'positions_without_squareness', 'positions_centre',
                 'positions_level_frame', 'directions', 'error_map_B', 'residuals',
                 'displacements'):
        for kind in ('png', 'svg'):
            assert (tmp_path / f'{name}.{kind}').stat().st_size > 10_000
        assert f'alt="{name}"' in page


def test_the_turnable_picture_holds_every_level_and_shows_one(tmp_path):
    result = session()
    script = draw(result, tmp_path).positions[0].script
    call = json.loads(f'[{script.removeprefix("Plotly.newPlot(").removesuffix(");")}]')
    _, traces, layout, _ = call
    buttons = layout['updatemenus'][0]['buttons']
    assert [b['label'] for b in buttons] == [f'B = {n}°' for n in
                                             ('−75', '−50', '−25', '0', '25', '50', '75')]
    shown = [b['args'][1] for b in buttons]
    assert all(len(s) == len(traces) for s in shown)
    assert np.sum(shown, axis=0).tolist() == [1] * len(traces)
    assert [t['visible'] for t in traces] == shown[3]
    assert {t['name'] for t in traces if t.get('showlegend', True)} == set(SETUPS)


@pytest.mark.parametrize(
    ('setups', 'drop', 'absent'),
    [(('1a',), (), 'Centre set-ups'), (('2b',), (4, 5), 'Average circles')],
)
def test_a_single_setup_gives_what_it_can(tmp_path, setups, drop, absent):
    sections = draw(session(setups, drop=drop), tmp_path)
    assert any(absent in sentence for sentence in sections.absent)
    assert sections.positions and sections.residuals


@pytest.mark.parametrize('count', [3, 50])
def test_few_and_many_levels(tmp_path, count):
    result = session(('1a', '2b'), b=np.radians(np.linspace(-90.0, 90.0, count)), c=ROUND[::2])
    sections = draw(result, tmp_path)
    text = ' '.join(p.caption for p in sections.positions)
    assert ('8 of 50 stations are shown' in text) is (count == 50)
    menu = json.loads(f'[{sections.positions[0].script[15:-2]}]')[2]['updatemenus'][0]
    assert len(menu['buttons']) == count


def test_a_trunnion_with_other_sense_separates_its_squareness(tmp_path):
    result, truth = other_machine(
        TRUNNION, np.radians(np.linspace(-80.0, 80.0, 5)), ROUND, SPHERES
    )
    view = present(result)
    assert (view.turning, view.stepping, view.seen) == ('C', 'A', 'sensors nest')
    separation = separate(result, view)
    assert separation.determined.all()
    for symbol, value, stddev in zip(
        separation.symbols, separation.value, separation.stddev, strict=True
    ):
        assert abs(value - truth[symbol]) < 4 * stddev, symbol
    assert not separation.failures
    assert [a.law for a in separation.agreements] == ['cos 2A', 'cos A and sin A']
    assert len(draw(result, tmp_path).positions) == 2


def test_a_table_and_a_head(tmp_path):
    result, truth = other_machine(
        ONE_IN_HEAD, ROUND, np.radians(np.linspace(-80.0, 80.0, 5)), SPHERES
    )
    view = present(result)
    assert (view.turning, view.stepping, view.seen) == ('C', 'B', 'sensors nest')
    separation = separate(result, view)
    for symbol, value, stddev, good in zip(
        separation.symbols, separation.value, separation.stddev, separation.determined, strict=True
    ):
        assert not good or abs(value - truth[symbol]) < 4 * stddev, symbol
    # The circles lie in one plane whatever B does: X against Y is not to be had from them.
    assert separation.determined.tolist() == ['E_C' not in s for s in separation.symbols]
    assert draw(result, tmp_path).positions


def test_a_head_without_a_turning_table_shows_the_sphere(tmp_path):
    result, _ = other_machine(
        TWO_IN_HEAD, np.radians(np.linspace(-150.0, 150.0, 6)),
        np.radians(np.linspace(-90.0, 90.0, 7)), {'one': (0.1, 0.0, 0.1), 'two': (-0.1, 0.1, 0.0)},
    )
    view = present(result)
    assert (view.turning, view.stepping, view.seen) == ('B', 'C', 'sphere')
    # The tool hangs 150 mm below the axis of B.
    np.testing.assert_allclose(np.linalg.norm(view.nominal, axis=1), 0.15, atol=1e-9)
    sections = draw(result, tmp_path)
    assert sections.separation is None
    assert any('do not turn the table' in sentence for sentence in sections.absent)


def test_magnification_is_round_and_the_same_before_and_after():
    assert [round_down(v) for v in (1.0, 1.9, 2.0, 4.9, 5.0, 12345.0)] == [1, 1, 2, 2, 5, 10000]
    error = np.array([[3e-6, 4e-6, 0.0], [0.0, 0.0, 1e-6]])
    assert magnification([error], 0.036) == 5000
    view = present(session(('1a', '2a')))
    first, second = magnify(view, [view.error(), view.error(squareness=False)])
    assert first.factor == second.factor
    moved = first.positions - view.nominal
    np.testing.assert_allclose(moved, first.factor * view.error(), atol=1e-12)


def test_the_magnified_average_circle_goes_through_its_points():
    view = present(session(('1a',), noise=0.0))
    drawn = magnify(view, [view.error()])[0]
    level = 5
    rows = view.rows(0, level)
    circle = drawn.average_circle(0, level)
    for point in drawn.positions[rows]:
        near = np.linalg.norm(circle - point, axis=1).min()
        # 5 degrees between drawn points of 90 mm radius; errors of 5 um are drawn 30 mm large.
        assert near < 5e-3


def test_levels_chosen_hold_the_ends_and_zero():
    levels = np.radians(np.linspace(-30.0, 100.0, 28))
    view = present(session(('1a', '2b'), b=levels, c=ROUND[::3]))
    chosen = chosen_levels(view, 8)
    # B = 0 is there as well, but only with the first and the last pose: it is not chosen.
    assert len(view.levels) == 29
    np.testing.assert_allclose(view.levels[[chosen[0], chosen[-1]]], levels[[0, -1]], atol=1e-9)
    assert len(chosen) == 8 and np.abs(view.levels[chosen]).min() == pytest.approx(
        np.abs(levels).min()
    )
