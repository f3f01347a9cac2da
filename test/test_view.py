"""The page of `rtest session --view` in a browser, beside a simulated session."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from rtest_drivers.config import config_path
from rtest_drivers.domain import free_domain
from rtest_estimation.bagfile import read_bag

CHROMIUM = shutil.which('chromium')

pytestmark = [
    pytest.mark.graph,
    pytest.mark.skipif(
        not (find_spec('rclpy') and find_spec('rtest_msgs')), reason='needs ROS 2 and rtest_msgs'
    ),
    pytest.mark.skipif(
        CHROMIUM is None or find_spec('playwright') is None,
        reason='needs chromium (tools/install_chromium.sh) and playwright',
    ),
]

CONFIG = """
machine: {machine}
cycle: {{b_deg: [-40, 0, 40], c_deg: [0, 120, 240], dwell_s: 0.3}}
nest_calibration: {{step_mm: 1.0, dwell_s: 0.3}}
setups:
  1a: {{sphere_mm: [0, -90.0, 40.6]}}
  2b: {{sphere_mm: [0, 0, 140.6]}}
"""
# Of waiting for what a loaded computer may do slowly [ms].
PATIENCE = 60_000
# Pose 4 of the static cycle is not driven to.
FAULT = '\nfaults:\n  - {kind: pose_skipped, cycle: 1a-static, pose: 4}\n'


def tap(page, wish: str) -> None:
    """Tap a control, twice where it asks whether one is sure."""
    button = page.locator(f'[data-wish={wish}]')
    button.click()
    if 'sure' in (button.get_attribute('class') or ''):
        button.click()


class Graph:
    """A session with a page, the page in a browser, and a listener to the topics."""

    def __init__(self, folder: Path, page, address: str, process: subprocess.Popen, domain: int):
        self.folder, self.page, self.address = folder, page, address
        self.process, self.domain = process, domain

    def answer(self) -> str:
        return self.page.inner_text('#answer')

    def tap(self, wish: str) -> str:
        """Tap a control, twice where it asks whether one is sure; the answer."""
        tap(self.page, wish)
        self.page.wait_for_selector('#answer.ok, #answer.error')
        return self.answer()

    def pid(self, name: str) -> int:
        """Process id of a node of this session."""
        for entry in Path('/proc').glob('[0-9]*'):
            try:
                words = (entry / 'cmdline').read_bytes().decode(errors='replace').split('\0')
                here = Path(os.readlink(entry / 'cwd')) == self.folder
            except OSError:
                continue
            if here and f'rtest_drivers.nodes.{name}' in words:
                return int(entry.name)
        raise LookupError(name)


@pytest.fixture(scope='module')
def graph(tmp_path_factory) -> Iterator[Graph]:
    from playwright.sync_api import sync_playwright

    folder = tmp_path_factory.mktemp('view')
    config, truth = folder / 'short.yaml', folder / 'truth.yaml'
    config.write_text(CONFIG.format(machine=config_path('nmv1500dcg.yaml')))
    truth.write_text(config_path('cell_demo.yaml').read_text().replace(
        'machine: nmv1500dcg.yaml', f'machine: {config_path("nmv1500dcg.yaml")}'
    ) + FAULT)
    domain = free_domain()
    process = subprocess.Popen(
        [
            sys.executable, '-m', 'rtest_drivers.cli', 'session', '--config', str(config),
            '--simulate', str(truth), '--session', 'short', '--out', str(folder / 'out'),
            '--domain', str(domain), '--hold', '--view', '--port', '0',
        ],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=folder,
    )
    try:
        address = next(
            (found[1] for line in process.stdout if (found := re.search(r'page: (\S+)', line))),
            None,
        )
        assert address, process.stderr.read()
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(
                executable_path=CHROMIUM, args=['--no-sandbox']
            )
            page = browser.new_page(viewport={'width': 1280, 'height': 900})
            page.set_default_timeout(PATIENCE)
            errors: list[str] = []
            page.on('pageerror', lambda error: errors.append(str(error)))
            # That the server ends before the browser is no error of the page.
            page.on(
                'console', lambda line: 'net::ERR' in line.text or errors.append(line.text)
            )
            page.goto(address)
            page.wait_for_selector("#doing:has-text('waits to be started')")
            yield Graph(folder, page, address, process, domain)
            assert not errors
            browser.close()
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)


@pytest.fixture(scope='module')
def topics(graph) -> Iterator:
    """Last message of each topic, heard by a node of the test's own."""
    import rclpy
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor
    from rtest_msgs.msg import Cycle, GaugeSamples, LocationErrors, ModelGap
    from sensor_msgs.msg import JointState
    from std_msgs.msg import String

    from rtest_estimation.nodes.qos import LATCHED_100

    context = Context()
    rclpy.init(context=context, domain_id=graph.domain)
    node = rclpy.create_node('listener', context=context, use_global_arguments=False)
    heard: dict[str, list] = {}
    for name, kind, qos in (
        ('gauges', GaugeSamples, 1), ('cnc/feedback', JointState, 1),
        ('cycle', Cycle, LATCHED_100), ('location_errors', LocationErrors, LATCHED_100),
        ('model_gap', ModelGap, LATCHED_100), ('mark', String, LATCHED_100),
    ):
        heard[name] = []
        node.create_subscription(kind, f'rtest/{name}', heard[name].append, qos)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    class Topics:
        def __init__(self) -> None:
            self.node = node

        def next(self, name: str, meant=lambda message: True) -> object:
            """The second message from now on of a stream, of a latched topic that meant."""
            streamed = name in ('gauges', 'cnc/feedback')
            if streamed:
                heard[name].clear()
            deadline = time.monotonic() + PATIENCE / 1e3
            while time.monotonic() < deadline:
                executor.spin_once(timeout_sec=0.1)
                if len(heard[name]) > streamed and meant(heard[name][-1]):
                    break
            return heard[name][-1]

        def spin(self, seconds: float) -> None:
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                executor.spin_once(timeout_sec=0.05)

    yield Topics()
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown(context=context)


def figure(text: str) -> float:
    return float(text.replace('−', '-'))


def test_values_on_the_page_are_those_on_the_topics(graph, topics) -> None:
    page = graph.page
    assert '1a-nest starts' in graph.tap('start')
    page.wait_for_selector("#cycles button:has-text('1a-nest ✓')")
    page.wait_for_selector("#doing:has-text('1a-static waits')")
    # The machine stands still now; the gauges scatter by 0.1 µm.
    block = topics.next('gauges')
    readings = [1e6 * d for d in block.displacement[-block.channels:]]
    shown = [figure(t) for t in page.locator('#gauges .figure').all_inner_texts()]
    assert shown == pytest.approx(readings, abs=2.0)
    feedback = topics.next('cnc/feedback')
    for name, value in zip(feedback.name, feedback.position, strict=True):
        row = page.inner_text(f'[data-axis={name}] .figure')
        scale = 180 / 3.141592653589793 if name in 'BCS' else 1e3
        assert figure(row) == pytest.approx(value * scale, abs=1e-3)
    assert page.get_attribute('[data-device=cnc]', 'data-level') == 'ok'
    assert '50.' in page.inner_text('[data-device=gauges] td:last-child') or '49.' in \
        page.inner_text('[data-device=gauges] td:last-child')


def test_a_wish_that_cannot_be_granted_is_refused_with_the_reason(graph) -> None:
    assert 'Refused' in (said := graph.tap('repeat'))
    assert 'nothing to repeat' in said


def test_a_mark_is_on_the_topic_and_on_the_page(graph, topics) -> None:
    graph.page.fill('#mark-text', 'door opened')
    graph.page.click('#mark button')
    graph.page.wait_for_selector("#recording dd:has-text('door opened')")
    assert topics.next('mark').data == 'door opened'


def test_a_device_that_hangs_is_shown_and_so_is_its_return(graph) -> None:
    page, pid = graph.page, graph.pid('gauges')
    page.wait_for_selector('[data-device=gauges][data-level=ok]')
    os.kill(pid, signal.SIGSTOP)
    try:
        page.wait_for_selector('[data-device=gauges][data-level=error]')
        assert page.inner_text('[data-device=gauges] .badge') == 'ERROR'
        page.wait_for_selector('#gauges .figure.old')
    finally:
        os.kill(pid, signal.SIGCONT)
    page.wait_for_selector('[data-device=gauges][data-level=ok]')


def buttons(page) -> list[tuple[bool, str]]:
    """Whether each button of the footer is off, and its reason."""
    return [
        (one.is_disabled(), one.get_attribute('title') or '')
        for one in page.locator('footer button').all()
    ]


def test_without_a_connection_the_buttons_are_off_and_say_why(graph) -> None:
    page, pid = graph.page, graph.pid('view')
    assert {off for off, _ in buttons(page)} == {False}
    os.kill(pid, signal.SIGSTOP)
    try:
        page.wait_for_selector('body.lost')
        page.wait_for_selector('[data-wish=start]:disabled')
        (state,) = set(buttons(page))
        assert state[0] and 'No connection' in state[1]
        assert 'No connection' in page.inner_text('footer')
    finally:
        os.kill(pid, signal.SIGCONT)
    page.wait_for_selector('[data-wish=start]:enabled')
    assert set(buttons(page)) == {(False, '')}
    assert 'No connection' not in page.inner_text('footer')


@pytest.mark.parametrize(('key', 'why'), [('guessed', 'controls are off'), ('', 'Looking only')])
def test_without_the_key_the_buttons_stay_off(graph, key, why) -> None:
    other = graph.page.context.browser.new_page()

    def another_key(route) -> None:
        answer = route.fetch()
        text = re.sub('(name="rtest-key" content=").*?"', rf'\g<1>{key}"', answer.text())
        route.fulfill(response=answer, body=text)

    other.route(graph.address, another_key)
    other.goto(graph.address)
    other.wait_for_selector("#link:has-text('LIVE')", timeout=PATIENCE)
    if key:
        # What the server has not heard while it stood still may be in ERROR for a moment.
        tap(other, 'start')
        other.wait_for_selector("#answer:has-text('Refused: controls are off')")
    # The connection is there all the time.
    other.wait_for_timeout(1000)
    (state,) = set(buttons(other))
    assert state[0] and why in state[1] and why in other.inner_text('footer')
    other.close()


def connections(node) -> dict[str, tuple[int, int]]:
    """Publishers and subscriptions of every topic."""
    return {
        name: (node.count_publishers(name), node.count_subscribers(name))
        for name, _ in node.get_topic_names_and_types()
    }


def test_opening_and_closing_the_page_changes_nothing_in_the_graph(graph, topics) -> None:
    before = None
    # Until the listener knows the whole graph.
    while before != (now := (connections(topics.node), sorted(topics.node.get_node_names()))):
        before = now
        topics.spin(1.5)
    other = graph.page.context.browser.new_page()
    other.goto(graph.address)
    other.wait_for_selector('[data-device=gauges][data-level=ok]', timeout=PATIENCE)
    topics.spin(0.5)
    assert (connections(topics.node), sorted(topics.node.get_node_names())) == before
    other.close()
    topics.spin(0.5)
    assert (connections(topics.node), sorted(topics.node.get_node_names())) == before


def test_calibrating_measures_the_nest_again_and_then_the_cycle(graph) -> None:
    page = graph.page
    assert 'Done' in graph.tap('calibrate')
    page.wait_for_selector("#doing:has-text('1a-nest waits')")
    graph.tap('start')
    page.wait_for_selector("#doing:has-text('1a-static waits')")
    assert page.locator("#cycles button:has-text('1a-nest ✓')").count() == 2


def test_topics_without_ros_tools(graph) -> None:
    from rtest_drivers.nodes.topics import looker

    with looker(graph.domain) as look:
        text = next(look.messages('/rtest/machine', 1))
        assert text.startswith('data: ') and 'chain' in text
        rate = look.rates('rtest/gauges', 2.0)['/rtest/gauges']
        assert rate.messages > 1 and rate.rate == rate.messages / 2.0 and rate.longest_gap > 0.0
        found = {one.name: one for one in look.topics()}
        assert found['/rtest/gauges'].type == 'rtest_msgs/msg/GaugeSamples'
        assert found['/rtest/gauges'].publishers == 1
        # The recorder, the estimator and the page.
        assert found['/rtest/gauges'].subscriptions >= 3


def test_results_and_missing_poses_are_shown(graph, topics) -> None:
    page = graph.page
    assert '1a-static starts' in graph.tap('start')
    page.wait_for_selector('#location tbody tr')
    errors = topics.next('location_errors')
    rows = page.locator('#location tbody tr').all_inner_texts()
    assert len(rows) == len(errors.symbols)
    for row, symbol, value in zip(rows, errors.symbols, errors.values, strict=True):
        name, shown, *_ = row.split('\t')
        assert name == symbol
        assert figure(shown) == pytest.approx(1e6 * value, abs=0.0051)
    cycle = topics.next('cycle', lambda message: message.plan.cycle == '1a-static')
    assert list(cycle.missing) == [4]
    # The reason comes on a topic of its own.
    page.wait_for_selector("#missing li:not(:text-matches(': missing$'))")
    missing = page.inner_text('#missing')
    assert missing.startswith('Pose 4 (') and ': ' in missing and not missing.endswith('missing')
    assert page.locator('#poses button.missing').count() == 1
    assert page.locator('#poses button.done').count() == len(cycle.points)
    assert '×' in page.inner_text('#picture-factor')
    # The comparison with the model comes some seconds later, and says of which cycles it is.
    page.wait_for_selector("#gap:has-text('up to 1a-static')")
    gap = topics.next('model_gap')
    assert page.inner_text('#gap .badge') == gap.verdict
    # The session has no run-out cycle: that stands beside the numbers it concerns.
    page.wait_for_selector("#location-card #warnings li:has-text('run-out')")
    # Something was drawn: not every pixel is transparent.
    assert page.evaluate(
        "() => { const c = document.querySelector('#picture'); "
        "return c.getContext('2d').getImageData(0, 0, c.width, c.height).data.some((v) => v); }"
    )


def test_what_is_said_of_an_effect_stands_below_it(graph) -> None:
    page = graph.page.context.browser.new_page()
    page.goto(graph.address)
    page.wait_for_selector('#location tbody tr', timeout=PATIENCE)
    page.evaluate("""async () => {
        const {cell} = await import('/connection.js'), {drawResults} = await import('/results.js');
        cell.parts.gap = {
            verdict: 'partly explained', noise: 0.3, before: 2.5, after: 0.9, effects: [
                {key: 'angle/CX', confidence: 0.93, rivals: ''},
                {key: 'scale/Y', confidence: 0.991, rivals: 'scale/B'},
            ],
        };
        cell.parts.gap_notes = [
            'angle/CX: yaw of X; E_C(X)X = a x', '  a = 12.3 ± 0.4 µrad/m (k = 2)',
            '  confidence 0.93', 'unexplained at B = -40.0 deg: rms 2.10 µm',
        ];
        drawResults();
    }""")
    assert page.inner_text('#gap .badge.warn') == 'partly explained'
    # An effect without words is named all the same.
    assert [
        [line for line in text.split('\n') if line]
        for text in page.locator('#gap li').all_inner_texts()
    ] == [
        ['scale/Y (99 % sure; cannot be told from scale/B)'],
        ['angle/CX: yaw of X; E_C(X)X = a x', 'a = 12.3 ± 0.4 µrad/m (k = 2)', 'confidence 0.93'],
        ['unexplained at B = -40.0 deg: rms 2.10 µm'],
    ]
    page.close()


def test_the_session_ended_from_the_page_is_closed_and_holds_the_mark(graph) -> None:
    graph.page.wait_for_selector("#doing:has-text('2b-nest waits')")
    assert 'Done' in graph.tap('abort')
    said = []
    for line in graph.process.stdout:
        said.append(line)
        if 'recorder: recorded' in line:
            break
    assert any('not measured: 2b-nest, 2b-static' in line for line in said)
    graph.page.wait_for_selector("#link:has-text('NO CONNECTION')")
    graph.page.wait_for_selector('body.lost')
    graph.page.wait_for_selector('[data-wish=start]:disabled')
    assert {off for off, _ in buttons(graph.page)} == {True}
    assert graph.page.is_visible("#warnings li:has-text('run-out')")
    bag = read_bag(graph.folder / 'out' / 'short', ['std_msgs/msg/String'])
    assert bag.closed
    assert [mark.data for mark in bag.messages('/rtest/mark')] == ['door opened']
    # What the page last showed of the model is what was recorded.
    *_, gap = bag.messages('/rtest/model_gap')
    assert graph.page.inner_text('#gap .badge') == gap.verdict
    assert [key for key in gap.effects if key not in graph.page.inner_text('#gap')] == []
    told = [
        [pair.value for pair in one.values if pair.key.startswith('note ')]
        for message in bag.messages('/diagnostics') for one in message.status
        if one.name == 'identifier: model gap'
    ][-1]
    items = graph.page.locator('#gap li').all_inner_texts()
    assert [line for text in items for line in text.split('\n') if line] == [
        text.strip() for text in told
    ]
