"""What a model may name is known from the machine, before there are data."""

import numpy as np
import pytest
from independent import NMV, SETUPS, static_cycle

from rtest_estimation.errors import UserError
from rtest_identification.gap.catalogue import every_effect
from rtest_identification.gap.effects import library
from rtest_identification.gap.model_file import Model, ModelEffect, Value
from rtest_identification.gap.rows import make_rows
from rtest_identification.machine import parse_machine
from rtest_identification.observations import stack

MACHINE = parse_machine(NMV)


def test_every_effect_that_data_offer_is_known_without_them():
    known = {e.key: [p.name for p in e.shape] for e in every_effect(MACHINE)}
    cycles = [static_cycle(setup, lambda b, c: {}) for setup in SETUPS]
    rows = make_rows(stack(MACHINE, cycles), 0, dict.fromkeys(SETUPS, np.eye(3)))
    offered = library(rows.scene)
    assert {e.key: known[e.key] for e in offered} == {
        e.key: [p.name for p in e.shape] for e in offered
    }
    # These poses turn C fully, swivel B and have three gauges; others need not.
    more = {'sag/C', 'radial/B.6', 'gauge-gain/4'}
    assert more <= set(known) and not more & {e.key for e in offered}


def test_a_model_frees_what_it_lists_and_all_where_it_lists_nothing():
    symbols = [p.symbol for p in Model('m', 'NMV').free(MACHINE)]
    assert len(symbols) == 11
    listed = {s: Value(0.0, None, '') for s in (symbols[4], symbols[1])}
    assert [p.symbol for p in Model('m', '', listed).free(MACHINE)] == [symbols[1], symbols[4]]
    with pytest.raises(UserError, match=r"'m': values: E_X\(0Y\)Q is no free error"):
        Model('m', '', {'E_X(0Y)Q': Value(0.0, None, 'm')}).free(MACHINE)


@pytest.mark.parametrize(('model', 'expected'), [
    (Model('m', 'NMV', {}, (ModelEffect('scale/X', {}),)), None),
    (Model('m', '', {}, (ModelEffect('scale/W', {}),)), "no effect 'scale/W'.* did you mean"),
    (Model('m', '', {}, (ModelEffect('drift', {}),)), "shape has .*, expected .'tau'"),
    (Model('m', 'other'), "is of machine 'other', the recording of 'NMV'"),
])
def test_a_model_is_checked_against_the_machine(model, expected):
    if expected is None:
        model.check(MACHINE)
    else:
        with pytest.raises(UserError, match=expected):
            model.check(MACHINE)
