"""Other ways of choosing effects, on the sessions of gap_blind.py: what they get wrong.

    pip install "scikit-learn>=1.7"
    python bench/gap_baselines.py [--sessions N] [--processes P]

All work on the same whitened rows and the same library: forward selection by AIC and by BIC,
orthogonal matching pursuit and the lasso with cross-validation, and the search of the model gap
with signatures that are not projected beside the base model. A name is right when exactly the keys
that were hidden, or effects of the same signature (cosine above 0.98), come out.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import gap_blind
import numpy as np
from gap_blind import Blind, draw, percent
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import LassoCV, OrthogonalMatchingPursuitCV

from rtest_identification.gap.effects import library
from rtest_identification.gap.projection import Candidate, Projection
from rtest_identification.gap.rows import Rows, make_rows, nest_spread
from rtest_identification.gap.search import search
from rtest_identification.observations import stack

ROWS = ('no effect, clean', 'no effect, outliers', 'no effect, noisy ends',
        'one effect, delta 8', 'one effect, delta 20', 'two effects, delta 8-40')
ALIKE = 0.98
_MOST = 6


def rows_of(session: Blind) -> Rows:
    """The rows of a session, as the model gap sees them."""
    observations = stack(session.machine, session.cycles)
    start = min(cycle.plan.stamp for cycle in session.cycles)
    return make_rows(
        observations, start, session.directions, spread=nest_spread(session.cycles)
    )


def forward(projection: Projection, penalty: float) -> list[Candidate]:
    """Add the best candidate as long as n log(rest) + penalty * parameters falls."""
    chosen: list[int] = []
    n = projection.freedom

    def criterion(which: Sequence[int]) -> float:
        rest = projection.total - projection.gain(which)
        return n * np.log(rest / n) + penalty * sum(projection.candidates[i].count for i in which)

    while len(chosen) < _MOST:
        free = [i for i in range(projection.offered) if i not in chosen]
        best = min(free, key=lambda i: criterion([*chosen, i]))
        if criterion([*chosen, best]) >= criterion(chosen):
            break
        chosen.append(best)
    return [projection.candidates[i] for i in chosen]


def sparse(model: Callable, projection: Projection) -> list[Candidate]:
    """Candidates of which a sparse regression keeps a column."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', ConvergenceWarning)
        fitted = model.fit(projection.all, projection.y)
    used = np.flatnonzero(np.abs(fitted.coef_) > 1e-9)
    return [c for c, place in zip(projection.candidates, projection.slices, strict=True)
            if np.isin(used, np.arange(place.start, place.stop)).any()]


class Unprojected(Projection):
    """Signatures as they are, compared with what the base model leaves."""

    def project(self, effect: object, shape: tuple[float, ...]) -> Candidate | None:
        """The whole signature."""
        base, self.base = self.base, self.base[:, :0]
        candidate = super().project(effect, shape)
        self.base = base
        return candidate


METHODS: dict[str, Callable[[Rows, Projection], list[Candidate]]] = {
    'model gap': lambda rows, p: [n.candidate for n in search(p).named],
    'AIC': lambda rows, p: forward(p, 2.0),
    'BIC': lambda rows, p: forward(p, np.log(p.freedom)),
    'OMP': lambda rows, p: sparse(OrthogonalMatchingPursuitCV(cv=5, max_iter=_MOST), p),
    'lasso': lambda rows, p: sparse(LassoCV(cv=5, alphas=30), p),
    'no projection': lambda rows, p: [
        n.candidate for n in search(Unprojected(rows, library(rows.scene))).named
    ],
}


def right(session: Blind, found: list[Candidate], projection: Projection) -> bool:
    """Whether what was found is what was hidden, or looks the same."""
    if len(found) != len(session.hidden):
        return False
    keys = {c.effect.key: c for c in found}
    left = []
    for effect, _ in session.hidden:
        if keys.pop(effect.key, None) is None:
            left.append(effect.key)
    for key in left:
        own = [c.basis for c in projection.candidates if c.effect.key == key]
        alike = [
            other for other, c in keys.items()
            if any(np.linalg.norm(b.T @ c.basis, 2) > ALIKE for b in own)
        ]
        if not alike:
            return False
        keys.pop(alike[0])
    return True


def one(row: str, number: int) -> dict[str, tuple[bool, bool]]:
    """By method: whether anything was found, and whether it is right."""
    session = draw(row, number)
    rows = rows_of(session)
    projection = Projection(rows, library(rows.scene))
    scores = {}
    for name, method in METHODS.items():
        found = method(rows, Projection(rows, library(rows.scene)))
        scores[name] = (bool(found), right(session, found, projection))
    return scores


def main() -> None:
    """Print a table: a line for each kind of session and method."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--sessions', type=int, default=40)
    parser.add_argument('--processes', type=int, default=2)
    args = parser.parse_args()
    with ProcessPoolExecutor(args.processes) as pool:
        for row in ROWS:
            assert row in gap_blind.ROWS
            scores = list(pool.map(partial(one, row), range(args.sessions)))
            for name in METHODS:
                found, good = np.sum([s[name] for s in scores], axis=0)
                print(f'{row:28}{name:16}found {percent(int(found), len(scores))}'
                      f'  right {percent(int(good), len(scores))}', flush=True)


if __name__ == '__main__':
    main()
