"""The command `rtest`: parses arguments, calls one command, tells mistakes in one line."""

from __future__ import annotations

import argparse
import io
import os
import sys
from collections.abc import Sequence
from typing import NoReturn

from rtest_drivers.commands import (
    ask,
    check,
    correct,
    demo,
    dynamic,
    frustum,
    gap,
    identify,
    info,
    laser,
    plan,
    replay,
    session,
    thermal,
    topics,
    view,
)
from rtest_drivers.graph import ONE_THREAD
from rtest_drivers.runner import NodeFailed, Stopped
from rtest_estimation.errors import UserError

COMMANDS = (
    session, check, view, ask, topics, demo, plan, identify, gap, thermal, dynamic, frustum,
    correct, laser, replay, info,
)
EXIT_FAILED, EXIT_USER, EXIT_INTERRUPTED, EXIT_PIPE = 1, 2, 130, 141


class _Parser(argparse.ArgumentParser):
    """Tells a wrong argument in one line, as every other mistake."""

    def error(self, message: str) -> NoReturn:
        raise UserError(f'{message}; see `{self.prog} --help`')


def parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    top = _Parser(
        prog='rtest',
        description='R-test: geometric errors of the rotary axes of five-axis machine tools.',
        epilog='`rtest COMMAND --help` explains a command. Exit status: 0 when all went well, 1 '
        'when something failed, 2 for a mistake in what was given.',
    )
    commands = top.add_subparsers(
        dest='command', metavar='COMMAND', required=True, parser_class=_Parser
    )
    for module in COMMANDS:
        name = module.__name__.rpartition('.')[2]
        one = commands.add_parser(
            name,
            help=module.HELP,
            description=module.__doc__,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        module.add_arguments(one)
        one.set_defaults(run=module.run)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    for name, value in ONE_THREAD.items():
        # Before numpy is imported; the nodes inherit it.
        os.environ.setdefault(name, value)
    _print_on_any_terminal()
    try:
        chosen = parser().parse_args(arguments)
        status = chosen.run(chosen)
        sys.stdout.flush()
        return status
    except UserError as error:
        return _tell(' '.join(str(error).split()), EXIT_USER)
    except NodeFailed as error:
        return _tell(str(error), EXIT_FAILED)
    except Stopped as error:
        return _tell(str(error), 128 + error.signum)
    except KeyboardInterrupt:
        return _tell('interrupted', EXIT_INTERRUPTED)
    except BrokenPipeError:
        # Whoever read the output has read enough; nothing may be written to it any more.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_PIPE


def _print_on_any_terminal() -> None:
    """A letter that the terminal does not know is shown as ``?``, here and in what is started."""
    encoding = os.environ.get('PYTHONIOENCODING', '').partition(':')[0]
    os.environ['PYTHONIOENCODING'] = f'{encoding}:replace'
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors='replace')


def _tell(text: str, status: int) -> int:
    print(f'rtest: {text}', file=sys.stderr)
    return status


if __name__ == '__main__':
    sys.exit(main())
