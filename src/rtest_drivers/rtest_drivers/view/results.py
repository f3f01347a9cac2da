"""Results as the page shows them: numbers in µm and µrad with U (k = 2), lines to draw."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

# Coverage factor of what is shown.
COVERAGE = 2.0


def _angular(symbol: str) -> bool:
    """Whether an error is a rotation: its first letter after E_ is A, B or C."""
    return symbol[2:3] in ('A', 'B', 'C')


def _unit(symbol: str) -> str:
    return 'µrad' if _angular(symbol) else 'µm'


def _micro(values: Any) -> list[float | None]:
    """Values in millionths; None where there is no number."""
    return [round(float(v) * 1e6, 4) if math.isfinite(v) else None for v in np.ravel(values)]


def location_table(
    symbols: Sequence[str], values: Sequence[float], covariance: Sequence[float], residual: float
) -> dict[str, Any]:
    """Location errors and squareness; `covariance` row-major."""
    variance = np.reshape(covariance, (len(symbols), len(symbols))).diagonal()
    expanded = COVERAGE * np.sqrt(np.maximum(variance, 0.0))
    return {
        'rows': [
            {'symbol': symbol, 'value': value, 'U': spread, 'unit': _unit(symbol)}
            for symbol, value, spread in zip(
                symbols, _micro(values), _micro(expanded), strict=True
            )
        ],
        'residual': _micro([residual])[0],
    }


def error_map(
    axis: str, symbols: Sequence[str], outer: Sequence[float], inner: Sequence[float],
    values: Sequence[float], stddev: Sequence[float],
) -> dict[str, Any]:
    """Errors of one axis over the stations of the outer one, or over those of both.

    Each symbol has lines over the last grid: one line, or one for each station of the outer axis.
    """
    shape = (len(symbols), len(outer) if len(inner) else 1, len(inner) or len(outer))
    value, spread = np.reshape(values, shape), COVERAGE * np.reshape(stddev, shape)
    return {
        'axis': axis,
        'over': np.degrees(inner if len(inner) else outer).round(4).tolist(),
        'levels': np.degrees(outer).round(4).tolist() if len(inner) else [],
        'symbols': [
            {
                'symbol': symbol,
                'unit': _unit(symbol),
                'lines': [_micro(line) for line in lines],
                'U': [_micro(line) for line in spreads],
            }
            for symbol, lines, spreads in zip(symbols, value, spread, strict=True)
        ],
    }


def model_gap(
    verdict: str, effects: Sequence[str], confidence: Sequence[float], rivals: Sequence[str],
    noise: float, before: float, after: float, stamp: int,
) -> dict[str, Any]:
    """Verdict of the comparison with the model, rms in µm; stamp of its last cycle [ns]."""
    before_um, after_um, noise_um = _micro([before, after, noise])
    return {
        'verdict': verdict,
        'ended': str(stamp),
        'effects': [
            {'key': key, 'confidence': round(float(sure), 3), 'rivals': others}
            for key, sure, others in zip(effects, confidence, rivals, strict=True)
        ],
        'noise': noise_um,
        'before': before_um,
        'after': after_um,
    }
