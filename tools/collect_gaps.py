"""Collect the gap.json files of several sessions into one: ``collect_gaps.py DIR ANSWERS.json``.

DIR is what was given to ``rtest gap BAG... --out DIR``; the answers are {session: gap.json}.
"""

import json
import sys
from pathlib import Path


def main(folder, answers):
    """Write the answers; returns how many there are."""
    found = {
        path.parent.name: json.loads(path.read_text()) for path in Path(folder).glob('*/gap.json')
    }
    text = json.dumps(dict(sorted(found.items())), indent=1)
    Path(answers).parent.mkdir(parents=True, exist_ok=True)
    Path(answers).write_text(text + '\n')
    return len(found)


if __name__ == '__main__':
    print(main(*sys.argv[1:]), 'sessions')
