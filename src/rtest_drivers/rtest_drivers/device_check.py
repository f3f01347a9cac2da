"""Tries the devices of a session file: what answers, how often, how evenly, with what."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

from rtest_drivers.cnc.check import CncCheck, check
from rtest_drivers.cnc.linuxcnc import LinuxCnc, load_linuxcnc
from rtest_drivers.cnc.linuxcnc_control import Control, make_moves
from rtest_drivers.cnc.sense import Move, judge
from rtest_drivers.devices import BACKENDS
from rtest_drivers.gauges.check import ChannelCheck, ControllerCheck, check_controllers
from rtest_drivers.gauges.config import load_nest
from rtest_drivers.thermometers.config import load_thermometers
from rtest_estimation.dwell import ROTARY_LETTERS
from rtest_estimation.errors import UserError
from rtest_estimation.records import Status
from rtest_identification.session_file import Device, SessionConfig

SECONDS = 2.0
# A device that gives less than this part of the readings asked for is too slow for its settings.
_FEWEST = 0.8
# And one that leaves more than this part of the questions without a legal answer is disturbed.
_MOST_UNANSWERED = 0.05
# Thermometers are slow: asked so often at least.
_FEWEST_ANSWERS = 3.5
# How far each axis is moved for the check of its sense [m], [rad].
_MOVE = (1e-3, math.radians(1.0))


def check_session_devices(
    config: SessionConfig, moves: bool = False, say: Callable[[str], None] = print
) -> list[str]:
    """Try every device for some seconds and print what it does; returns what is wrong.

    moves : also move each axis of a LinuxCNC by 1 mm or 1 deg and back, and judge its feedback

    Raises UserError for mistakes in the device files.
    """
    wrong = []
    if moves and 'cnc' in config.devices:
        _can_move(config.devices['cnc'])
    for name, device in config.devices.items():
        try_ = {'gauges': _gauges, 'cnc': _cnc, 'thermometers': _thermometers}[name]
        lines, problems = try_(device)
        if name == 'cnc' and moves and not problems:
            more, problems = _moves(device)
            lines += more
        for line in lines:
            say(line)
        wrong += problems
    return wrong


def _gauges(device: Device) -> tuple[list[str], list[str]]:
    found = check_controllers(load_nest(device.file).controllers, SECONDS)
    lines = [
        f'gauges: {device.file}',
        f'  {"port, protocol":36} {"answers":>7} {"rate [1/s]":>12} {"jitter":>8} {"longest":>8} '
        f'{"skew":>8} {"stamp":>8}  unit, range',
    ]
    problems = []
    for one in found:
        limits = 'any'
        if one.limits is not None:
            limits = f'{one.limits[0] * 1e3:g} to {one.limits[1] * 1e3:g} mm'
        lines.append(
            f'  {one.port + ", " + one.protocol:36} {"no" if one.problem else "yes":>7} '
            f'{f"{_number(one.rate, 1)} of {one.wanted_rate:g}":>12} {_ms(one.interval_std):>8} '
            f'{_ms(one.interval_max):>8} {_ms(one.skew_max):>8} {_ms(one.stamp_uncertainty):>8}'
            f'  {one.unit}, {limits}'
        )
        lines += [_channel(channel) for channel in one.channels]
        problems += _controller_problems('gauges', one)
    return lines, problems


def _thermometers(device: Device) -> tuple[list[str], list[str]]:
    """Every line asked some times, and the temperature of each sensor."""
    configs = load_thermometers(device.file)
    seconds = max(SECONDS, *(_FEWEST_ANSWERS / config.rate for config in configs))
    lines = [
        f'thermometers: {device.file}',
        f'  {"port":36} {"answers":>7} {"rate [1/s]":>12} {"stamp":>8}  unit, range',
    ]
    problems = []
    for config, one in zip(configs, check_controllers(configs, seconds), strict=True):
        lines.append(
            f'  {one.port:36} {"no" if one.problem else "yes":>7} '
            f'{f"{_number(one.rate, 2)} of {one.wanted_rate:g}":>12} '
            f'{_ms(one.stamp_uncertainty):>8}  {one.unit}, {one.limits[0]:g} to '
            f'{one.limits[1]:g} degC'
        )
        problems += _controller_problems('thermometers', one)
        for sensor, channel in zip(config.sensors, one.channels, strict=True):
            noise = '' if math.isnan(channel.noise) else f', noise {channel.noise:.3f} K'
            value = '' if math.isnan(channel.last) else f', {channel.last:.2f} degC{noise}'
            lines.append(f'    {sensor}: {_status(channel)}{value}')
            if not one.problem and channel.status is not Status.VALID:
                problems.append(f'thermometers: {one.port}: {sensor}: {_status(channel)}; check '
                                'its wire and range_c')
    return lines, problems


def _channel(one: ChannelCheck) -> str:
    value = '' if math.isnan(one.last) else f', {one.last * 1e3:+.4f} mm'
    noise = '' if math.isnan(one.noise) else f', noise {one.noise * 1e6:.2f} µm'
    return f'    gauge {one.channel}: {_status(one)}{value}{noise}'


def _status(one: ChannelCheck) -> str:
    return 'no reading' if one.status is None else one.status.name.lower().replace('_', ' ')


def _controller_problems(device: str, one: ControllerCheck) -> Iterator[str]:
    where = f'{device}: {one.port}'
    if one.problem:
        yield f'{device}: {one.problem}'
    elif any(channel.status is Status.DEVICE_ERROR for channel in one.channels):
        yield f'{where}: {one.note}'
    elif one.unanswered > max(_MOST_UNANSWERED * one.wanted_rate * SECONDS, 1.0):
        yield (
            f'{where}: {one.unanswered} questions in {SECONDS:g} s without a legal answer '
            f'({one.note or "none came"}); check cable, baud rate and earth'
        )
    elif not one.rate > _FEWEST * one.wanted_rate:
        yield (
            f'{where}: {_number(one.rate, 1)} readings a second instead of {one.wanted_rate:g}; '
            'set a lower rate_hz, or a higher baud rate at both ends'
        )


def _cnc(device: Device) -> tuple[list[str], list[str]]:
    found = check(BACKENDS['cnc'][device.backend](str(device.file)), SECONDS)
    lines = [
        f'cnc: {device.backend}, {device.file}',
        f'  {"answers":>7} {"rate [1/s]":>12} {"jitter":>8} {"longest":>8} {"stamp":>8}',
        f'  {"yes" if found.answers else "no":>7} '
        f'{f"{_number(found.rate, 1)} of {found.wanted_rate:g}":>12} '
        f'{_ms(found.jitter):>8} {_ms(found.gap):>8} {_ms(found.uncertainty):>8}',
    ]
    lines += _positions(found)
    lines += [f'    {key}: {value}' for key, value in (found.told or {}).items() if value]
    problem = found.problem
    if not problem and not found.rate > _FEWEST * found.wanted_rate:
        problem = (
            f'{_number(found.rate, 1)} feedbacks a second instead of {found.wanted_rate:g}; ask '
            'for fewer in the device file, or look what keeps the controller or the network busy'
        )
    return lines, [f'cnc: {problem}'] if problem else []


def _positions(found: CncCheck) -> Iterator[str]:
    for name, value in (found.position or {}).items():
        if name in ROTARY_LETTERS:
            yield f'    {name} {math.degrees(value):12.5f} deg'
        else:
            yield f'    {name} {value * 1e3:12.5f} mm'
    if found.frozen:
        yield '    nothing moved; --moves tells whether these are positions of the axes'


def _moves(device: Device) -> tuple[list[str], list[str]]:
    """Every axis a little and back: sign, unit and name of its feedback."""
    file = load_linuxcnc(str(device.file))
    asked = [Move(axis.name, _MOVE[axis.name in ROTARY_LETTERS]) for axis in file.axes]
    backend, control = LinuxCnc(str(device.file)), Control(file)
    try:
        backend.open()
        control.open()
        findings = judge(file.axes, asked, make_moves(control, backend, asked))
    except (ConnectionError, UserError) as error:
        return [], [f'cnc: {error}']
    finally:
        control.close()
        backend.close()
    return [f'    {one.text}' for one in findings], [
        f'cnc: {device.file}: {one.text}' for one in findings if one.kind != 'right'
    ]


def _can_move(device: Device) -> None:
    """Raise UserError where this program cannot move the machine."""
    if device.backend != 'linuxcnc':
        raise UserError(
            f'--moves: only the backend linuxcnc can be moved, not {device.backend}; move each '
            'axis by hand and watch the topic rtest/cnc/feedback'
        )
    if not load_linuxcnc(str(device.file)).enable_password:
        raise UserError(f'{device.file}: enable_password: missing, --moves needs it')


def _ms(seconds: float) -> str:
    return '' if math.isnan(seconds) else f'{seconds * 1e3:.2f} ms'


def _number(value: float, digits: int) -> str:
    return '-' if math.isnan(value) else f'{value:.{digits}f}'

