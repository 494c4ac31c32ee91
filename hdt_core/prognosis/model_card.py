"""Serialise a model's base and fits, describe it in a card, and decide on promotion."""

from dataclasses import asdict, dataclass, replace
from typing import Any

from hdt_core.components import Limit
from hdt_core.margin.margin import MessageRule
from hdt_core.prognosis.feature_rows import FailureRule
from hdt_core.prognosis.model import ComponentFit, Fits, Fold, Prognosis
from hdt_core.prognosis.recalibrate import HazardCorrection

Card = dict[str, Any]


def to_parts(base: Prognosis) -> dict[str, Any]:
    """Return the base as a dict of scikit-learn objects and numbers, which skops stores without custom types."""
    return {"hazard": list(base.hazard), "base_levels": list(base.base_levels)}


def from_parts(parts: dict[str, Any]) -> Prognosis:
    """Build a base from the result of `to_parts`."""
    low, middle, high = parts["base_levels"]
    return Prognosis(tuple(parts["hazard"]), (low, middle, high))


def fits_to_json(model: Prognosis) -> dict[str, Any]:
    """Return a model's fits to a fleet as JSON types."""
    folds = [{"held": list(fold.tails), "fits": _plain(fold.fits)} for fold in model.folds]
    return {"version": model.version, "fits": _plain(model.fits), "folds": folds}


def with_fits(base: Prognosis, fields: dict[str, Any]) -> Prognosis:
    """Return a base with the fits of `fits_to_json`."""
    folds = tuple(Fold(tuple(fold["held"]), _fits(fold["fits"])) for fold in fields["folds"])
    return replace(base, fits=_fits(fields["fits"]), version=fields["version"], folds=folds)


def _plain(fits: Fits) -> dict[str, Any]:
    return {component: asdict(fit) for component, fit in fits.items()}


def _fits(plain: dict[str, Any]) -> Fits:
    return {
        component: ComponentFit(
            _rule(fit["rule"] if "rule" in fit else fit["says"]),  # its name in homes made until November 2026
            HazardCorrection(tuple(fit["correction"]["weights"])),
            (fit["levels"][0], fit["levels"][1], fit["levels"][2]),
            fit["failures"],
            fit["lives"],
        )
        for component, fit in plain.items()
    }


def _rule(plain: dict[str, Any]) -> FailureRule:
    return Limit(**plain) if "mean" in plain else {name: MessageRule(**rule) for name, rule in plain.items()}


def _rule_to_dict(rule: FailureRule) -> dict[str, Any]:
    return asdict(rule) if isinstance(rule, Limit) else {name: asdict(rule) for name, rule in rule.items()}


def model_card(model: Prognosis, scores: dict[str, float] | None = None) -> Card:
    """Describe a model: its outputs, training data and out-of-fold scores.

    Parameters
    ----------
    model : Prognosis
        Fitted model.
    scores : dict, optional
        Out-of-fold scores, as from `metrics.score_prognoses`.
    """
    return {
        "model_version": model.version,
        "says": (
            "rul_flights, rul_low, rul_high: 50, 5 and 95 % points of the flights left until the message, without any "
            "condition; 300 stands for 300 or more; p_event_50: probability of the message within 50 flights"
        ),
        "learned_from": "simulated lives (base); the fleet's own failed and censored lives (rule, hazard, interval)",
        "failures": {component: fit.failures for component, fit in model.fits.items()},
        "lives": {component: fit.lives for component, fit in model.fits.items()},
        "message": {component: _rule_to_dict(fit.rule) for component, fit in model.fits.items()},
        "not_for": "removals for other reasons than the message; components without a health track",
        "scores": scores or {},
    }


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether a model goes into service, and why."""

    promoted: bool
    reason: str


def promote(candidate: Card, in_service: Card | None, tolerance: float = 0.02) -> Verdict:
    """Decide whether a model replaces the one in service: only if it scores no worse.

    Both cards must have been scored on the same flights; the figures compared are the interval score and the Brier
    score, which can't be improved by hedging. A rise of more than `tolerance` (a share) in either is worse.
    """
    if in_service is None or not in_service.get("scores"):
        return Verdict(True, "no scored model is in service")
    for name in ("interval_score_flights", "brier"):
        candidate_score, service_score = candidate["scores"].get(name), in_service["scores"].get(name)
        if service_score is None:
            continue
        if candidate_score is None:
            return Verdict(False, f"{name} of the candidate is unknown, {service_score:.4g} is in service")
        if candidate_score > service_score * (1.0 + tolerance):
            return Verdict(False, f"{name} is {candidate_score:.4g}, worse than {service_score:.4g} in service")
    return Verdict(True, "no score is worse than in service")
