"""The machine as data: a chain of axes from the table to the tool (YAML)."""

from __future__ import annotations

import math
import reprlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rtest_estimation.errors import UserError
from rtest_estimation.plain_text import is_name
from rtest_estimation.yaml_text import load_yaml

BED = 'bed'
MAX_AXES = 12
_KEYS = {'name', 'chain', 'axes', 'tool_mm'}
_AXIS_KEYS = {
    'linear': {'type', 'direction', 'range_mm'},
    'rotary': {'type', 'direction', 'sense', 'range_deg'},
}


@dataclass(frozen=True)
class Axis:
    """One axis of the machine.

    direction : (3,) unit vector, frame ``machine`` at all axes zero
    sense : +1 or -1; the axis turns by ``sense`` times its position (rotary axes)
    lower, upper : range [m] or [rad]
    """

    name: str
    kind: str
    direction: np.ndarray
    sense: int
    lower: float
    upper: float

    @property
    def rotary(self) -> bool:
        """Whether the axis turns."""
        return self.kind == 'rotary'


@dataclass(frozen=True)
class Machine:
    """A five-axis machine (any chain of linear and rotary axes).

    chain : from the table to the tool, with 'bed' where the machine stands on the floor
    tool : (3,) sphere centre in the frame of the last axis on the tool side, all axes zero [m];
        zero where no rotary axis carries the tool (DESIGN: w = (T_B T_C)^-1 (T_Y T_X T_Z) 0)
    text : the YAML it came from
    """

    name: str
    chain: tuple[str, ...]
    axes: dict[str, Axis]
    tool: np.ndarray = field(default_factory=lambda: np.zeros(3))
    text: str = ''

    @property
    def table_side(self) -> tuple[str, ...]:
        """Axes that carry the table, from the bed outwards."""
        return tuple(reversed(self.chain[: self.chain.index(BED)]))

    @property
    def tool_side(self) -> tuple[str, ...]:
        """Axes that carry the tool, from the bed outwards."""
        return self.chain[self.chain.index(BED) + 1 :]

    @property
    def letters(self) -> tuple[str, ...]:
        """All axes: linear ones first, then rotary ones, each in alphabetical order."""
        return tuple(sorted(self.axes, key=lambda name: (self.axes[name].rotary, name)))

    @property
    def rotary(self) -> tuple[str, ...]:
        """Rotary axes from the bed outwards, those of the table side first."""
        return tuple(n for n in self.table_side + self.tool_side if self.axes[n].rotary)

    @property
    def linear(self) -> tuple[str, ...]:
        """Linear axes in alphabetical order."""
        return tuple(n for n in self.letters if not self.axes[n].rotary)


def load_machine(path: Path | str) -> Machine:
    """Read a machine file.

    Raises UserError naming file, key and what is expected.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f'{path}: cannot read the machine file: {error}') from None
    return parse_machine(text, str(path))


def parse_machine(text: str, where: str = 'machine') -> Machine:
    """Parse a machine's YAML; `where` names it in errors.

    Raises UserError naming key and what is expected.
    """
    data = load_yaml(text, where)
    if not isinstance(data, dict):
        raise UserError(f'{where}: expected a mapping with name, chain and axes')
    _only(data, _KEYS, where)
    axes_data = data.get('axes')
    if not isinstance(axes_data, dict) or not axes_data:
        raise UserError(f'{where}: axes: expected a mapping of axis letters')
    if len(axes_data) > MAX_AXES or not all(is_name(str(name)) for name in axes_data):
        raise UserError(f'{where}: axes: expected {MAX_AXES} at most, and letters for their names')
    if not is_name(str(data.get('name', ''))):
        raise UserError(f'{where}: name: expected one that can be printed in a line')
    axes = {str(name): _axis(str(name), spec, where) for name, spec in axes_data.items()}
    chain = data.get('chain')
    if not isinstance(chain, list) or sorted(map(str, chain)) != sorted([*axes, BED]):
        raise UserError(
            f'{where}: chain: expected {BED!r} and every axis of axes once, '
            f'from the table to the tool, got {reprlib.repr(chain)}'
        )
    tool = _vector(data.get('tool_mm', [0, 0, 0]), f'{where}: tool_mm') * 1e-3
    machine = Machine(str(data.get('name', '')), tuple(map(str, chain)), axes, tool, text)
    directions = np.array([axes[name].direction for name in machine.linear])
    if len(directions) != 3 or abs(np.linalg.det(directions)) < 1e-3:
        raise UserError(f'{where}: axes: expected three linear axes that span the space')
    return machine


def _axis(name: str, spec: Any, where: str) -> Axis:
    where = f'{where}: axes: {name}'
    if not isinstance(spec, dict):
        raise UserError(f'{where}: expected a mapping with type and direction')
    kind = spec.get('type')
    if not isinstance(kind, str) or kind not in _AXIS_KEYS:
        raise UserError(f"{where}: type: expected 'linear' or 'rotary', got {reprlib.repr(kind)}")
    _only(spec, _AXIS_KEYS[kind], where)
    direction = _vector(spec.get('direction'), f'{where}: direction')
    length = float(np.linalg.norm(direction))
    if abs(length - 1.0) > 1e-6:
        raise UserError(f'{where}: direction: expected a unit vector, got length {length:.6g}')
    sense = spec.get('sense', 1)
    if sense not in (1, -1) or isinstance(sense, bool):
        raise UserError(f'{where}: sense: expected 1 or -1, got {reprlib.repr(sense)}')
    key, scale = ('range_deg', math.pi / 180) if kind == 'rotary' else ('range_mm', 1e-3)
    limits = spec.get(key, [-math.inf, math.inf])
    if not (isinstance(limits, list) and len(limits) == 2 and all(map(_number, limits))):
        raise UserError(f'{where}: {key}: expected [lower, upper], got {reprlib.repr(limits)}')
    if not limits[0] < limits[1]:
        raise UserError(f'{where}: {key}: the lower end {limits[0]} is not below {limits[1]}')
    return Axis(
        name, kind, direction / length, int(sense), limits[0] * scale, limits[1] * scale
    )


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and value == value


def _vector(value: Any, where: str) -> np.ndarray:
    good = isinstance(value, list) and len(value) == 3 and all(map(_number, value))
    if not good or not all(map(math.isfinite, value)):
        raise UserError(f'{where}: expected three numbers, got {reprlib.repr(value)}')
    return np.array(value, dtype=float)


def _only(data: dict, known: set[str], where: str) -> None:
    for key in data:
        if key not in known:
            found = reprlib.repr(key)
            raise UserError(f'{where}: unknown key {found}, expected one of {sorted(known)}')
