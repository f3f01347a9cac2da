"""Find where model and measurement disagree, name the missing effect, add it, prove it.

BAG is a recording, as for `rtest identify`. gap.json, model.yaml (the model with what was found)
and gap_report.html are written to the folder `gap` beside the recording, or to --out.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rtest_drivers.commands.identify import folders, recording_name
from rtest_drivers.topics import add_topic_argument, chosen_topics

HELP = 'find the effect that a model lacks'
OUTPUT = 'gap'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `rtest gap`."""
    parser.add_argument('bags', type=Path, nargs='+', metavar='BAG', help='recorded session')
    parser.add_argument('--model', type=Path, metavar='FILE',
                        help='what is known of the machine: a model.yaml of an earlier session')
    parser.add_argument('--effects', type=Path, metavar='FILE',
                        help='effects of your own, beside the library')
    parser.add_argument('--machine', type=Path, metavar='FILE',
                        help='machine file to use instead of the recorded one')
    add_topic_argument(parser)
    parser.add_argument('--no-report', action='store_true',
                        help='write gap.json and model.yaml only')
    parser.add_argument('--out', type=Path, metavar='DIR',
                        help='write to DIR, or to DIR/NAME of each of several recordings')


def run(arguments: argparse.Namespace) -> int:
    """Run the workflow on every recording."""
    from rtest_identification.gap.model_file import load_model

    model = load_model(arguments.model) if arguments.model else None
    for bag, out in folders(arguments.bags, arguments.out, OUTPUT):
        _one(bag, model, arguments, out)
    return 0


def _one(bag: Path, model: object, arguments: argparse.Namespace, out: Path) -> None:
    from rtest_drivers.commands.session import shown
    from rtest_drivers.folders import check_folder, writing
    from rtest_identification.gap import output
    from rtest_identification.gap.model_file import save_model
    from rtest_identification.gap.offline import gap_recording
    from rtest_identification.gap.report import write_report

    check_folder(out)
    found = gap_recording(
        bag, model, arguments.effects, arguments.machine,
        lambda line: print(f'  {line}', flush=True), chosen_topics(arguments.topic),
    )
    for warning in found.warnings:
        print(f'  warning: {warning}')
    for line in found.confusions:
        print(f'  {line}')
    with writing(out):
        save_model(found.model, out / 'model.yaml')
        path = output.write(found.session, found.result, out, 'model.yaml')
        if not arguments.no_report:
            write_report(found, out)
    for line in output.lines(found.result):
        print(f'  {line}')
    print(f'{recording_name(bag)}: {output.summary(found.result)} -> {shown(path.absolute())}',
          flush=True)
