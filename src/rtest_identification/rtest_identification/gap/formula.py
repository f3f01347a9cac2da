"""Formulas of users: parsed as an expression, checked against a short list, never executed.

A formula is a sum of terms with one parameter each. What it may read are names the caller knows,
among them two that look like more than a name: ``sign(B)`` and ``T.spindle``.
"""

from __future__ import annotations

import ast
import itertools
import math
import re
import warnings
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

import numpy as np

from rtest_estimation.errors import UserError

FUNCTIONS: dict[str, Callable] = {
    'sin': np.sin, 'cos': np.cos, 'tan': np.tan, 'abs': np.abs, 'exp': np.exp, 'sqrt': np.sqrt,
    'log': np.log,
}
CONSTANTS = {'pi': math.pi}
# Names with a meaning of their own: sign(AXIS) and T.SENSOR.
SIGN, TEMPERATURE = 'sign', 'T'
MAX_LENGTH, MAX_NODES, MAX_DEPTH, MAX_PARENTHESES, MAX_POWER = 500, 300, 60, 20, 8
# An effect is a displacement per unit of its parameters: nothing sensible comes near [SI].
LARGEST = 1e12
_BINARY: dict[type, Callable] = {
    ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.divide,
    ast.Pow: np.power,
}
# What a formula is not written with never gets to the parser. ASCII only: the parser takes a sine
# in mathematical letters for sin.
_STRANGE = re.compile(r'[^A-Za-z0-9_ .+*/()-]')
_EXPECTED = (
    f'expected numbers, + - * / **, parentheses, {", ".join(sorted(FUNCTIONS))} and known names'
)


@dataclass(frozen=True)
class Formula:
    """A checked formula.

    text : as written; names : parameters and variables it reads
    where : file, effect and formula, for errors
    """

    text: str
    names: frozenset[str]
    where: str
    tree: ast.expr

    def coefficient(
        self, name: str, linear: Collection[str], values: Mapping[str, np.ndarray | float]
    ) -> np.ndarray:
        """What the formula is per unit of the parameter `name`, one value per row of `values`.

        Exact, as the formula was found linear in the parameters `linear`.
        Raises UserError where it is not a number, or no sensible one.
        """
        result = self._per_unit(name, linear, values)
        # Not <= is also true of NaN.
        bad = ~(np.abs(result) <= LARGEST)
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            at = ', '.join(
                f'{n} = {np.broadcast_to(values[n], result.shape)[row]:.6g}'
                for n in sorted(self.names & set(values))
            )
            raise UserError(
                f'{self.where}: the factor of {name} is {result[row]:.3g}'
                f'{" where " if at else ""}{at} (SI units); expected finite numbers below '
                f'{LARGEST:.0e} at every pose'
            )
        return result

    def changes_with(
        self, name: str, linear: Collection[str], values: Mapping[str, np.ndarray | float]
    ) -> bool:
        """Whether the parameter `name` matters in any row of `values`; what is no number does."""
        return bool(np.any(self._per_unit(name, linear, values) != 0.0))

    def _per_unit(
        self, name: str, linear: Collection[str], values: Mapping[str, np.ndarray | float]
    ) -> np.ndarray:
        units = {other: 1.0 if other == name else 0.0 for other in linear}
        with np.errstate(all='ignore'):
            return np.atleast_1d(_value(self.tree, {**values, **units}))


def parse_formula(
    text: object, where: str, linear: Collection[str], known: Collection[str]
) -> Formula:
    """Parse and check a formula.

    where : file and effect, and what the formula is for
    linear : parameters, in which it must be linear without a rest; known : all other names

    Raises UserError naming formula and what is expected.
    """
    if not isinstance(text, str):
        raise UserError(f'{where}: expected a formula')
    text = ' '.join(text.split())
    where = f'{where} = {shown(text)}'
    if len(text) > MAX_LENGTH:
        raise UserError(f'{where}: {len(text)} characters, expected {MAX_LENGTH} at most')
    strange = _STRANGE.search(text)
    if strange is not None:
        raise UserError(f'{where}: {shown(strange[0])} is not allowed, {_EXPECTED}')
    if _depth(text) > MAX_PARENTHESES:
        raise UserError(f'{where}: expected {MAX_PARENTHESES} levels of parentheses at most')
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')
            tree = ast.parse(text, mode='eval').body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        reason = getattr(error, 'msg', None) or type(error).__name__
        raise UserError(f'{where}: not a formula ({reason}); {_EXPECTED}') from None
    check = _Check(where, frozenset(linear), frozenset(known))
    if not check.degree(tree, 0):
        raise UserError(
            f'{where}: no parameter in it, expected one of {", ".join(linear)} in every term'
        )
    return Formula(text, frozenset(check.names), where, tree)


def shown(text: str, length: int = 60) -> str:
    """A user's text in an error: on one line, in ASCII, not too long."""
    return ascii(text if len(text) <= length else text[: length - 3] + '...')


def _depth(text: str) -> int:
    """Levels of parentheses."""
    steps = ({'(': 1, ')': -1}.get(character, 0) for character in text)
    return max(itertools.accumulate(steps), default=0)


def _token(node: ast.expr) -> str | None:
    """The name that a node stands for: ``C``, ``sign(B)``, ``T.spindle``; None for others."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
        return f'{TEMPERATURE}.{node.attr}' if node.value.id == TEMPERATURE else None
    if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name)):
        return None
    if node.func.id == SIGN and len(node.args) == 1 and isinstance(node.args[0], ast.Name):
        return f'{SIGN}({node.args[0].id})' if not node.keywords else None
    return None


def _power(node: ast.expr) -> float | None:
    """An exponent: a number, with or without a sign."""
    sign = 1.0
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        sign, node = -1.0, node.operand
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        return sign * node.value if abs(node.value) <= MAX_POWER else None
    return None


class _Check:
    """Walk over everything in a formula; what is not expected ends it."""

    def __init__(self, where: str, linear: frozenset[str], known: frozenset[str]) -> None:
        self.where, self.linear, self.known = where, linear, known
        self.names: set[str] = set()
        self.nodes = 0

    def degree(self, node: ast.expr, depth: int) -> int:
        """0 for a part without a parameter, 1 for one that is in proportion to parameters."""
        self.nodes += 1
        if self.nodes > MAX_NODES or depth > MAX_DEPTH:
            raise UserError(
                f'{self.where}: too long or too deep, expected {MAX_NODES} parts and {MAX_DEPTH} '
                'levels at most'
            )
        token = _token(node)
        if token is not None:
            return self.name(token)
        if isinstance(node, ast.Constant):
            return self.number(node.value)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
            return self.degree(node.operand, depth + 1)
        if isinstance(node, ast.BinOp) and type(node.op) in _BINARY:
            return self.binary(node, depth + 1)
        if (
            isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
            and node.func.id in FUNCTIONS and len(node.args) == 1 and not node.keywords
        ):
            if self.degree(node.args[0], depth + 1):
                self.bent(f'a parameter inside {node.func.id}()')
            return 0
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            called = node.func.id
            if called == SIGN or called in FUNCTIONS:
                of = 'the name of an axis' if called == SIGN else 'one value'
                raise UserError(f'{self.where}: expected {called}() of {of}')
            raise UserError(f'{self.where}: unknown function {shown(called)}, {_EXPECTED}')
        kind = type(getattr(node, 'op', node)).__name__
        raise UserError(f'{self.where}: {kind} is not allowed, {_EXPECTED}')

    def name(self, token: str) -> int:
        if token in CONSTANTS:
            return 0
        if token not in self.linear and token not in self.known:
            if token.startswith(f'{TEMPERATURE}.'):
                sensors = sorted(n for n in self.known if n.startswith(f'{TEMPERATURE}.'))
                have = f'has {", ".join(sensors)}' if sensors else 'has no temperatures'
                raise UserError(f'{self.where}: {shown(token)}: this session {have}')
            names = ', '.join([*sorted(self.linear), *sorted(self.known - self.linear)])
            raise UserError(f'{self.where}: unknown name {shown(token)}, expected one of {names}')
        self.names.add(token)
        return int(token in self.linear)

    def number(self, value: object) -> int:
        # Not isinstance: True is an int. The bound comes first: 1e400 in digits is no float.
        if type(value) not in (int, float) or not abs(value) <= LARGEST:
            raise UserError(
                f'{self.where}: {type(value).__name__} {shown(str(value)[:40])} is not allowed, '
                f'expected a number up to {LARGEST:.0e}'
            )
        return 0

    def binary(self, node: ast.BinOp, depth: int) -> int:
        left, right = self.degree(node.left, depth), self.degree(node.right, depth)
        if isinstance(node.op, ast.Pow):
            if _power(node.right) is None:
                raise UserError(
                    f'{self.where}: expected a number between -{MAX_POWER} and {MAX_POWER} '
                    'after **'
                )
            if left:
                self.bent('a power of a parameter')
            return 0
        if isinstance(node.op, ast.Mult):
            if left and right:
                self.bent('a product of parameters')
            return left + right
        if isinstance(node.op, ast.Div):
            if right:
                self.bent('a division by a parameter')
            return left
        if left != right:
            self.bent('a term without a parameter beside terms with one')
        return left

    def bent(self, what: str) -> None:
        names = ', '.join(sorted(self.linear))
        raise UserError(
            f'{self.where}: not linear in {names}: {what}; expected a sum of terms with one '
            'parameter each (a value that enters otherwise belongs under shape)'
        )


def _value(node: ast.expr, values: Mapping[str, np.ndarray | float]) -> np.ndarray | np.float64:
    """Value of a checked expression; in floating point throughout, so that it ends at once."""
    token = _token(node)
    if token is not None:
        return np.float64(CONSTANTS[token]) if token in CONSTANTS else np.asarray(values[token])
    if isinstance(node, ast.Constant):
        return np.float64(node.value)
    if isinstance(node, ast.UnaryOp):
        value = _value(node.operand, values)
        return -value if isinstance(node.op, ast.USub) else value
    if isinstance(node, ast.BinOp):
        return _BINARY[type(node.op)](_value(node.left, values), _value(node.right, values))
    return FUNCTIONS[node.func.id](_value(node.args[0], values))
