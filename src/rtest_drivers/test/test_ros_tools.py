"""Files for ROS tools name what is there: topics of the recording, statuses of the nodes."""

import json
import re
import xml.etree.ElementTree as ET
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml

from rtest_drivers.config import config_path

SOURCES = Path(__file__).parents[2]
TOPIC = re.compile(r'/(?:rtest/[a-z_]+(?:/feedback)?|diagnostics|robot_description)')


@pytest.mark.skipif(find_spec('rtest_msgs') is None, reason='needs ROS 2 and rtest_msgs')
@pytest.mark.parametrize('name', ['foxglove_layout.json', 'plotjuggler_layout.xml'])
def test_layouts_show_topics_that_exist(name) -> None:
    from rtest_drivers.nodes.recorded_topics import CONTRACT

    text = config_path(name).read_text()
    json.loads(text) if name.endswith('json') else ET.fromstring(text)
    topics = set(TOPIC.findall(text))
    assert len(topics) >= 3
    assert topics <= {f'/{topic.lstrip("/")}' for topic in CONTRACT}


def test_every_panel_of_the_foxglove_layout_is_placed_once() -> None:
    layout = json.loads(config_path('foxglove_layout.json').read_text())

    def leaves(node):
        return [node] if isinstance(node, str) else leaves(node['first']) + leaves(node['second'])

    assert sorted(leaves(layout['layout'])) == sorted(layout['configById'])


def group_of(status, analyzers):
    """Groups in which diagnostic_aggregator's GenericAnalyzer puts a status, by its rules."""
    return [
        one['path'] for one in analyzers.values()
        if any(status.startswith(text) for text in one.get('startswith', ()))
        or any(text in status for text in one.get('contains', ()))
    ]


def test_every_status_of_the_nodes_is_in_one_group() -> None:
    data = yaml.safe_load(config_path('diagnostic_aggregator.yaml').read_text())
    analyzers = {
        name: one for name, one in data['analyzers']['ros__parameters'].items()
        if isinstance(one, dict)
    }
    code = '\n'.join(path.read_text() for path in SOURCES.glob('*/*/nodes/*.py'))
    named = set(re.findall(r"diagnostics\.status\(\s*'([a-z]+: [a-z ]+)'", code))
    assert {'estimator: cycle', 'session: progress', 'identifier: session'} <= named
    for status in sorted(named | {'gauges: driver', 'cnc: driver', '/recorder'}):
        assert len(group_of(status, analyzers)) == 1, status
