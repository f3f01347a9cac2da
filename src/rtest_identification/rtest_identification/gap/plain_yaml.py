"""YAML of strangers: mappings, lists and text, nothing that could grow or run.

No tags, no anchors, no two keys alike, a bounded size and depth. Every scalar stays text, so that
no number is too long to convert and no date is invalid.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from rtest_estimation.errors import UserError

MAX_BYTES = 65536
MAX_DEPTH = 8


def read_plain(path: Path | str) -> Any:
    """What a file holds: dicts and lists of text.

    Raises UserError naming the file and what is expected.
    """
    try:
        with Path(path).open('rb') as file:
            content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise UserError(f'{path}: expected a file of {MAX_BYTES} bytes at most')
        text = content.decode('utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f'{path}: cannot read the file: {error}') from None
    try:
        events = yaml.parse(text, Loader=yaml.SafeLoader)
        nodes = (e for e in events if not isinstance(e, _FRAME))
        first = next(nodes, None)
        if first is None:
            raise UserError(f'{path}: nothing in it')
        data = _node(nodes, first, str(path), 0)
        if next(nodes, None) is not None:
            raise UserError(f'{path}: expected one YAML document')
    except UserError:
        raise
    # The scanner lets ValueError and OverflowError of escapes and directives through.
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        reason = ' '.join(str(error).split())[:200]
        raise UserError(f'{path}: not valid YAML: {ascii(reason)[1:-1]}') from None
    return data


_FRAME = (
    yaml.StreamStartEvent, yaml.StreamEndEvent, yaml.DocumentStartEvent, yaml.DocumentEndEvent,
)


def _node(events: Iterator[yaml.Event], event: yaml.Event, path: str, depth: int) -> Any:
    where = f'{path}: line {event.start_mark.line + 1}'
    if isinstance(event, yaml.AliasEvent) or event.anchor is not None:
        raise UserError(f'{where}: expected no anchors and aliases (& and *); quote a formula')
    if event.tag is not None:
        raise UserError(f'{where}: expected no tags (!)')
    if isinstance(event, yaml.ScalarEvent):
        return event.value
    if depth >= MAX_DEPTH:
        raise UserError(f'{where}: expected {MAX_DEPTH} levels at most')
    if isinstance(event, yaml.SequenceStartEvent):
        items = []
        while not isinstance(event := next(events), yaml.SequenceEndEvent):
            items.append(_node(events, event, path, depth + 1))
        return items
    found: dict[str, Any] = {}
    while not isinstance(event := next(events), yaml.MappingEndEvent):
        key = _node(events, event, path, depth + 1)
        if not isinstance(key, str):
            raise UserError(f'{where}: expected text as key of a mapping')
        if key in found:
            raise UserError(
                f'{path}: line {event.start_mark.line + 1}: the key {ascii(key)[:60]} is there '
                'twice'
            )
        found[key] = _node(events, next(events), path, depth + 1)
    return found
