"""A small fleet with known lives, in the frames the stages exchange."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest

from hdt_core.margin.exchanger_demand import CRITICAL, EXCESS_K, SHARES
from hdt_core.margin.margin import LN_RATIO_PER_K
from hdt_core.simulate.episodes import LEAD, Episodes, EpisodeSettings, draw_episodes

START = datetime(2024, 1, 1, 6, tzinfo=UTC)


def _flights(tail: str, pack: int, flights: int) -> pl.DataFrame:
    departed = [START + timedelta(hours=8 * k) for k in range(flights)]
    ids = [f"{tail}_{d:%Y%m%d}_{d.hour // 8 + 1:02d}" for d in departed]
    return pl.DataFrame({"operator": "XXX", "tail": tail, "flight_id": ids, "departed_at": departed}).with_columns(
        pl.lit(pack, pl.Int32).alias("pack"), pl.col("departed_at").cast(pl.Datetime("us", "UTC"))
    )


@pytest.fixture(scope="session")
def fleet() -> tuple[pl.DataFrame, pl.DataFrame, pl.DataFrame]:
    """Features, messages and maintenance of eight tails, two packs each; a failed unit is followed by a new one."""
    lives = iter(_lives())
    features = []
    messages = []
    maintenance = []
    for number in range(8):
        for pack in (1, 2):
            tail = f"LX-T{number:02d}"
            total = 320
            value = np.empty((0, len(COLUMNS)))
            flights = _flights(tail, pack, total)
            while len(value) < total:
                track, message = next(life for life in lives if not len(value) or life[0][0, 0] < NEW_LOSS)
                end = len(value) + message
                value = np.concatenate([value, track[: message + 3]])
                if end + 6 < total:  # the entry counts from the end of its day: three flights later at the most
                    part = flights.row(end, named=True)
                    messages.append((part["departed_at"], part["flight_id"], pack, tail))
                    maintenance.append((flights["departed_at"][end + 3].date(), pack, tail))
            part = pl.DataFrame(value[:total], schema=list(COLUMNS))
            features.append(pl.concat([flights, part], how="horizontal"))
    return pl.concat(features), _messages(messages), _maintenance(maintenance)


NEW_LOSS = 0.1
"""Loss below which a life may follow a replacement: another unit is not worn."""
COLUMNS = (
    "hx_fouling", "hx_fouling_sd", "hx_ln_ua_ratio", "overheat_p20_k", "overheat_p50_k", "full_open_share", *CRITICAL,
)  # fmt: skip


def _lives() -> list[tuple[np.ndarray, int]]:
    lives = draw_episodes(78, EpisodeSettings(aircraft=60, flights=420))
    tracks = np.stack([*_columns(lives)], axis=-1)
    ends = np.minimum(lives.message, 400)
    return [(track, int(end)) for track, end in zip(tracks, ends, strict=True) if end > 10]


def _columns(lives: Episodes) -> list[np.ndarray]:
    """`COLUMNS`, the critical ratios as straight lines, steeper with time, through the one of the drawn episodes."""
    demand = np.where(np.isnan(lives.demand), np.nanmedian(lives.demand), lives.demand)[:, LEAD:]
    per_k = LN_RATIO_PER_K * np.linspace(0.7, 1.3, demand.shape[1])
    curves = [demand - 0.05 * i - per_k * (e - 7.0) for i in range(len(SHARES)) for e in EXCESS_K]
    observed = (lives.overheat_k, lives.overheat_half_k, lives.full_open)
    return [lives.estimated_loss, np.full(lives.estimated_loss.shape, 0.015), lives.ratio, *observed, *curves]


def _messages(rows: list[tuple[object, ...]]) -> pl.DataFrame:
    schema = {"message_time": pl.Datetime("us", "UTC"), "flight_id": pl.String, "pack": pl.Int32, "tail": pl.String}
    own = {"operator": "XXX", "code": "21-52-HXTEMP", "text": "PACK TEMPERATURE HIGH"}
    return pl.DataFrame(rows, schema=schema, orient="row").with_columns(pl.lit(v).alias(k) for k, v in own.items())


def _maintenance(rows: list[tuple[object, ...]]) -> pl.DataFrame:
    frame = pl.DataFrame(rows, schema={"done_on": pl.Date, "pack": pl.Int32, "tail": pl.String}, orient="row")
    own = {"operator": "XXX", "component": "HX", "action": "REPLACED", "finding": "FOULED", "reference": "WO1"}
    return frame.with_columns(pl.lit(v).alias(k) for k, v in own.items())
