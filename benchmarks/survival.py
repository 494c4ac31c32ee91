"""Scores of censored lives: each row counts by the chance that a life like it is still under observation then."""

import numpy as np
import polars as pl
from sksurv.metrics import brier_score, concordance_index_ipcw
from sksurv.nonparametric import kaplan_meier_estimator
from sksurv.util import Surv

HORIZON = 100.0
END = 300.0
"""Flights that are told; what is left beyond counts as left at the end."""


def censored_scores(prognoses: pl.DataFrame, risk: str) -> dict[str, float]:
    """Concordance of the risk with what came, and its Brier score at `HORIZON` flights over that of one risk for all.

    Parameters
    ----------
    prognoses : DataFrame
        `remaining`, `failed`, and in the column `risk` the probability of the message within `HORIZON` flights.

    References
    ----------
    .. [1] H. Uno et al., On the C-statistics for evaluating overall adequacy of risk prediction procedures with
       censored survival data, Statistics in Medicine 30, 2011.
    .. [2] E. Graf et al., Assessment and comparison of prognostic classification schemes for survival data, Statistics
       in Medicine 18, 1999.
    """
    rows = prognoses.drop_nulls(risk)
    left = np.minimum(rows["remaining"].to_numpy(), END)
    survival = Surv.from_arrays(rows["failed"].to_numpy() & (rows["remaining"].to_numpy() < END), left)
    risks = rows[risk].to_numpy()
    concordant = concordance_index_ipcw(survival, survival, risks, tau=END - 1.0)[0]
    both = (risks, np.full(risks.size, _by(survival)))
    brier, same = (float(brier_score(survival, survival, 1.0 - p, [HORIZON])[1][0]) for p in both)
    return {"c_index": float(concordant), "brier_100_skill": 1.0 - brier / same}


def _by(survival: np.ndarray) -> float:
    """Share of rows with the message within `HORIZON`, by Kaplan and Meier."""
    time, alive = kaplan_meier_estimator(survival["event"], survival["time"])
    return 1.0 - float(alive[np.searchsorted(time, HORIZON, side="right") - 1])
