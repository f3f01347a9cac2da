"""The option --topic: which topic of a recording is meant, where several could be."""

from __future__ import annotations

import argparse
from collections.abc import Iterable


def add_topic_argument(parser: argparse.ArgumentParser) -> None:
    """The option itself."""
    parser.add_argument('--topic', action='append', default=[], metavar='ROLE=NAME',
                        help='where a recording has several topics of a type: the one that is '
                        'meant, for example gauges=/cell_2/rtest/gauges; may be given often')


def chosen_topics(chosen: Iterable[str]) -> dict[str, str]:
    """Role to topic name from texts ROLE=NAME; raises UserError for what is neither."""
    from rtest_estimation.errors import UserError
    from rtest_estimation.recording import ROLES

    topics = dict(text.partition('=')[::2] for text in chosen)
    for role, name in topics.items():
        if role not in ROLES or not name.startswith('/'):
            raise UserError(
                f'--topic {role}={name}: expected ROLE=/NAME with a role of {", ".join(ROLES)}'
            )
    return topics
