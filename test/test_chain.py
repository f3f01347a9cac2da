"""`rtest session --check`: a chain with known faults is measured and judged, whole."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import pytest

from rtest_drivers.cli import main
from rtest_drivers.config import config_path

pytestmark = [
    pytest.mark.graph,
    pytest.mark.skipif(
        not (find_spec('rclpy') and find_spec('rtest_msgs')), reason='needs ROS 2 and rtest_msgs'
    ),
]
EXAMPLE = config_path('check_example.yaml')


def truth(folder: Path, **changed: str) -> Path:
    """The demo's cell with some lines changed: of key to the whole rest of the line."""
    lines = []
    for line in config_path('cell_demo.yaml').read_text().splitlines():
        key = line.strip().partition(':')[0]
        indent = line[: len(line) - len(line.lstrip())]
        lines.append(f'{indent}{key}: {changed.pop(key)}' if key in changed else line)
    assert not changed
    path = folder / 'cell.yaml'
    path.write_text('\n'.join(lines).replace(
        'machine: nmv1500dcg.yaml', f'machine: {config_path("nmv1500dcg.yaml")}'
    ))
    return path


def check(folder: Path, capfd, **changed: str) -> tuple[int, dict[str, tuple[str, str]], str]:
    """Exit status; verdict and rest of the line of each finding; what was said on stderr."""
    status = main([
        'session', '--check', '--config', str(EXAMPLE), '--simulate',
        str(truth(folder, **changed)), '--session', 'chain', '--out', str(folder / 'out'),
    ])
    said = capfd.readouterr()
    found = {}
    for line in said.out.splitlines():
        verdict, _, rest = line.partition(' ')
        if verdict in ('RIGHT', 'WRONG', 'OPEN'):
            what, _, value = rest.strip().partition('  ')
            found[what] = (verdict, value)
    return status, found, said.err


def number(found: dict[str, tuple[str, str]], what: str) -> float:
    return float(found[what][1].split()[0])


def test_a_right_chain_is_found_right_and_each_link_was_looked_at(tmp_path, capfd) -> None:
    status, found, err = check(tmp_path, capfd)
    assert err == '' and status == 0, err
    wrong = {what for what, (verdict, _) in found.items() if verdict == 'WRONG'}
    left = {what for what, (verdict, _) in found.items() if verdict == 'OPEN'}
    assert wrong == set()
    # At 50 readings a second, without a thermometer.
    assert left == {'mains hum', 'temperature'}
    for gauge in (1, 2, 3):
        # Tilted by 45 degrees, each mounting by one degree or so more.
        z = float(found[f'gauge {gauge} responds to'][1].split('Z ')[1].split()[0])
        assert z == pytest.approx(-(0.5 ** 0.5), abs=0.06)
        assert number(found, f'gauge {gauge} noise') == pytest.approx(0.1, rel=0.2)
    # (3, -2) um off the spindle; dwells scatter by 0.25 um.
    assert number(found, 'sphere run-out') == pytest.approx(13.0 ** 0.5, abs=0.4)
    assert number(found, 'repeatability of one pose') == pytest.approx(0.25, rel=0.5)
    # Nothing is identified from ten visits to one pose.
    assert not (tmp_path / 'out' / 'chain' / 'identification').exists()


def test_faults_of_the_chain_are_named_and_nothing_else(tmp_path, capfd) -> None:
    status, found, err = check(
        tmp_path, capfd, runout_um='[30.0, 0.0]', noise_um='0.8', dwell_noise_um='0.25'
    )
    assert status == 1
    wrong = {what for what, (verdict, _) in found.items() if verdict == 'WRONG'}
    assert wrong == {'sphere run-out', *(f'gauge {n} noise' for n in (1, 2, 3))}
    assert err.count('rtest: wrong: ') == len(wrong)


def test_a_session_file_that_checks_no_chain_has_only_devices_to_try(tmp_path, capfd) -> None:
    status = main(['session', '--check', '--config', str(config_path('demo.yaml')),
                   '--simulate', str(config_path('cell_demo.yaml'))])
    err = capfd.readouterr().err
    assert status == 2 and 'no devices to try' in err and 'kind: check' in err
    assert main(['session', '--check', 'devices', '--config', str(EXAMPLE)]) == 2
    assert 'devices: missing' in capfd.readouterr().err
