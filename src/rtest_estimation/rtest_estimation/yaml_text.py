"""YAML that somebody else has written: plain values only, nothing that grows or runs.

What a recording carries (the machine, metadata.yaml) may come from anywhere, and a few hundred
bytes of aliases unfold to gigabytes. Refused are anchors and aliases, tags that make anything but
plain values, two keys alike, numbers of more than 64 bits, and what is too large or too deep.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from rtest_estimation.errors import UserError

# Bytes; a machine or session file has a few thousand.
MAX_SIZE = 1024 * 1024
MAX_DEPTH = 20
MAX_BITS = 64


def read_yaml(path: Path | str, what: str) -> Any:
    """Contents of a YAML file; see `load_yaml`.

    what : names the file in errors, such as 'the session file'

    Raises UserError also where the file cannot be read.
    """
    try:
        with Path(path).open('rb') as file:
            text = file.read(MAX_SIZE + 1).decode('utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f'{path}: cannot read {what}: {error}') from None
    return load_yaml(text, str(path))


def load_yaml(text: str, where: str) -> Any:
    """Value of a YAML text.

    where : begins the sentence of the UserError raised for what is refused or no YAML
    """
    if len(text) > MAX_SIZE:
        raise UserError(f'{where}: larger than {MAX_SIZE} bytes, expected a file for people')
    try:
        return _Loader(text).get_single_data()
    # The scanner and the constructors let these through for escapes, dates and deep nesting.
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        reason = ' '.join(str(error).split())[:200]
        raise UserError(f'{where}: not valid YAML: {reason}') from None


class _Loader(yaml.SafeLoader):
    """Makes nothing but plain values, each of them once."""

    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.peek_event()
        if isinstance(event, yaml.AliasEvent) or event.anchor is not None:
            raise yaml.composer.ComposerError(
                None, None, 'expected no anchors and aliases (& and *)', event.start_mark
            )
        if self.depth >= MAX_DEPTH:
            raise yaml.composer.ComposerError(
                None, None, f'expected {MAX_DEPTH} levels at most', event.start_mark
            )
        self.depth += 1
        try:
            return super().compose_node(parent, index)
        finally:
            self.depth -= 1

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        mapping = super().construct_mapping(node, deep)
        if len(mapping) != len(node.value):
            raise yaml.constructor.ConstructorError(
                None, None, 'a key is there twice', node.start_mark
            )
        return mapping

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        value = super().construct_yaml_int(node)
        if value.bit_length() > MAX_BITS:
            raise yaml.constructor.ConstructorError(
                None, None, f'expected numbers of {MAX_BITS} bits at most', node.start_mark
            )
        return value


_Loader.add_constructor('tag:yaml.org,2002:int', _Loader.construct_yaml_int)
