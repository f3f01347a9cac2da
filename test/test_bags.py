"""The recordings in bags/: they open, identify, and give again what the nodes published."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from rtest_drivers.info import describe
from rtest_drivers.sim.check import check
from rtest_drivers.sim.truth import load_truth
from rtest_estimation import messages
from rtest_estimation.laser import CentreStatus
from rtest_estimation.laser.correction import THESIS
from rtest_estimation.recording import read_recording
from rtest_identification.dynamic.offline import dynamic_recording
from rtest_identification.gap.offline import gap_recording
from rtest_identification.laser.recorded import laser_recording
from rtest_identification.offline import estimate_recording, identify_recording
from rtest_identification.output import as_dict, write

ROOT = Path(__file__).resolve().parents[1]
BAGS = ROOT / 'bags'
TRUTH = ROOT / 'src' / 'rtest_drivers' / 'config' / 'cell_demo.yaml'


def found(name):
    data = as_dict(identify_recording(BAGS / name))
    return {**data['location_errors'], **data['squareness']}


def test_every_bag_is_described_and_read():
    readme = (BAGS / 'README.md').read_text()
    bags = sorted(path.parent.name for path in BAGS.glob('*/metadata.yaml'))
    assert bags == sorted(re.findall(r'^\| `([\w-]+)` \|', readme, re.MULTILINE))
    for name in bags:
        assert read_recording(BAGS / name).closed
        assert any('nest' in line for line in describe(BAGS / name))


def test_command_and_node_agree_bit_for_bit():
    recording = read_recording(BAGS / 'short')
    published = recording.location_errors[-1]
    data = identify_recording(BAGS / 'short')
    assert list(published.symbols) == list(data.location.symbols)
    np.testing.assert_array_equal(published.values, data.location.value)
    np.testing.assert_array_equal(published.covariance, data.location.covariance.ravel())
    assert published.residual == data.fit.rms


def test_the_model_gap_of_the_node_is_that_of_the_command():
    with AnyReader([BAGS / 'short']) as reader:
        raw = [
            reader.deserialize(data, connection.msgtype)
            for connection, _, data in reader.messages()
            if connection.topic == '/rtest/model_gap'
        ]
    published = raw[-1]
    found = gap_recording(BAGS / 'short')
    assert published.verdict == found.result.verdict
    assert list(published.effects) == [f.effect.key for f in found.result.found]
    gap = found.result.gap
    assert (published.noise, published.before, published.after) == (
        gap.noise, gap.before, gap.after
    )


def test_a_laser_nest_estimated_anew_gives_what_the_node_published():
    recording = read_recording(BAGS / 'laser')
    finished = {f.cycle.plan.cycle: f for f in estimate_recording(recording)}
    for nest in map(messages.nest_calibration, recording.nests):
        again = finished[nest.calibration.rpartition('/')[2]].nest
        np.testing.assert_array_equal(nest.spot, again.spot)
        np.testing.assert_array_equal(nest.correction_nodes, again.correction_nodes)
        np.testing.assert_array_equal(nest.correction_values, again.correction_values)
        assert (nest.kind, nest.sphere_radius) == (again.kind, 25e-3)
    for cycle in map(messages.cycle, recording.cycles):
        again = finished[cycle.plan.cycle].cycle
        assert len(cycle.points) == len(again.points)
        for one, other in zip(cycle.points, again.points, strict=True):
            np.testing.assert_array_equal(one.displacement, other.displacement)
            np.testing.assert_array_equal(one.covariance, other.covariance)
    assert len(finished['low-verification'].cycle.points) == 1185


def test_the_laser_nest_is_worth_what_the_thesis_says_of_its_own():
    result = laser_recording(BAGS / 'laser')
    low, high = result.checks
    assert high.verification is None
    assert low.verification.count(CentreStatus.VALID) == 1185
    # Table 5-5: 6.5 +- 3.8 um without, 1.4 +- 0.7 um with the thesis's correction.
    assert low.verification.raw.mean == pytest.approx(6.5e-6, abs=0.5e-6)
    (thesis,) = [one.verified for one in low.kernels if one.kernel == THESIS]
    assert thesis.mean == pytest.approx(1.4e-6, abs=0.2e-6)
    assert low.verification.corrected.mean < 0.9 * thesis.mean
    # Table 5-2: noise level 1 um; the areas of a sphere of twice the radius.
    assert [scan.laser for scan in result.scans] == [1, 2, 3]
    for scan in result.scans:
        assert scan.profile.noise == pytest.approx(1e-6, rel=0.15)
        assert scan.profile.bounded and 0.95e-3 < scan.profile.measurable < 1.25e-3


def test_the_truth_comes_back_through_lasers(tmp_path):
    result = identify_recording(BAGS / 'laser')
    # 6 degrees of freedom of visits to one place would say 0.2 um and find a misfit.
    assert 0.4e-6 < result.noise < 0.9e-6
    assert not [text for text in result.warnings if 'lacks an effect' in text]
    path = tmp_path / 'identification.json'
    path.write_text(json.dumps(as_dict(result)))
    comparison = check(BAGS / 'laser-cell.yaml', path)
    assert all(row.ok for row in comparison.constants), comparison.table()


def test_the_truth_of_the_simulated_cell_comes_back(tmp_path):
    paths = write(identify_recording(BAGS / 'short'), tmp_path)
    comparison = check(TRUTH, paths['json'])
    assert all(row.ok for row in comparison.constants), comparison.table()
    assert not comparison.missing


def test_the_truth_of_the_independent_simulation_comes_back():
    truth = json.loads((BAGS / 'open-01.truth.json').read_text())
    values = found('open-01')
    z = {
        symbol: (values[symbol]['value'] - value) / values[symbol]['stddev']
        for symbol, value in {**truth['location'], **truth['square']}.items()
    }
    assert len(z) == 11 and max(map(abs, z.values())) < 3.5, z


def test_the_truth_of_the_dynamic_cell_comes_back():
    truth = load_truth(TRUTH.with_name('cell_dynamic.yaml'))
    (result,) = dynamic_recording(BAGS / 'dynamic').results
    assert {(e.key, e.channel) for e in result.naming.effects} == {
        ('servo-mismatch/C', 'encoders'), ('radius-shrink', 'encoders'),
        ('friction-lag', 'gauges'), ('clock-offset', 'gauges'),
    }
    assert result.naming.verdict == 'explained'
    friction = next(e for e in result.naming.effects if e.key == 'friction-lag')
    assert not {'servo-mismatch/C', 'clock-offset'} & set(friction.rivals)
    assert abs(result.offset.value - truth.gauges.late) < 4 * result.offset.stddev < 2e-3
    later = truth.drives.rotary_lag - truth.drives.linear_lag
    for one, lag, speed in zip(result.lags, (3e-6, 6e-6), (358, 3583), strict=True):
        # The nest is calibrated to a few parts in ten thousand.
        assert one.beyond[0] == pytest.approx(lag, rel=1e-3, abs=4 * one.beyond[1])
        # C is late by less than X and Y: the sphere is behind.
        servo = -later * np.radians(speed) / 60.0 * np.hypot(0.2e-3, 83.9e-3)
        assert one.encoders[0] == pytest.approx(servo, abs=4 * one.encoders[1] + 1e-9)


def test_the_report_is_one_file_that_opens_offline(tmp_path):
    paths = write(identify_recording(BAGS / 'short'), tmp_path)
    page = paths['report'].read_text()
    assert 'E_A(0B)C' in page and 'data:image/png;base64,' in page
    # The library of the turnable picture is in the page and holds addresses in its code; nothing
    # is fetched from anywhere: all images are data, no script or style has a source, and what the
    # page itself says holds no address at all.
    scripts = re.findall(r'<script>(.*?)</script>', page, re.DOTALL)
    library = max(scripts, key=len)
    assert len(library) > 1e6 and page.count('<script') == len(scripts)
    own = page.replace(library, '')
    assert not re.search(r'https?://|@import|<link|<iframe|fetch\(', own)
    assert set(re.findall(r'\b(?:src|srcset|href)="([^"]{5})', own)) == {'data:'}
    assert {p.name for p in tmp_path.iterdir()} >= {
        'identification.json', 'report.html', 'error_map_B.png', 'error_map_B.svg',
        'residuals.png', 'residuals.svg', 'positions_3d.png', 'positions.svg', 'directions.png',
    }


@pytest.mark.parametrize('share', [0.2, 0.5, 0.9, 0.999])
def test_a_cut_recording_keeps_what_it_holds(tmp_path, share):
    source = BAGS / 'short' / 'short.mcap'
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes(source.read_bytes()[: int(share * source.stat().st_size)])
    recording = read_recording(cut)
    assert not recording.closed
    assert any('cut' in warning for warning in recording.warnings)
    whole = read_recording(BAGS / 'short')
    assert len(recording.gauges) > 0.8 * share * len(whole.gauges) - 50
