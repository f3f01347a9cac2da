"""Results to messages."""

from __future__ import annotations

import numpy as np
from rtest_msgs import msg

from rtest_estimation.nodes.publish import header
from rtest_identification.error_map import AxisMap
from rtest_identification.gap.offline import SessionGap
from rtest_identification.grid_map import GridMap
from rtest_identification.pipeline import Identification


def location_errors(result: Identification, stamp: int) -> msg.LocationErrors:
    """Location and squareness errors; what the data do not determine is left out."""
    location = result.location
    known = np.flatnonzero(location.determined)
    return msg.LocationErrors(
        header=header(stamp, 'machine'),
        session=result.session,
        symbols=[location.symbols[i] for i in known],
        values=location.value[known].tolist(),
        covariance=location.covariance[np.ix_(known, known)].ravel().tolist(),
        residual=result.fit.rms,
    )


def error_map(result: Identification, axis_map: AxisMap, stamp: int) -> msg.ErrorMap:
    """One axis's position-dependent errors over the stations of the outer rotary axis."""
    return msg.ErrorMap(
        header=header(stamp, 'machine'),
        session=result.session,
        axis=axis_map.axis,
        symbols=[p.symbol for p in axis_map.parameters],
        b=axis_map.stations.tolist(),
        c=[],
        values=axis_map.value.ravel().tolist(),
        stddev=axis_map.stddev.ravel().tolist(),
        residual=result.fit.rms,
    )


def grid_map(result: Identification, grid: GridMap, stamp: int) -> msg.ErrorMap:
    """The inner axis's map over both axes; NaN where the data do not determine it."""
    return msg.ErrorMap(
        header=header(stamp, 'machine'),
        session=result.session,
        axis=grid.axis,
        symbols=[p.symbol for p in grid.parameters],
        b=grid.outer.tolist(),
        c=grid.inner.tolist(),
        values=grid.value.ravel().tolist(),
        stddev=grid.stddev.ravel().tolist(),
        residual=grid.rms,
    )


def model_gap(found: SessionGap, stamp: int) -> msg.ModelGap:
    """Verdict, effects and the gap as numbers."""
    result = found.result
    gap = result.gap
    return msg.ModelGap(
        header=header(stamp, 'machine'),
        session=found.session,
        verdict=result.verdict,
        effects=[f.effect.key for f in result.found],
        confidence=[f.confidence for f in result.found],
        rivals=[', '.join(f.rivals) for f in result.found],
        noise=gap.noise,
        before=gap.before,
        after=gap.after,
        heldout_before=gap.heldout_before,
        heldout_after=gap.heldout_after,
    )
