"""Which readings of a stream are shown."""

import numpy as np

from rtest_estimation.thinning import Thinning

MS = 1_000_000


def shown(thinning, stamps, batch, valid=lambda stamps: np.ones(len(stamps), dtype=bool)):
    blocks = [stamps[k : k + batch] for k in range(0, len(stamps), batch)]
    return np.concatenate([block[thinning.rows(block, valid(block))] for block in blocks])


def test_of_fast_batches_the_newest_reading():
    # 10 kHz in batches of 100, shown at 100 Hz: the last of each batch, but for the very first.
    stamps = np.arange(1000) * MS // 10
    found = shown(Thinning(10 * MS), stamps, 100)
    np.testing.assert_array_equal(found[-9:], stamps[199::100])
    assert len(found) <= 11


def test_a_batch_longer_than_the_period_shows_several():
    # 1 kHz in batches of 100: one of each hundredth of a second.
    found = shown(Thinning(10 * MS), np.arange(1000) * MS, 100)
    assert 99 <= len(found) <= 102
    assert np.diff(found).max() <= 20 * MS


def test_a_stream_as_slow_as_the_period_is_shown_whole_in_spite_of_jitter():
    rng = np.random.default_rng(1)
    stamps = np.arange(200) * 10 * MS + rng.integers(-MS // 25, MS // 25, 200) + 10 * MS
    assert len(shown(Thinning(10 * MS), stamps, 1)) == 200


def test_what_is_not_valid_is_passed_over():
    stamps = np.arange(1000) * MS // 10
    found = shown(Thinning(10 * MS), stamps, 100, lambda s: (s // (MS // 10)) % 100 < 40)
    np.testing.assert_array_equal(found, stamps[39::100])
    assert not len(shown(Thinning(10 * MS), stamps, 100, lambda s: s < 0))
