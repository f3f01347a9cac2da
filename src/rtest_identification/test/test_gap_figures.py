"""Figures of the model gap."""

from types import SimpleNamespace

import numpy as np
import pytest

from rtest_identification.gap.figures import closing
from rtest_identification.gap.workflow import Gap

NAN = float('nan')


def drawn(gap, found=()):
    figure = closing(SimpleNamespace(gap=gap, found=found))
    figure.draw_without_rendering()
    (axes,) = figure.axes
    lines = [line.get_segments()[0] for line in axes.collections]
    bars = [(bar.get_x() + 0.5 * bar.get_width(), bar.get_height()) for bar in axes.patches]
    return axes, np.array(lines), np.array(bars)


def test_each_group_of_poses_has_the_line_of_its_own_noise():
    axes, lines, bars = drawn(Gap(4.5e-7, 5.8e-7, 4.7e-7, 4.0e-7, 2.5e-7, 2.6e-7), ('one',))
    assert bars[:, 1] == pytest.approx([0.58, 0.47, 0.40, 0.25])
    assert lines[:, :, 1] == pytest.approx(np.array([[0.45, 0.45], [0.26, 0.26]]))
    for line, pair in zip(lines, bars.reshape(2, 2, 2), strict=True):
        assert line[0, 0] < pair[0, 0] < pair[1, 0] < line[1, 0]
    assert lines[0, 1, 0] < lines[1, 0, 0]
    told = [label.get_text() for label in axes.get_xticklabels()]
    assert told == [
        'all poses\nnoise 0.45 µm', 'poses held out of naming and fitting\nnoise 0.26 µm',
    ]


def test_without_held_out_poses_there_is_one_group():
    _, lines, bars = drawn(Gap(2.5e-7, 5.8e-7, 2.6e-7, NAN, NAN, NAN))
    assert len(lines) == 1 and len(bars) == 2


def test_no_number_lies_on_the_line():
    axes, lines, _ = drawn(Gap(2.6e-7, 5.0e-7, 2.55e-7, NAN, NAN, NAN))
    before, after = (text.xy[1] for text in axes.texts)
    assert before == pytest.approx(0.5) and after == pytest.approx(lines[0, 0, 1])
