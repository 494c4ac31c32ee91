"""The table of README's first screen: each figure beside its goal, marked where it falls short."""

import numpy as np

from benchmarks.alerts import COMPONENTS
from benchmarks.harness import markdown
from benchmarks.price import ALL, Price

Figures = dict[str, float]

ALERTED_GOAL = 0.8
OWN_CAUSE_GOAL = 1.0
ERROR_GOAL_FLIGHTS = 50.0
COVERAGE_GOAL = (0.88, 0.92)
SCORE_GOAL = 0.7
AUC_GOAL, BRIER_GOAL = 0.95, 0.25


def first_screen(
    alerts: dict[str, Figures], lives: dict[str, dict[str, Figures]], priced: dict[str, dict[str, Price]]
) -> str:
    """Return the table and what stands beside it.

    Parameters
    ----------
    alerts : dict of str to dict
        Figures of `alerts.figures_of` by component.
    lives : dict of str to dict of str to dict
        Figures of `prognosis.life_figures` by component and contestant.
    priced : dict of str to dict of str to Price
        Of `price.prices`.
    """
    product = {component: contestants["product"] for component, contestants in lives.items()}
    low, high = COVERAGE_GOAL
    within_50 = f"AUC (goal {AUC_GOAL:.2f}), Brier skill (goal {BRIER_GOAL:.2f})"
    rows = [
        (f"faults or failures alerted (goal {_percent(ALERTED_GOAL)})", alerts, _alerted),
        ("alerts in 1,000 flights; followed by the message, finding or fault within 200", alerts, _followed),
        (f"alerts without their own cause in 1,000 flights (goal {OWN_CAUSE_GOAL:.0f})", alerts, _without_cause),
        (f"flights left: mean error (goal {ERROR_GOAL_FLIGHTS:.0f})", product, _error),
        ("middle of the forecast late before failures, by flights", product, _late),
        (f"90 % interval holds (goal {100.0 * low:.0f} to {_percent(high)}); width", product, _interval),
        (f"interval score over that of a constant (goal {SCORE_GOAL:.2f})", product, _score),
        (f"message within 50 flights or none: {within_50}", product, _within_50),
    ]
    lines = [["", *COMPONENTS.values()]]
    for words, figures, cell in rows:
        lines.append([words, *(cell(figures[c]) if c in figures else "" for c in COMPONENTS)])
    return f"{markdown(lines)}\n\n{_paid(priced)}\n\n{_beside(lives['HX'])}"


def _short(text: str, *, is_met: bool, word: str = "short") -> str:
    return text if is_met else f"{text}: **{word}**"


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _alerted(figures: Figures) -> str:
    failures = figures["failures"]
    share = figures["alerted"]
    lead = figures["lead or delay, median"]
    ahead = "" if np.isnan(figures["message within 200"]) else f", {lead:.0f} flights ahead"
    return _short(f"{share * failures:.0f} of {failures:.0f}{ahead}", is_met=share >= ALERTED_GOAL)


def _followed(figures: Figures) -> str:
    return f"{figures['in 1,000 flights']:.1f}; {_percent(figures['right within 200'])}"


def _without_cause(figures: Figures) -> str:
    rate = figures["without own cause in 1,000"]
    return _short(f"{rate:.2f}", is_met=rate <= OWN_CAUSE_GOAL, word="over")


def _error(figures: Figures) -> str:
    return _short(f"{figures['mae']:.0f}", is_met=figures["mae"] <= ERROR_GOAL_FLIGHTS)


def _late(figures: Figures) -> str:
    return f"{figures['bias before failures']:.0f}"


def _interval(figures: Figures) -> str:
    low, high = COVERAGE_GOAL
    share = figures["coverage"]
    word = "wide" if share > high else "narrow"
    return f"{_short(f'{_percent(share)}', is_met=low <= share <= high, word=word)} ({figures['width']:.0f} flights)"


def _score(figures: Figures) -> str:
    score = figures["score over a constant's"]
    return _short(f"{score:.2f}", is_met=score <= SCORE_GOAL)


def _within_50(figures: Figures) -> str:
    auc = figures["AUC"]
    skill = figures["Brier skill"]
    return _short(f"{auc:.3f}, {skill:.2f}", is_met=auc >= AUC_GOAL and skill >= BRIER_GOAL)


def _paid(priced: dict[str, dict[str, Price]]) -> str:
    costs = {name: groups[ALL] for name, groups in priced.items()}
    each = "; ".join(
        f"by the {name} {_percent(cost.avoided)}, {cost.given_up_flights:.0f} flights, {cost.unneeded:.2f}"
        for name, cost in costs.items()
    )
    return (
        "The price of messages avoided by renewing exchangers beforehand, with limits chosen on earlier months (share "
        f"avoided, flights of life given up in the median, unneeded renewals for each avoided): {each}."
    )


def _beside(contestants: dict[str, Figures]) -> str:
    physics = contestants["physics alone"]
    base = contestants["base alone"]
    return (
        f"Beside it, on the same flights: physics without a learner has {physics['AUC']:.2f} AUC and "
        f"{_over_constant(physics)} times the constant's interval score; the base without the fleet's own messages "
        f"{_over_constant(base)} times, with a Brier skill of {base['Brier skill']:.2f}."
    )


def _over_constant(figures: Figures) -> str:
    score = figures["score over a constant's"]
    return f"{score:.2f}"
