"""Units that users may write, and what they are in SI."""

from __future__ import annotations

import math
import re

# Sizes in SI, and the name of the SI unit.
UNITS = {
    '1': (1.0, '1'), 'nm': (1e-9, 'm'), 'um': (1e-6, 'm'), 'mm': (1e-3, 'm'), 'm': (1.0, 'm'),
    'urad': (1e-6, 'rad'), 'mrad': (1e-3, 'rad'), 'rad': (1.0, 'rad'),
    'arcsec': (math.radians(1.0 / 3600.0), 'rad'), 'deg': (math.radians(1.0), 'rad'),
    's': (1.0, 's'), 'min': (60.0, 's'), 'h': (3600.0, 's'), 'K': (1.0, 'K'),
}
EXPECTED = f'one of {", ".join(UNITS)}, or one per another such as um/m, urad/m, um/m^2, um/K'
_UNIT = re.compile(r'(\w+)(?:/([a-zA-Z]+)(?:\^([2-4]))?)?')


def to_si(text: str) -> tuple[float, str] | None:
    """Size in SI and the SI unit of a unit such as ``um``, ``arcsec/m`` or ``um/m^2``.

    None for what is no unit: see EXPECTED.
    """
    match = _UNIT.fullmatch(text)
    top, bottom, power = match.groups() if match else ('', None, None)
    if top not in UNITS or (bottom is not None and bottom not in UNITS):
        return None
    size, unit = UNITS[top]
    if bottom is None:
        return size, unit
    per, of = UNITS[bottom]
    return size / per ** int(power or 1), f'{unit}/{of}' + (f'^{power}' if power else '')
