"""Which model goes into service: the newly learned base, or the one that serves, whichever says better what came.

Both are asked about the same flights, each tail judged by what the others taught, so neither can have learned its own
answers. The fleet's own lives are taken up by either; only what was learned before any fleet was seen competes.
"""

from dataclasses import dataclass

import numpy as np
import polars as pl

from hdt_core.prognosis.card import Card, Verdict, model_card, promote
from hdt_core.prognosis.metrics import judge, score_prognoses
from hdt_core.prognosis.model import Prognosis, fit_prognosis, out_of_fold


@dataclass(frozen=True, slots=True)
class Served:
    """The model in service from now on, its out-of-fold prognoses, its card with the reason."""

    model: Prognosis
    prognoses: pl.DataFrame
    card: Card


def serve(
    candidate: Prognosis, in_service: Prognosis | None, features: pl.DataFrame, lives: pl.DataFrame, seed: int = 0
) -> Served:
    """Put a base into service, corrected by the fleet's lives, unless the one in service does better.

    Parameters
    ----------
    candidate : Prognosis
        Base as learned by the present code.
    in_service : Prognosis, optional
        Model that gave the last prognoses; None on the first night.
    features, lives : DataFrame
        As for `fit_prognosis`.
    """
    said, scores = _asked(candidate, features, lives, seed)
    base, verdict = candidate, Verdict(True, "no other model is in service")
    if in_service is not None and inputs(in_service) != inputs(candidate):
        verdict = Verdict(True, "the model in service reads other inputs and can't be asked")
    elif in_service is not None:
        verdict = Verdict(True, "the base in service is the one the present code learns")
        if not same_base(candidate, in_service):
            rival, rival_scores = _asked(in_service, features, lives, seed)
            verdict = promote(model_card(candidate, scores), model_card(in_service, rival_scores))
            if not verdict.promoted:
                base, said, scores = in_service, rival, rival_scores
    model = fit_prognosis(features, lives, seed, base)
    card = model_card(model, scores) | {"promoted": verdict.promoted, "promotion": verdict.reason}
    return Served(model, said, card)


def same_base(one: Prognosis, other: Prognosis) -> bool:
    """Whether two models were learned from the same simulated lives: their hazards agree at a few probe points."""
    if one.base_levels != other.base_levels or len(one.hazard) != len(other.hazard):
        return False
    probe = np.linspace(0.0, 1.0, 7)[:, None] * np.ones(inputs(one))
    return all(
        np.allclose(a.predict_proba(probe), b.predict_proba(probe))
        for a, b in zip(one.hazard, other.hazard, strict=True)
    )


def inputs(model: Prognosis) -> int:
    """How many columns the model's hazard reads."""
    return int(model.hazard[0].n_features_in_)


def _asked(
    base: Prognosis, features: pl.DataFrame, lives: pl.DataFrame, seed: int
) -> tuple[pl.DataFrame, dict[str, float]]:
    said = out_of_fold(features, lives, seed, base=base)
    return said, score_prognoses(judge(said, features, lives))
