"""Learning across operators that share no flights: `python -m benchmarks.federated [--fleets N] [--write]`.

One type flown by five operators, each in a climate of its own, through the whole chain. What lives teach (when the
aircraft speaks, the correction of the simulated base, the levels told: ten numbers for an exchanger, eight for a
compressor) is compared when it is taught by an operator's own lives, by everybody's in one place, and by everybody's at
home with only the numbers, or only the prognoses, put together. The same without the simulated base, where each
operator fits a hazard of its own. Every tail is judged by what other tails taught; then an operator by what the other
operators taught. `--write` puts the tables into docs/prognosis.md.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl

from benchmarks.contestants import Asked, Learner, rows_of
from benchmarks.fleets import Frames, flown
from benchmarks.harness import arguments, markdown, put
from hdt_core.margin.margin import PRIOR_RULE, MessageRule
from hdt_core.prognosis.component_limits import PRIORS, Limit
from hdt_core.prognosis.feature_rows import PRIOR_RULES, FailureRule
from hdt_core.prognosis.metrics import bootstrap, judge, score_prognoses
from hdt_core.prognosis.model import (
    ComponentFit,
    Fits,
    Prognosis,
    fit_prognosis,
    named,
    predict_prognosis,
    untaught_levels,
)
from hdt_core.prognosis.recalibrate import HazardCorrection
from hdt_core.prognosis.unit_lives import episodes
from hdt_core.simulate.design import FleetSettings
from pipelines.learned import shipped_base

PAGE = Path(__file__).parents[1] / "docs" / "prognosis.md"
FIRST_SEED = 9500
SIZE = FleetSettings(operators=5, tails=3, flights=800, cpl_share=0.0)
SAID = ("rul_flights", "rul_low", "rul_high", "p_event_50")
KEY = ["tail", "flight_id", "pack", "component"]
Part = tuple[pl.DataFrame, pl.DataFrame]
"""Features and lives of some tails."""


def averaged(fits: list[Fits]) -> Fits:
    """One fit of many, each number weighted by the failures that taught it; when the aircraft speaks, by precision."""
    return {c: _averaged([f[c] for f in fits]) for c in PRIOR_RULES}


def _averaged(fits: list[ComponentFit]) -> ComponentFit:
    weight = np.array([max(f.failures, 1e-9) for f in fits])
    weights = np.average([f.correction.weights for f in fits], axis=0, weights=weight)
    low, middle, high = (float(v) for v in np.average([f.levels for f in fits], axis=0, weights=weight))
    return ComponentFit(
        _averaged_rule([f.rule for f in fits]),
        HazardCorrection(tuple(float(w) for w in weights)),
        (low, middle, high),
        sum(f.failures for f in fits),
        sum(f.lives for f in fits),
    )


def _averaged_rule(rule: list[FailureRule]) -> FailureRule:
    """One limit of many; or one rule, for everybody: a type's monitors are alike here."""
    limits = [s for s in rule if isinstance(s, Limit)]
    if limits:
        prior = PRIORS["CC"]
        mean, sd = by_precision([(x.mean, x.sd) for x in limits], (prior.mean, prior.sd))
        return Limit(mean, sd, prior.unit_sd)
    # an operator's own rule is surer than what it would say of a stranger
    rules = [min(s.values(), key=lambda r: r.excess_sd_k) for s in rule if not isinstance(s, Limit)]
    return {"": averaged_rule(rules)}


def averaged_rule(rules: list[MessageRule]) -> MessageRule:
    """Share and persistence that most messages speak for; the excess of those who say the same of these."""
    messages: dict[tuple[float, int], int] = {(PRIOR_RULE.share, PRIOR_RULE.of): 0}
    for r in rules:
        messages[r.share, r.of] = messages.get((r.share, r.of), 0) + r.messages
    share, of = max(messages, key=lambda kind: messages[kind])
    alike = [(r.excess_k, r.excess_sd_k) for r in rules if (r.share, r.of) == (share, of)]
    mean, sd = by_precision(alike, (PRIOR_RULE.excess_k, PRIOR_RULE.excess_sd_k))
    return MessageRule(share, mean, sd, of, sum(r.messages for r in rules))


def by_precision(posteriors: list[tuple[float, float]], prior: tuple[float, float]) -> tuple[float, float]:
    """Mean and sd of many posteriors put together. Each holds the prior: it is taken out of all but one."""
    own = [sd**-2.0 - prior[1] ** -2.0 for _, sd in posteriors]
    moved = [mean * sd**-2.0 - prior[0] * prior[1] ** -2.0 for mean, sd in posteriors]
    # one that is no surer than the prior has nothing to add
    told = [(p, m) for p, m in zip(own, moved, strict=True) if p > 0.0]
    precision = prior[1] ** -2.0 + sum(p for p, _ in told)
    return (prior[0] * prior[1] ** -2.0 + sum(m for _, m in told)) / precision, precision**-0.5


def together(said: list[pl.DataFrame]) -> pl.DataFrame:
    """Prognoses of the same flights by several models, averaged."""
    mean = pl.concat(said).group_by(KEY).agg(pl.col(SAID).mean())
    return said[0].drop(SAID).join(mean, on=KEY, how="left", maintain_order="left")


def of(fleet: Frames, tails: list[str]) -> Part:
    """What is known of some tails."""
    features = fleet["features"].filter(pl.col("tail").is_in(tails))
    return features, episodes(features, fleet["messages"], fleet["maintenance"])


def taught(base: Prognosis, parts: dict[str, list[str]], fleet: Frames) -> dict[str, Prognosis]:
    """A model of each operator, by its tails that teach."""
    return {operator: fit_prognosis(*of(fleet, tails), base=base) for operator, tails in parts.items()}


def corrected(fleet: Frames, base: Prognosis) -> dict[str, list[pl.DataFrame]]:
    """Judged prognoses of every tail by what others taught the simulated base, by way of learning."""
    fleets, said = tails_of(fleet), {}
    unmoved = named(base, {c: ComponentFit(PRIOR_RULES[c], levels=untaught_levels(base, c)) for c in PRIOR_RULES})
    for k in range(SIZE.tails):
        teach = {o: tails[:k] + tails[k + 1 :] for o, tails in fleets.items()}
        models = taught(base, teach, fleet)
        every = [t for tails in teach.values() for t in tails]
        shared = named(base, averaged([m.fits for m in models.values()]))
        pooled = fit_prognosis(*of(fleet, every), base=base)
        for operator, tails in fleets.items():
            asked = of(fleet, [tails[k]])
            ways = {
                "simulated base alone": [unmoved],
                "own lives only": [models[operator]],
                "numbers averaged": [shared],
                "prognoses averaged": list(models.values()),
                "all lives in one place": [pooled],
            }
            _judge(ways, asked, said)
    return said


def newcomer(fleet: Frames, base: Prognosis) -> dict[str, list[pl.DataFrame]]:
    """The same for an operator of which no life was seen."""
    fleets, said = tails_of(fleet), {}
    models = taught(base, fleets, fleet)
    unmoved = named(base, {c: ComponentFit(PRIOR_RULES[c], levels=untaught_levels(base, c)) for c in PRIOR_RULES})
    for operator, tails in fleets.items():
        others = [m for o, m in models.items() if o != operator]
        every = [t for o, own in fleets.items() if o != operator for t in own]
        ways = {
            "simulated base alone": [unmoved],
            "numbers averaged": [named(base, averaged([m.fits for m in others]))],
            "prognoses averaged": others,
            "all lives in one place": [fit_prognosis(*of(fleet, every), base=base)],
        }
        _judge(ways, of(fleet, tails), said)
    return said


def _judge(ways: dict[str, list[Prognosis]], asked: Part, said: dict[str, list[pl.DataFrame]]) -> None:
    for way, models in ways.items():
        told = [predict_prognosis(model, *asked).filter(component="HX") for model in models]
        said.setdefault(way, []).append(judge(together(told) if len(told) > 1 else told[0], *asked))


def unaided(fleet: Frames) -> dict[str, list[pl.DataFrame]]:
    """Judged prognoses by hazards learned from lives alone, of the operators whose own lives suffice for one."""
    rows, fleets, said = rows_of(fleet), tails_of(fleet), {}
    for k in range(SIZE.tails):
        teach = {o: tails[:k] + tails[k + 1 :] for o, tails in fleets.items()}
        models = {o: _learned(rows, tails) for o, tails in teach.items()}
        known = [m for m in models.values() if m]
        pooled = _learned(rows, [t for tails in teach.values() for t in tails])
        for operator, tails in fleets.items():
            if models[operator] is None:  # it would have nothing to say
                continue
            ways = {
                "own lives only": [models[operator]],
                "prognoses averaged": known,
                "all lives in one place": [pooled],
            }
            asked = _only(rows, [tails[k]])
            for way, who in ways.items():
                told = [model.say(asked, "health") for model in who]
                mean = pl.concat(told).group_by("flight_id", "pack").agg(pl.col(SAID).mean())
                frame = told[0].drop(SAID).join(mean, on=["flight_id", "pack"], how="left")
                said.setdefault(way, []).append(frame.filter(pl.col("left") >= 1))
    return said


def _learned(rows: Asked, tails: list[str]) -> Learner | None:
    """A hazard of some tails' lives; None where there are too few failures to fit one and its interval."""
    own = _only(rows, tails)
    return Learner.fit(own, "health") if np.unique(own.life[own.failed]).size >= 2 else None


def _only(rows: Asked, tails: list[str]) -> Asked:
    use = np.isin(rows.frame["tail"].to_numpy().astype(str), tails)
    inputs = {name: value[use] for name, value in rows.inputs.items()}
    return Asked(rows.frame.filter(pl.Series(use)), inputs, rows.left[use], rows.failed[use], rows.life[use])


def tails_of(fleet: Frames) -> dict[str, list[str]]:
    """Tails of each operator."""
    known = fleet["features"].select("operator", "tail").unique().sort("operator", "tail")
    return {str(o): own["tail"].to_list() for (o,), own in known.group_by("operator", maintain_order=True)}


def table(said: dict[str, list[pl.DataFrame]], draws: int) -> str:
    """As Markdown, with 5 to 95 % of the interval score and the Brier skill over tails drawn anew."""
    head = ["taught by", "failures", "mean absolute error", "interval score", "5-95 %", "interval skill", "coverage"]
    lines = [[*head, "Brier skill", "5-95 %", "AUC"]]
    for way, parts in said.items():
        judged = pl.concat(parts, how="diagonal_relaxed")
        s = score_prognoses(judged)
        score, skill = (
            bootstrap(judged, lambda frame, name=name: score_prognoses(frame).get(name, np.nan), draws=draws)
            for name in ("interval_score_flights", "brier_skill")
        )
        numbers = (s["mae_flights"], s["interval_score_flights"], *score, s["interval_skill"], s["coverage"])
        form = "{} | {:.1f} | {:.0f} | {:.0f} - {:.0f} | {:.3f} | {:.3f} | {:.3f} | {:.2f} - {:.2f} | {:.3f}"
        lines.append([way, form.format(_failures(judged), *numbers, s["brier_skill"], *skill, s["auc"])])
    return markdown(lines)


def _failures(judged: pl.DataFrame) -> int:
    return judged.filter("failed").select("tail", "pack", "life").unique().height


def main() -> None:
    asked = arguments(__doc__)
    asked.add_argument("--fleets", type=int, default=4)
    asked.add_argument("--draws", type=int, default=100)
    given = asked.parse_args()
    fleets = list(flown(FIRST_SEED, given.fleets, SIZE))
    base = shipped_base()
    parts: dict[str, Callable[[Frames], dict[str, list[pl.DataFrame]]]] = {
        "corrected": lambda fleet: corrected(fleet, base),
        "newcomer": lambda fleet: newcomer(fleet, base),
        "unaided": unaided,
    }
    for mark, judged_by in parts.items():
        said: dict[str, list[pl.DataFrame]] = {}
        for fleet in fleets:
            for way, judged in judged_by(fleet).items():
                said.setdefault(way, []).extend(judged)
        print(f"\n## {mark}\n\n{(text := table(said, given.draws))}", flush=True)
        if given.write:
            put(mark, text, PAGE)


if __name__ == "__main__":
    main()
