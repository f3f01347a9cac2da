"""Measure a simulated machine and compare the result with what it was given.

Runs the four-setup cycle of the thesis on a simulated cell (config/demo.yaml and
config/cell_demo.yaml), identifies the recording, and prints truth and result side by side.
"""

from __future__ import annotations

import argparse
import subprocess
import sys

from rtest_drivers.commands.session import add_run_arguments, evaluate, measure, shown
from rtest_drivers.config import config_path
from rtest_drivers.graph import GraphSettings, session_name

HELP = 'measure a simulated machine and check the result against the truth'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `rtest demo`."""
    add_run_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Session, identification, comparison; 1 where a value is not within its uncertainty."""
    truth = config_path('cell_demo.yaml')
    settings = GraphSettings(
        config=config_path('demo.yaml'),
        session=session_name('demo'),
        out=arguments.out.absolute(),
        simulate=truth,
        rate=arguments.rate,
    )
    settings, complete = measure(settings, arguments.domain)
    result = evaluate(settings, complete)
    # In a process of its own: the truth is known to nothing that estimates.
    check = [sys.executable, '-m', 'rtest_drivers.sim.check', str(truth), str(result)]
    status = subprocess.run(check, check=False).returncode
    print(f'recording {shown(settings.recording)}, report {shown(result.parent / "report.html")}')
    return status
